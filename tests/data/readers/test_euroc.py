"""EuRoC and TUM-VI: a known motion written in the ASL layout, traps included, must come back; real
recordings must be physical."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.readers import euroc
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import asl_files as files
from tests.support import known_walk
from tests.support.refusals import refused


def known_time(sequence):
    """s on the known walk's clock; unix seconds alone would lose the nanoseconds' digits."""
    return sequence.time + (sequence.attributes["start_time"] - files.EPOCH * 1e-9)


def compare(sequence, degrees=0.1, metres=1e-3, speed=2e-3, bias=0.0):
    known_walk.compare(sequence, known_time(sequence), metres, degrees, speed, bias=bias)
    np.testing.assert_allclose(np.diff(sequence.time), 0.005, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "step", "shuffle"),
    [
        (files.LONG_HEADER, 0.005, False),
        (files.SHORT_HEADER, 0.05, False),
        (files.LONG_HEADER, 0.005, True),
    ],
    ids=["published", "20 Hz with short names", "shuffled"],
)
def test_an_estimate_comes_back_at_the_stamps_of_the_imu(tmp_path, header, step, shuffle):
    mav = tmp_path / "V1_01_easy" / "mav0"
    files.write_imu(mav, shuffle=shuffle)
    files.write_estimate(mav, header=header, step=step, shuffle=shuffle)
    (sequence,) = euroc.read(mav.parent)
    compare(sequence)
    time = known_time(sequence)
    # What the reference does not cover is cut off.
    assert time[0] == pytest.approx(1.005, abs=1e-6)
    assert time[-1] == pytest.approx(11.0 - step, abs=step + 0.005)
    assert sequence.valid.all()
    assert sequence.name == "V1_01_easy"
    assert sequence.attributes["dataset"] == "euroc"
    assert self_check(sequence, pedestrian=False).failures == ()


@pytest.mark.parametrize("step", [0.005, 0.05])
def test_extrinsics_move_the_reference_to_the_imu(tmp_path, step):
    mount = files.Mount(
        Rotation.from_euler("ZXY", [100, 20, -30], degrees=True), np.array([0.07, -0.13, 0.11])
    )
    imu_mount = files.Mount(
        Rotation.from_euler("ZXY", [-40, 5, 170], degrees=True), np.array([-0.02, 0.05, 0.01])
    )
    mav = tmp_path / "V1_01_easy" / "mav0"
    files.write_imu(mav)
    files.write_yaml(mav / "imu0" / "sensor.yaml", imu_mount)
    files.write_estimate(mav, step=step, mount=mount, imu_mount=imu_mount)
    (sequence,) = euroc.read(mav.parent)
    # 20 Hz cannot carry the bounce of a lever to the millimetre.
    compare(sequence, metres=1e-3 if step < 0.01 else 2e-3, speed=5e-3 if step < 0.01 else 0.05)
    assert sequence.valid.all()


def test_gaps_and_jumps_of_an_estimate_are_not_valid(tmp_path):
    def spoil(stamps, values):
        time = (stamps - files.EPOCH) * 1e-9
        values[time > 6.0, :3] += 0.1  # batches that do not meet
        values[400:404, 4] = np.nan  # poses that are none
        keep = ~((time > 8.0) & (time < 8.5)) & ~((time > 9.0) & (time < 9.08))
        return stamps[keep], values[keep]

    mav = tmp_path / "MH_04_difficult" / "mav0"
    files.write_imu(mav)
    files.write_estimate(mav, spoil=spoil)
    (sequence,) = euroc.read(mav.parent)
    time, valid = known_time(sequence), sequence.valid
    broken = (time > 7.994) & (time < 8.506)
    np.testing.assert_array_equal(valid[~broken & (np.abs(time - 6.0) > 0.006)], True)
    assert not valid[(time > 8.005) & (time < 8.495)].any()
    assert 1 <= (~valid[np.abs(time - 6.0) < 0.006]).sum() <= 2
    shift = np.where(time > 6.0, 0.1, 0.0)[:, None]
    compare(sequence._replace(position=sequence.position - shift), metres=2e-3)


def test_a_mount_that_appears_makes_another_entry_of_the_cache(tmp_path):
    write(tmp_path, "MH_04_difficult")
    files.write_yaml(tmp_path / "MH_04_difficult" / "mav0" / "imu0" / "sensor.yaml", files.Mount())
    (recording,) = euroc.recordings(tmp_path, "test")
    assert [path.name for path in recording.files] == ["data.csv", "sensor.yaml", "data.csv"]


def test_a_trackers_gaps_are_not_valid_and_its_attitudes_come_back(tmp_path):
    mav = tmp_path / "dataset-room1_512_16" / "mav0"
    files.write_imu(mav, seconds=24.0, step=0.005016, bias=0.02)
    files.write_mocap(mav, last=23.0, gaps=((5.0, 8.2), (12.0, 12.07), (15.0, 15.3)))
    (sequence,) = euroc.read(mav.parent, euroc.TUMVI)
    compare(
        sequence, speed=0.02, bias=0.02
    )  # at the ends of a stretch the smoother has poses on one side alone
    time = known_time(sequence)
    for start, end in ((5.0, 8.2), (15.0, 15.3)):
        assert not sequence.valid[(time > start + 0.01) & (time < end - 0.01)].any()
    gap = (time > 4.98) & (time < 8.22) | (time > 14.98) & (time < 15.32)
    assert sequence.valid[~gap].mean() > 0.995
    assert sequence.valid[(time > 12.0) & (time < 12.07)].all()
    assert sequence.name == "room1" and sequence.attributes["dataset"] == "tumvi"
    assert self_check(sequence).failures == ()


def test_a_noisy_tracker_is_smoothed_and_its_flips_are_bridged(tmp_path):
    mav = tmp_path / "dataset-room2_512_16" / "mav0"
    mount = files.Mount(
        Rotation.from_euler("ZXY", [80, -10, 15], degrees=True), np.array([0.03, 0.06, -0.04])
    )
    files.write_imu(mav, seconds=24.0, step=0.005016, bias=-0.01)
    flips = (4.0, 10.0, 10.3, 17.5)
    files.write_mocap(
        mav, last=23.0, gaps=((12.0, 14.1), (18.0, 18.13)), noise=1.0, flips=flips, mount=mount
    )
    (sequence,) = euroc.read(mav.parent, euroc.TUMVI)
    time, valid = known_time(sequence), sequence.valid
    assert valid[(time < 11.9) | (time > 14.2)].mean() > 0.97
    turn = np.degrees(
        (
            rotations(sequence.orientation[valid]).inv() * known_walk.attitude(time[valid])
        ).magnitude()
    )
    assert turn.max() < 0.5 and np.median(turn) < 0.1
    place = np.linalg.norm(sequence.position - known_walk.position(time), axis=1)[valid]
    assert place.max() < 0.01 and np.median(place) < 2e-3
    speed = np.abs(sequence.velocity - known_walk.velocity(time))[valid]
    assert np.sqrt((speed**2).mean()) < 0.02  # differences of neighbours would make 0.07
    for flip in flips:  # of one pose each
        assert valid[np.abs(time - flip) < 0.1].all()
    assert self_check(sequence).failures == ()


def test_a_few_doubtful_poses_between_gaps_make_no_swing(tmp_path):
    """For a second pairs of poses alone, 90 ms apart, one of each off by 3 cm: a spline through
    them would swing by more."""

    def thin(stamps, values):
        time = (stamps - files.EPOCH) * 1e-9
        sparse = (time > 6.0) & (time < 7.0)
        place = np.arange(len(time)) % 11
        values[sparse & (place == 1), :3] += 0.03
        keep = ~sparse | (place < 2)
        return stamps[keep], values[keep]

    mav = tmp_path / "dataset-room1_512_16" / "mav0"
    files.write_imu(mav, seconds=14.0, step=0.005016)
    files.write_mocap(mav, last=13.0, spoil=thin)
    (sequence,) = euroc.read(mav.parent, euroc.TUMVI)
    time, valid = known_time(sequence), sequence.valid
    assert np.linalg.norm(sequence.position - known_walk.position(time), axis=1)[valid].max() < 0.03
    assert np.abs(sequence.velocity - known_walk.velocity(time))[valid].max() < 0.5
    assert valid[(time < 5.9) | (time > 7.1)].all()


def write(root, *names, mocap=False):
    for name in names:
        mav = root / name / "mav0"
        files.write_imu(mav)
        files.write_mocap(mav) if mocap else files.write_estimate(mav, step=0.02)


def names(sequences):
    return [sequence.name for sequence in sequences]


def test_splits_hold_whole_environments_out(tmp_path):
    write(
        tmp_path,
        "machine_hall/MH_01_easy",
        "machine_hall/MH_05_difficult",
        "V1_02_medium",
        "V2_03_difficult",
        "my_flight",
    )
    (tmp_path / "MH_05_notes").mkdir()
    assert names(data.load("euroc", tmp_path, "train")) == ["MH_01_easy"]
    assert names(data.load("euroc", tmp_path, "val")) == ["V1_02_medium"]
    assert (
        names(data.load("euroc", tmp_path, "test"))
        == names(data.load("euroc", tmp_path, "seen"))
        == ["MH_05_difficult", "my_flight"]
    )
    assert names(data.load("euroc", tmp_path, "unseen")) == ["V2_03_difficult"]
    for splits in (euroc.EUROC_SPLITS, euroc.TUMVI_SPLITS):
        every = [name for chosen in splits.values() for name in chosen]
        assert len(every) == len(set(every)) == {"V2_01_easy": 11}.get(splits["unseen"][0], 28)
    rooms = {
        name.split("_")[0]
        for split in ("train", "val", "test")
        for name in euroc.EUROC_SPLITS[split]
    }
    assert not rooms & {name.split("_")[0] for name in euroc.EUROC_SPLITS["unseen"]}


def test_a_walk_published_in_two_sizes_is_taken_once(tmp_path):
    write(
        tmp_path,
        "dataset-room1_512_16",
        "dataset-room1_1024_16",
        "dataset-room2_1024_16",
        mocap=True,
    )
    write(tmp_path, "dataset-calib-imu1_512_16", mocap=True)
    assert names(data.load("tumvi", tmp_path, "train")) == ["room1", "room2"]
    with pytest.raises(InputError, match="holds no sequence of split 'test'"):
        data.load("tumvi", tmp_path, "test")
    with pytest.raises(
        InputError, match=r"holds no sequence of split 'val'; its sequences are room3"
    ):
        data.load("tumvi", tmp_path, "val")


# --- errors


def set_value(row, column, value):
    def change(stamps, values):
        values[row, column] = value
        return stamps, values

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_value(slice(3, None), 2, np.nan), ("holds 3 poses",)),
        (set_value(7, slice(3, 7), 0.0), ("'q_rs_w', 'q_rs_x'", "not a unit quaternion", "row 9")),
        (lambda s, v: (s[::40], v[::40]), ("field 'time'", "5 Hz, too slow for a reference")),
    ],
)
def test_a_bad_reference_is_refused_by_file_and_field(tmp_path, change, words):
    mav = tmp_path / "V1_01_easy" / "mav0"
    files.write_imu(mav)
    files.write_estimate(mav, spoil=change)
    truth = mav / "state_groundtruth_estimate0" / "data.csv"
    refused(lambda: euroc.read(mav.parent), truth, *words)


def test_a_column_a_mount_or_a_truth_that_is_none_is_named(tmp_path):
    folder = tmp_path / "V1_01_easy"
    mav = folder / "mav0"
    files.write_imu(mav)
    files.write_estimate(mav)
    imu, mount = mav / "imu0" / "data.csv", mav / "imu0" / "sensor.yaml"
    whole = imu.read_text()
    imu.write_text(whole.replace("w_RS_S_y", "w_RS_S_q", 1))
    refused(lambda: euroc.read(folder), imu, "column 'w_rs_s_y' is missing", "w_RS_S_q")
    imu.write_text(whole.replace("#timestamp [ns]", "#when", 1))
    refused(lambda: euroc.read(folder), imu, "column 'timestamp' is missing; found: when")
    imu.write_text(whole)

    no_rotation = f"T_BS: [{', '.join(['0.5'] * 16)}]\n"
    for text, word in (
        ("T_BS:\n  data: [1, 2, 3]\n", "'T_BS' is no pose"),
        ("T_BS:\n  cols: 4\n", "'T_BS' is no pose"),
        (no_rotation, "its rotation is none"),
        ("a: [\n", "cannot be read as YAML"),
    ):
        mount.write_text(text)
        refused(lambda: euroc.read(folder), mount, word)
    mount.write_text("sensor_type: imu\n")  # names no pose
    compare(*euroc.read(folder))
    (mav / "state_groundtruth_estimate0" / "data.csv").unlink()
    refused(lambda: euroc.read(folder), mav, "has no reference", "csv")
