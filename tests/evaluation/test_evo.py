"""Agreement with evo, where it is installed."""

import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.trajectory import align
from tests.support.trajectories import STEP, moved_by, perturbed, walk


def test_agreement_with_evo():
    pytest.importorskip("evo.core.metrics")
    from evo.core import metrics as evo
    from evo.core.trajectory import PoseTrajectory3D

    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.1, -0.2, 0.7]), [5.0, -3.0, 1.0])
    paths = [
        PoseTrajectory3D(t.position.copy(), t.orientation.copy(), t.time) for t in (truth, estimate)
    ]

    def ape(reference, other):
        metric = evo.APE(evo.PoseRelation.translation_part)
        metric.process_data((reference, other))
        return metric.get_statistic(evo.StatisticsType.rmse)

    assert metrics.ate(estimate.position, truth.position) == pytest.approx(ape(*paths), rel=1e-9)
    for seconds in (1.0, 10.0):
        metric = evo.RPE(
            evo.PoseRelation.translation_part,
            delta=round(seconds / STEP),
            delta_unit=evo.Unit.frames,
            all_pairs=True,
        )
        metric.process_data(tuple(paths))
        assert metrics.rpe_se3(estimate, truth, STEP, seconds) == pytest.approx(
            metric.get_statistic(evo.StatisticsType.rmse), rel=1e-9
        )
    yaw_only = moved_by(
        perturbed(truth)._replace(orientation=truth.orientation),
        Rotation.from_euler("z", 1.0),
        [1.0, 2.0, 3.0],
    )
    metric.process_data(
        (
            paths[0],
            PoseTrajectory3D(yaw_only.position.copy(), yaw_only.orientation.copy(), yaw_only.time),
        )
    )
    ours = metrics.rpe(yaw_only, truth, STEP, 10.0)
    assert ours == pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-9)
    paths[1].align(paths[0])
    assert metrics.ate(align(estimate, truth, "se3").position, truth.position) == pytest.approx(
        ape(*paths), rel=1e-9
    )
