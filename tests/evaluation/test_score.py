"""`gnio score`: any two files in TUM format, matched by their stamps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import Trajectory, score_files
from gnio_jax.evaluation.trajectory import write_tum
from tests.support.command_lines import run
from tests.support.trajectories import moved_by, perturbed, walk

SPIN = Rotation.from_euler("z", 0.7)


@pytest.fixture
def files(tmp_path):
    def write(reference, estimate):
        for name, path in (("truth", reference), ("odometry", estimate)):
            write_tum(tmp_path / f"{name}.txt", path)
        return tmp_path / "truth.txt", tmp_path / "odometry.txt"

    return write


def thinned(path, every, shift=0.0, seed=0):
    """Every few rows of it, with stamps that are off by up to 4 ms."""
    rows = slice(None, None, every)
    off = np.random.default_rng(seed).uniform(-0.004, 0.004, len(path.time[rows]))
    return Trajectory(path.time[rows] + off + shift, *(part[rows] for part in path[1:]))


@pytest.mark.parametrize("of_truth, of_estimate", [(1, 5), (5, 1), (2, 3)])
def test_poses_are_matched_as_evo_matches_them(files, of_truth, of_estimate):
    pytest.importorskip("evo.core.sync")
    from evo.core import metrics, sync
    from evo.tools.file_interface import read_tum_trajectory_file

    whole = walk()
    truth = thinned(whole, of_truth)
    truth = Trajectory(*(np.delete(part, slice(20, 40), axis=0) for part in truth))
    estimate = thinned(moved_by(perturbed(whole), SPIN, [5.0, 1.0, 0.0]), of_estimate, seed=1)
    places = files(truth, estimate)
    reference, other = sync.associate_trajectories(*map(read_tum_trajectory_file, places))
    for how in ("none", "se3"):
        values = score_files(*places, how).scores["odometry"].values
        if how == "se3":
            other.align(reference)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((reference, other))
        statistics = ape.get_all_statistics()
        names = {"ate": "rmse", "ate_mean": "mean", "ate_median": "median", "ate_max": "max"}
        for name, theirs in names.items():
            assert values[name] == pytest.approx(statistics[theirs], rel=1e-6), (how, name)


def test_the_nearer_of_two_poses_counts(files):
    truth = walk()
    near, far = (truth._replace(time=truth.time + delay) for delay in (0.003, -0.007))
    wrong = far._replace(position=far.position + 1.0)
    pairs = (np.stack(poses, 1) for poses in zip(wrong, near, strict=True))
    estimate = Trajectory(*(part.reshape(-1, *part.shape[2:]) for part in pairs))
    assert score_files(*files(truth, estimate), "none").scores["odometry"].values["ate"] < 1e-6


def test_every_pose_counts_if_stamps_are_uneven(files):
    """Every second pose is 20 ms after the one before it, and has an error of 1 m."""
    whole = walk()
    time = np.stack([whole.time, whole.time + 0.02], 1).ravel()
    truth = Trajectory(time, *(np.repeat(part, 2, axis=0) for part in whole[1:]))
    off = np.tile([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], (len(whole.time), 1))
    estimate = truth._replace(position=truth.position + off)
    places = files(truth, estimate)
    report = score_files(*places, "none")
    assert report.scores["odometry"].values["ate"] == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert f"{len(time):,} poses" in report.settings["split"]


def pieces_by_frames(estimate, truth):
    """KITTI's errors (%, °/m) by its own loop over frames, ten apart, whatever their stamps."""
    poses = []
    for path in (estimate, truth):
        matrices = np.tile(np.eye(4), (len(path.time), 1, 1))
        turns = Rotation.from_quat(path.orientation, scalar_first=True)
        matrices[:, :3, :3], matrices[:, :3, 3] = turns.as_matrix(), path.position
        poses.append(matrices)
    sides = np.linalg.norm(np.diff(truth.position, axis=0), axis=1)
    walked, errors = np.concatenate([[0.0], np.cumsum(sides)]), []
    for i in range(0, len(walked), 10):
        for length in range(100, 801, 100):
            further = np.flatnonzero(walked > walked[i] + length)
            if len(further):
                motions = [np.linalg.solve(path[i], path[further[0]]) for path in poses]
                error = np.linalg.solve(*motions)
                cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
                shares = np.linalg.norm(error[:3, 3]), np.degrees(np.arccos(cosine))
                errors.append(np.array(shares) / length)
    return np.mean(errors, axis=0) * [100, 1]


