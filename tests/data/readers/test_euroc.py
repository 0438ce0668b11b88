"""EuRoC and TUM-VI: a known motion written in the ASL layout, traps included, must come back."""

import numpy as np
import pytest

from gnio_jax.data.readers import euroc
from gnio_jax.data.self_check import self_check
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


def recorded(mav, seconds=12.0, bias=0.0, imu_mount=None, **options):
    """The folder of a recording with an estimate, or with a tracker's poses where the folder is of
    TUM-VI."""
    mocap = "dataset" in mav.parent.name
    files.write_imu(mav, seconds=seconds, step=0.005016 if mocap else 0.005, bias=bias)
    if mocap:
        files.write_mocap(mav, last=seconds - 1.0, **options)
    else:
        files.write_estimate(mav, imu_mount=imu_mount, **options)
    return mav.parent


@pytest.mark.parametrize(
    ("header", "step", "shuffle"),
    [(files.SHORT_HEADER, 0.05, False), (files.LONG_HEADER, 0.005, True)],
    ids=["20 Hz with short names", "shuffled"],
)
def test_an_estimate_comes_back_at_the_stamps_of_the_imu(tmp_path, header, step, shuffle):
    mav = tmp_path / "V1_01_easy" / "mav0"
    files.write_imu(mav, shuffle=shuffle)
    files.write_estimate(mav, header=header, step=step, shuffle=shuffle)
    (mav / "imu0" / "sensor.yaml").write_text("sensor_type: imu\n")  # names no pose
    (sequence,) = euroc.read(mav.parent)
    compare(sequence)
    time = known_time(sequence)
    # What the reference does not cover is cut off.
    assert time[0] == pytest.approx(1.005, abs=1e-6)
    assert time[-1] == pytest.approx(11.0 - step, abs=step + 0.005)
    assert sequence.valid.all() and sequence.name == "V1_01_easy"
    assert self_check(sequence, pedestrian=False).failures == ()


def test_extrinsics_move_the_reference_to_the_imu(tmp_path):
    mount = files.mount("ZXY", [100, 20, -30], [0.07, -0.13, 0.11])
    imu_mount = files.mount("ZXY", [-40, 5, 170], [-0.02, 0.05, 0.01])
    folder = tmp_path / "V1_01_easy"
    recorded(folder / "mav0", mount=mount, imu_mount=imu_mount)
    files.write_yaml(folder / "mav0" / "imu0" / "sensor.yaml", imu_mount)
    (sequence,) = euroc.read(folder)
    compare(sequence, speed=5e-3)
    assert sequence.valid.all()


def test_gaps_and_jumps_of_an_estimate_are_not_valid(tmp_path):
    def spoil(stamps, values):
        time = (stamps - files.EPOCH) * 1e-9
        values[time > 6.0, :3] += 0.1  # batches that do not meet
        values[400:404, 4] = np.nan  # poses that are none
        keep = ~((time > 8.0) & (time < 8.5)) & ~((time > 9.0) & (time < 9.08))
        return stamps[keep], values[keep]

    (sequence,) = euroc.read(recorded(tmp_path / "MH_04_difficult" / "mav0", spoil=spoil))
    time, valid = known_time(sequence), sequence.valid
    broken = (time > 7.994) & (time < 8.506)
    np.testing.assert_array_equal(valid[~broken & (np.abs(time - 6.0) > 0.006)], True)
    assert not valid[(time > 8.005) & (time < 8.495)].any()
    assert 1 <= (~valid[np.abs(time - 6.0) < 0.006]).sum() <= 2
    shift = np.where(time > 6.0, 0.1, 0.0)[:, None]
    compare(sequence._replace(position=sequence.position - shift), metres=2e-3)


def test_a_mount_that_appears_makes_another_entry_of_the_cache_and_a_truth_is_needed(tmp_path):
    mav = tmp_path / "MH_04_difficult" / "mav0"
    recorded(mav, seconds=3.0)
    files.write_yaml(mav / "imu0" / "sensor.yaml", files.Mount())
    (recording,) = euroc.recordings(tmp_path, "test")
    names = [path.name for path in recording.files if path.is_file()]
    assert names == ["data.csv", "sensor.yaml", "data.csv"]
    (mav / "state_groundtruth_estimate0" / "data.csv").unlink()
    refused(lambda: euroc.read(mav.parent), mav, "has no reference", "csv")


def test_a_noisy_tracker_is_smoothed_its_flips_are_bridged_and_its_gaps_are_not_valid(tmp_path):
    mav = tmp_path / "dataset-room2_512_16" / "mav0"
    gaps, flips = ((12.0, 14.1), (18.0, 18.13), (20.0, 20.07)), (4.0, 10.0, 10.3, 17.5)
    mount = files.mount("ZXY", [80, -10, 15], [0.03, 0.06, -0.04])
    recorded(mav, 24.0, bias=-0.01, gaps=gaps, noise=1.0, flips=flips, mount=mount)
    (sequence,) = euroc.read(mav.parent, "tumvi")
    time, valid = known_time(sequence), sequence.valid
    assert valid[(time < 11.9) | (time > 14.2)].mean() > 0.97
    assert not valid[(time > 12.01) & (time < 14.09)].any()
    assert valid[(time > 20.0) & (time < 20.07)].all()
    np.testing.assert_allclose(sequence.gyro - -0.01, known_walk.rate(time), atol=1e-3)
    np.testing.assert_allclose(sequence.accel, known_walk.force(time), atol=1e-3)
    assert sequence.name == "room2" and sequence.attributes["placement"] == "handheld"
    turn = rotations(sequence.orientation[valid]).inv() * known_walk.attitude(time[valid])
    degrees = np.degrees(turn.magnitude())
    assert degrees.max() < 0.5 and np.median(degrees) < 0.1
    distance = np.linalg.norm(sequence.position - known_walk.position(time), axis=1)[valid]
    assert distance.max() < 0.01 and np.median(distance) < 2e-3
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
        phase = np.arange(len(time)) % 11
        values[sparse & (phase == 1), :3] += 0.03
        keep = ~sparse | (phase < 2)
        return stamps[keep], values[keep]

    folder = recorded(tmp_path / "dataset-room1_512_16" / "mav0", 14.0, spoil=thin)
    (sequence,) = euroc.read(folder, "tumvi")
    time, valid = known_time(sequence), sequence.valid
    assert np.linalg.norm(sequence.position - known_walk.position(time), axis=1)[valid].max() < 0.03
    assert np.abs(sequence.velocity - known_walk.velocity(time))[valid].max() < 0.5
    assert valid[(time < 5.9) | (time > 7.1)].all()
