"""Agreement with evo, where it is installed, of metrics and of the files of trajectories."""

import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.trajectory import align, write_tum
from tests.support.trajectories import STEP, moved_by, perturbed, walk


def test_agreement_with_evo(tmp_path):
    pytest.importorskip("evo.core.metrics")
    from evo.core import metrics as evo
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface

    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.1, -0.2, 0.7]), [5.0, -3.0, 1.0])
    yaw_only = perturbed(truth)._replace(orientation=truth.orientation)
    yaw_only = moved_by(yaw_only, Rotation.from_euler("z", 1.0), [1.0, 2.0, 3.0])
    reference, turned = (
        PoseTrajectory3D(t.position.copy(), t.orientation.copy(), t.time) for t in (truth, yaw_only)
    )
    write_tum(tmp_path / "estimate.txt", estimate)
    other = file_interface.read_tum_trajectory_file(tmp_path / "estimate.txt")

    def rmse(metric, path):
        metric.process_data((reference, path))
        return pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-8)

    part = evo.PoseRelation.translation_part
    assert metrics.ate(estimate.position, truth.position) == rmse(evo.APE(part), other)
    for seconds in (1.0, 10.0):
        rows = round(seconds / STEP)
        rpe = evo.RPE(part, delta=rows, delta_unit=evo.Unit.frames, all_pairs=True)
        assert metrics.rpe_se3(estimate, truth, STEP, seconds) == rmse(rpe, other)
    assert metrics.rpe(yaw_only, truth, STEP, 10.0) == rmse(rpe, turned)
    other.align(reference)
    aligned = align(estimate, truth, "se3").position
    assert metrics.ate(aligned, truth.position) == rmse(evo.APE(part), other)