@pytest.mark.parametrize("kind", ["as KITTI's", "jitter", "slower towards the end"])
def test_a_rate_that_is_not_constant_breaks_no_stretch(files, kind):
    """Stamps whose median step is not their mean, as KITTI's of 10 Hz, are consecutive rows."""
    rng, rows = np.random.default_rng(3), 1500
    step = {
        "as KITTI's": rng.choice([0.1033, 0.1034, 0.1039], rows),
        "jitter": 0.1 + np.diff(rng.uniform(-0.02, 0.02, rows + 1)),
        "slower towards the end": np.linspace(0.1, 0.108, rows),
    }[kind]
    time = np.cumsum(step)
    yaw = 0.3 * np.sin(0.05 * time)
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, 0.02 * np.sin(time), 0 * yaw], 1))
    position = np.cumsum(attitude.apply([9.0, 0.0, 0.0]) * step[:, None], axis=0)
    position[700:800] = position[700]  # it stands still
    position[800:] += position[700] - position[799]
    poses = np.roll(attitude.as_quat(), 1, axis=1)
    truth = Trajectory(time, position, poses)
    estimate = perturbed(truth, scale=0.05)
    values = score_files(*files(truth, estimate)).scores["odometry"].values
    translation, rotation = pieces_by_frames(estimate, truth)
    assert values["t_rel"] == pytest.approx(translation, rel=1e-4)
    assert values["r_rel"] == pytest.approx(rotation, rel=1e-4)
    assert values["duration"] == pytest.approx(time[-1] - time[0])
    moved = np.linalg.norm(np.diff(position, axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(moved)])
    stops = np.searchsorted(walked, walked + 10.0 - 1e-9)
    starts = np.flatnonzero(stops < rows)
    turn = Rotation.from_quat(truth.orientation[0], scalar_first=True)
    turn = turn * Rotation.from_quat(estimate.orientation[0], scalar_first=True).inv()
    _, _, z, w = turn.as_quat()
    turn = Rotation.from_euler("z", 2 * np.arctan2(z, w))
    error = turn.apply(estimate.position) - truth.position
    of_pieces = error[stops[starts]] - error[starts]
    rms = np.sqrt(np.mean(np.sum(of_pieces**2, axis=1)))
    assert values["rte_10m"] == pytest.approx(rms, rel=1e-4)
    assert values["stationary_drift"] is not None


def test_metrics_over_time_use_the_stamps(files):
    """A second has as many rows as the stamps say, also where poses are missing. A constant error
    of the heading does not change displacements."""
    truth = walk()
    estimate = moved_by(truth, SPIN, [5.0, 1.0, 0.0])
    holed = Trajectory(*(np.delete(part, slice(300, 417), axis=0) for part in estimate))
    values = score_files(*files(truth, holed)).scores["odometry"].values
    assert values["rpe_1s"] < 1e-6 and values["ate"] < 1e-6
    assert values["duration"] == pytest.approx(truth.time[-1] - truth.time[0])


def test_the_command_prints_the_table_of_an_evaluation(files, capsys):
    truth = walk()
    estimate = truth._replace(position=truth.position * [1.02, 1.02, 1.0])
    run("score", *map(str, files(truth, estimate)), "--alignment", "none")
    output = capsys.readouterr().out
    ate = 0.02 * np.sqrt(np.mean(np.sum(truth.position[:, :2] ** 2, axis=1)))
    assert f" {ate:.2f} " in output and "1.02" in output and "never_moves" in output
    assert "odometry.txt against 900 poses of truth.txt" in output and "none alignment" in output
