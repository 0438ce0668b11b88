"""Figures and paths of runs that are there already."""

import numpy as np

from gnio_jax import config as configuration
from gnio_jax.config import CalibrateConfig
from gnio_jax.evaluation.trajectory import Trajectory, write_tum
from gnio_jax.reporting import Lines
from gnio_jax.tables import matrix
from gnio_jax.tables.experiments import Cell
from gnio_jax.tables.matrix import Result
from tests.support.tables import BASE


def test_a_calibration_is_of_the_best_checkpoint(tmp_path, monkeypatch):
    run, made = tmp_path / "gnio_s0", []

    def calibrate(config, workers):
        made.append(config)
        (best,) = (run / "checkpoints" / "best").iterdir()
        (tmp_path / config.out / "checkpoints" / "best" / best.name).mkdir(parents=True)

    monkeypatch.setattr(matrix.calibration, "calibrate", calibrate)
    (run / "checkpoints" / "best" / "7").mkdir(parents=True)
    for _ in range(2):
        assert matrix.calibrated(run, Lines()) == tmp_path / "gnio_s0_calibrated"
    assert made == [CalibrateConfig(str(run), out=str(tmp_path / "gnio_s0_calibrated"))]
    # The run goes on and finds a better checkpoint: what was fitted to the old one is replaced.
    (run / "checkpoints" / "best" / "7").rename(run / "checkpoints" / "best" / "9")
    matrix.calibrated(run, Lines())
    (kept,) = (tmp_path / "gnio_s0_calibrated" / "checkpoints" / "best").iterdir()
    assert len(made) == 2 and kept.name == "9"


def test_paths_end_where_the_estimate_diverged(tmp_path):
    configuration.save(tmp_path / "config.yaml", BASE)
    time = np.arange(50) * 0.1
    position, level = np.column_stack([time, np.zeros((50, 2))]), np.tile([1.0, 0, 0, 0], (50, 1))
    seen, moved = position.copy(), position + np.array([3.0, 2.0, 1.0])
    seen[10:15] = np.nan
    moved[30:] = np.nan
    folder = tmp_path / "eval" / "tlio_test_ekf"
    for kind, path in (("references", seen), ("trajectories", moved)):
        (folder / kind).mkdir(parents=True)
        write_tum(folder / kind / "walk.txt", Trajectory(time, path, level))
    made = Result(Cell("a", "A", BASE), [{"sequences": {"walk": {}}}], [tmp_path])
    ((reference, estimate),) = matrix.paths(made, "test", "ekf").values()
    kept = np.r_[0:10, 15:50]
    np.testing.assert_allclose(reference, position[kept, :2], atol=1e-8)
    expected = np.where(kept[:, None] < 30, position[kept, :2], np.nan)
    np.testing.assert_allclose(estimate, expected, atol=1e-8)
