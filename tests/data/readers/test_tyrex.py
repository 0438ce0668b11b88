"""Tyrex: a known walk written in the authors' layout, traps included, must come back as the
phone's; real walks must be physical."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.io import savemat

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers import tyrex
from gnio_jax.data.self_check import self_check
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.refusals import refused
from tests.support.tyrex_files import BIAS, IPHONE, LAG, LOST, NEXUS, OFFSET, write


@pytest.mark.parametrize("name", [NEXUS, IPHONE])
def test_a_walk_comes_back_as_the_phones(tmp_path, name):
    (sequence,) = tyrex.read(write(tmp_path, name))
    # Times of the walk: the record's.
    time = sequence.time + sequence.attributes["start_time"]
    np.testing.assert_allclose(np.diff(sequence.time), 0.01, rtol=1e-6)
    # The fit finds a delay of the accelerometer of less than a millisecond, and takes it out.
    walk.compare(sequence, time, 4e-3, 0.5, 0.5, imu=0.05, bias=BIAS, edge=30)
    np.testing.assert_allclose(sequence.gyro[30:-30], (walk.rate(time) + BIAS)[30:-30], atol=2e-3)
    speed_error = (sequence.velocity - walk.velocity(time))[sequence.valid]
    assert np.sqrt((speed_error**2).sum(axis=1).mean()) < 0.05
    assert sequence.valid.mean() > 0.95 and self_check(sequence).failures == ()
    assert sequence.attributes["lag"] == pytest.approx(-LAG, abs=2e-3)
    assert sequence.attributes["gyro_bias"] == pytest.approx(np.linalg.norm(BIAS), abs=2e-3)
    # A sixth of a second without a pose.
    gone = (LOST.start + np.array([2, 6])) / 60.0 - OFFSET - LAG
    assert not sequence.valid[(time > gone[0]) & (time < gone[1])].any()


def test_names_say_who_carried_what_and_how(tmp_path):
    (texting,), (running,) = (tyrex.read(write(tmp_path, name, 20.0)) for name in (NEXUS, IPHONE))
    for sequence, about in (
        (texting, {"subject": "Guillaume", "device": "Nexus 5", "gait": "walking"}),
        (running, {"subject": "Thibaud", "device": "iPhone 4S", "gait": "running"}),
    ):
        assert about.items() <= sequence.attributes.items()
        assert sequence.attributes["group"] == about["subject"]
    assert texting.attributes["imu_compensated"] == "Android's gyro bias"
    assert running.attributes["imu_compensated"] == "no"
    assert texting.attributes["placement"] == "texting"
    assert running.attributes["placement"] == "running, in the hand"


def test_one_person_trains_and_the_other_validates_and_tests(tmp_path):
    names = {
        "train": ["Thibaud_Nexus5_Dist_AR", "Thibaud_iPhone5_NoDist_AR"],
        "val": ["Guillaume_iPhone5_Dist_AR"],
        "test": ["Guillaume_Nexus5_NoDist_RunningHand"],
    }
    for name in (name for each in names.values() for name in each):
        (tmp_path / "android" / name).mkdir(parents=True)
    (tmp_path / "android" / "notes").mkdir()
    for split, wanted in names.items():
        assert [each.name for each in tyrex.recordings(tmp_path, split)] == wanted
    assert len(tyrex.recordings(tmp_path, "all")) == 4
    nothing = tmp_path / "android" / "notes"
    refused(lambda: tyrex.recordings(nothing, "all"), nothing, "no recording of Tyrex")
    (tmp_path / "android" / names["val"][0]).rmdir()
    refused(lambda: tyrex.recordings(tmp_path, "val"), tmp_path, "no walk of split 'val'")


def test_a_record_that_pauses_is_two_walks(tmp_path):
    folder = write(tmp_path, seconds=46.0)
    for file in ("gyroscope.txt", "accelerometer.txt"):
        rows = (folder / file).read_text().splitlines()
        kept = (row for row in rows if not 21.0 < float(row.split(" ")[0]) < 24.5)
        (folder / file).write_text("\n".join(kept))
    with pytest.warns(UserWarning, match=r"'time' has gaps longer than 1 s \(1, up to 3.5 s\)"):
        pieces = tyrex.read(folder)
    assert len(pieces) == 2
    for piece in pieces:
        time = piece.time[piece.valid] + piece.attributes["start_time"]
        error = rotations(piece.orientation[piece.valid]) * walk.attitude(time).inv()
        assert np.degrees(error.magnitude()).max() < 0.5
        assert self_check(piece).failures == ()


def test_an_accelerometer_that_clips_says_so(tmp_path, monkeypatch):
    force = walk.force
    monkeypatch.setattr(walk, "force", lambda time: np.minimum(2.2 * force(time), 19.55))
    folder = write(tmp_path, seconds=20.0)
    phone = tyrex.read_phone(tyrex.walk_of(folder))
    share = tyrex.clipped(phone.accel.values)
    felt = np.loadtxt(folder / "accelerometer.txt")[:, 1:]
    assert 0.1 < (felt == 19.55).any(axis=1).mean() <= share < 0.6
    assert tyrex.clipped(1.2 * phone.accel.values) == 0.0  # of a phone with a wider range
    assert tyrex.clipped(0.9 * phone.accel.values) == 0.0


# --- damage


def body(name, value):
    """Field `name` of the rigid body becomes `value` of it."""

    def change(struct):
        struct["RigidBodies"][name] = value(struct["RigidBodies"][name])

    return change


def mirrored(values):
    values[:, 6:, 20] *= -1.0  # the third column of frame 21
    return values


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda struct: struct.pop("RigidBodies"), ("'RigidBodies'", "QTM")),
        (lambda struct: struct["RigidBodies"].pop("Rotations"), ("'RigidBodies'", "Rotations")),
        (lambda struct: struct.update(FrameRate=0.0), ("'FrameRate' is 0 Hz",)),
        (lambda struct: struct.update(FrameRate="fast"), ("'FrameRate'", "expected ()")),
        (body("Positions", lambda x: x[:, :2]), ("'Positions'", "expected (3, n)")),
        (body("Positions", lambda x: x[:, :, :50]), ("hold 50 and", "frames")),
        (body("Positions", lambda x: x * 1e-3), ("'Positions' spans", "give it in mm")),
        (body("Positions", lambda x: x * np.nan), ("only 0 of", "frames hold a pose")),
        (body("Rotations", mirrored), ("'Rotations' is no rotation in 1 frames", "frame 21")),
    ],
)
def test_a_bad_track_is_refused_by_file_and_field(tmp_path, spoil, words):
    folder = write(tmp_path, seconds=12.0, spoil=spoil)
    refused(lambda: tyrex.read(folder), tyrex.walk_of(folder).track, *words)


def test_a_track_that_is_no_matlab_5_is_refused(tmp_path):
    folder = write(tmp_path, seconds=12.0)
    path = tyrex.walk_of(folder).track
    path.write_bytes(path.read_bytes()[:3000])
    refused(lambda: tyrex.read(folder), path, "MATLAB 5")
    savemat(path, {"walk": np.eye(3)})
    refused(lambda: tyrex.read(folder), path, "'RigidBodies'")
    path.unlink()
    refused(lambda: tyrex.read(folder), path, "no such file")


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("description.txt", "[Time]\n", ("'BootTime' is missing",)),
        ("description.txt", "BootTime = 12.5", ("gyroscope.txt", "'time'", "of one phone")),
        ("timeAlignment.txt", "later", ("holds 'later'", "seconds")),
        ("gyroscope.txt", "81205.0 0.1 0.2\n81205.1 0.1 0.2\n", ("3 columns, expected 4",)),
    ],
)
def test_a_bad_text_of_the_phone_is_refused(tmp_path, file, text, words):
    folder = write(tmp_path, IPHONE, 12.0)
    (folder / file).write_text(text)
    place = folder / ("gyroscope.txt" if "gyroscope.txt" in words else file)
    refused(lambda: tyrex.read(folder), place, *words[words[0] == "gyroscope.txt" :])


def test_the_track_of_another_walk_is_refused(tmp_path):
    folder, other = write(tmp_path), write(tmp_path, IPHONE)
    (folder / "timeAlignment.txt").write_text("2.5")  # 3.4 s of the walk away
    path = tyrex.walk_of(folder).track
    with pytest.raises(Refusal, match=r"(stays unexplained|impossible values)") as caught:
        tyrex.read(folder)
    assert str(caught.value).startswith(f"{path} and ")
    # The IMU of another phone's record has other stamps.
    (other / "accelerometer.txt").write_text((folder / "accelerometer.txt").read_text())
    refused(lambda: tyrex.read(other), other / "accelerometer.txt", "of one phone")
