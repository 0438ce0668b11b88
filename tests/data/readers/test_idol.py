"""IDOL: a known walk, traps included, must come back as the phone's, not the rig's."""

import sys

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers import idol
from gnio_jax.data.self_check import check_sequence
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.idol_files import BIAS, EPOCH, frame, write

CORE_MOTION = [f"iphoneOrient{axis}" for axis in "WXYZ"]


def compare(sequence):
    time = sequence.time + (sequence.attributes["start_time"] - EPOCH)
    np.testing.assert_allclose(np.diff(sequence.time), 0.01, rtol=1e-4)  # unix seconds hold 0.2 µs
    walk.compare(sequence, time, bias=BIAS, edge=20)
    difference = (rotations(sequence.device_orientation) * walk.attitude(time).inv()).as_rotvec()
    np.testing.assert_allclose(difference, np.broadcast_to([0, 0, 0.9], (len(time), 3)), atol=1e-3)
    assert data.self_check(sequence).failures == ()
    return time


@pytest.mark.parametrize(("lag", "degrees"), [(0.19, 8.4), (-0.05, 0.0)])
def test_a_walk_comes_back_level_in_the_phones_frame_and_on_its_clock(tmp_path, lag, degrees):
    tilt = Rotation.from_rotvec(np.radians(degrees) * np.array([0.8, -0.6, 0.0]))
    (sequence,) = idol.read(write(tmp_path, frame(lag=lag, tilt=tilt)))
    compare(sequence)
    a = sequence.attributes
    assert a["lag"] == pytest.approx(lag, abs=3e-3) and a["rate_correlation"] > 0.99
    assert a["tilt_degrees"] == pytest.approx(degrees, abs=0.5)
    assert sequence.valid.all() and sequence.name == "building1_known_3"
    assert (a["building"], a["imu_compensated"]) == ("building1", "no")


def disordered(table):
    """Columns among strays and in another order, one row late and one there three times."""
    table.insert(3, "level_0", np.arange(len(table))[::-1])
    rows = np.arange(len(table))
    rows[[100, 101]] = rows[[101, 100]]
    table = table[list(np.random.default_rng(0).permutation(table.columns))]
    return table.iloc[np.insert(rows, 500, [500, 500])]


def wild(table):
    """A stamp of 0 among unix seconds, a gap of decades, which nothing may span. It has no pose
    near it, and is cut off as such."""
    return pd.concat([table.iloc[:1].assign(timestamp=0.0), table], ignore_index=True)


def unoriented(table):
    """Core Motion's attitude is optional: rows that lack it are no reason to refuse a walk."""
    table.loc[100:102, CORE_MOTION], table.loc[200:202, CORE_MOTION] = np.nan, 0.0
    return table


def thrown(row):
    """One pose a metre off at an end, where the map is levelled by the speed."""

    def change(table):
        table.loc[table.index[row], "processedPosX"] += 1.0
        return table

    return change


TRAPS = [disordered, wild, unoriented, thrown(0), thrown(-1)]


@pytest.mark.parametrize("trap", TRAPS)
def test_a_walk_with_traps_comes_back(tmp_path, trap):
    (sequence,) = idol.read(write(tmp_path, trap(frame())))
    compare(sequence)
    assert sequence.attributes["lag"] == pytest.approx(0.0, abs=3e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        # An attitude that is the phone's already turns the other way about x and y than a rig's.
        ({"mount": Rotation.identity()}, "columns 'orient' do not turn as 'iphoneGyro' does"),
        ({"lag": 0.43}, "out of step with 'iphoneGyro'"),  # later than the search goes
        ({"tilt": Rotation.from_euler("x", 40, degrees=True)}, "40° off the vertical"),
    ],
)
def test_poses_that_are_not_of_this_phone_are_refused(tmp_path, options, words):
    with pytest.raises(Refusal, match=rf"3\.feather: .*{words}"):
        idol.read(write(tmp_path, frame(seconds=20.0, **options)))


def test_a_hole_of_two_seconds_costs_two_seconds(tmp_path, monkeypatch):
    """Nothing of the hole is left for a filter to integrate. Rows without a pose are marked."""
    table = frame(seconds=38.0, lag=0.15)
    table.loc[500:549, "processedPosY"] = np.nan
    table.loc[1000:1049, ["orientW", "orientX"]] = np.nan
    table.loc[3000:3049, ["orientW", "orientX", "orientY", "orientZ"]] = 0.0
    time = table["timestamp"] - EPOCH
    path = write(tmp_path, table[(time < 19.0) | (time > 21.3)])
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pyarrow", None)
        words = r"3\.feather: needs the package pyarrow.*pip install 'gnio-jax\[idol\]'"
        with pytest.raises(InputError, match=words):
            idol.read(path)
    words = r"field 'time' has gaps longer than 1 s \(1, up to 2\.3 s\); kept: 3[45]\."
    with pytest.warns(UserWarning, match=words):
        pieces = idol.read(path)
    assert sum(piece.valid.sum() for piece in pieces) / 100.0 >= 33.3
    assert [piece.name for piece in pieces] == [f"building1_known_3_piece{k}" for k in (1, 2)]
    for piece in pieces:
        compare(piece)
        assert piece.attributes["lag"] == pytest.approx(0.15, abs=3e-3)
        time = piece.time + piece.attributes["start_time"] - EPOCH + 0.15
        for middle in (5.25, 10.25, 30.25):
            assert not piece.valid[np.abs(time - middle) < 0.2].any()
    assert pieces[1].attributes["start_time"] - EPOCH == pytest.approx(21.3, abs=0.02)


def test_smoothed_positions_or_no_core_motion_leave_no_walk_out(tmp_path):
    """The authors' positions hold no gait: they do not correlate with the accelerometer, as little
    as a wrong time would."""
    table = frame(seconds=20.0).drop(columns=CORE_MOTION[1])
    time = table["timestamp"] - EPOCH
    for axis, coordinate in zip("XYZ", (0.9 * time, 0.3 * np.sin(time / 4.0), 1.0), strict=True):
        table[f"processedPos{axis}"] = coordinate
    (sequence,) = idol.read(write(tmp_path, table))
    check = check_sequence(sequence, idol.DATASET)
    assert check.failures == () and check.accel_correlation_horizontal < 0.3
    assert sequence.device_orientation is None and sequence.valid.all()
