"""All metrics of a sequence: names, reasons, divergence."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Trajectory
from tests.support.trajectories import STEP, lost, masked, moved_by, perturbed, walk


def test_untrusted_rows_count_nowhere():
    truth = walk()
    estimate = perturbed(truth)
    wrong = estimate._replace(position=estimate.position.copy())
    wrong.position[100:150] += 1e3
    reference = masked(truth, slice(100, 150))
    kept = np.r_[0:100, 150:900]
    assert metrics.ate(wrong.position, reference.position) == pytest.approx(
        metrics.ate(estimate.position[kept], truth.position[kept])
    )
    a, b = metrics.measure(wrong, reference), metrics.measure(estimate, reference)
    assert a == b and not a.undefined


def test_a_reference_without_orientation_is_no_divergence():
    """Its rows count where no attitude is needed; the first that has one aligns the estimate."""
    truth = walk()
    reference = truth._replace(orientation=truth.orientation.copy())
    reference.orientation[:50] = np.nan
    estimate = moved_by(truth, Rotation.from_euler("z", 1.0), [5.0, -3.0, 1.0])
    found = metrics.measure(estimate, reference)
    assert not found.undefined
    for name in ("ate", "rpe_10s", "rpe_se3", "yaw_rmse"):
        assert found.values[name] == pytest.approx(0, abs=1e-6)
    broken = estimate._replace(orientation=estimate.orientation.copy())
    broken.orientation[-50:] = np.nan  # of the estimate it is
    for value in (
        metrics.yaw_rmse(broken.orientation, reference.orientation),
        metrics.rpe(broken, reference, STEP, 1.0),
    ):
        assert np.isnan(value)


def test_measure_names_and_reasons():
    truth = walk()
    found = metrics.measure(perturbed(truth), truth, nis=np.array([np.nan, 3.0, 3.0]))
    assert not found.undefined
    assert {
        "ate",
        "ate_2d",
        "ate_ronin_2d",
        "ate_mean",
        "rte_60s",
        "rte_60s_ronin_2d",
        "rte_1m",
        "rte_10m_2d",
        "rpe_1s",
        "rpe_10s_2d",
        "rpe_se3",
        "drift",
        "yaw_rmse",
        "yaw_drift",
        "path_length_ratio",
        "stationary_drift",
        "nis",
        "nis_coverage",
        "duration",
        "path_length",
    } <= found.values.keys()
    assert found.values["nis"] == pytest.approx(1.0) and found.values["duration"] == pytest.approx(
        89.9
    )
    without = metrics.measure(truth, masked(truth, slice(None)))
    assert without.values["ate"] is None and without.undefined["ate"] == "no trusted reference"
    assert without.values["duration"] == pytest.approx(89.9)
    short = metrics.measure(*(Trajectory(*(field[:5] for field in truth)) for _ in range(2)))
    assert (
        short.values["ate"] == 0.0
        and short.values["rpe_1s"] is None
        and "1 s" in short.undefined["rpe_1s"]
    )
    broken = truth._replace(position=truth.position.copy())
    broken.position[100:] = np.nan
    assert (
        metrics.measure(broken, truth).undefined["rpe_1s"]
        == "the estimate is not finite from 10.0 s on"
    )


def test_a_diverged_estimate_has_infinite_errors():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3))
    arguments = {"position_covariance": covariance, "nis": np.full(900, 3.0)}
    estimate = perturbed(truth)
    whole = metrics.measure(estimate, truth, **arguments)
    broken = metrics.measure(lost(estimate, 500), truth, **arguments)
    given = {"duration", "path_length"}
    coverages = {"nees_coverage", "nees_coverage_2d", "nis_coverage"}
    assert broken.values.keys() == whole.values.keys() and not whole.undefined
    infinite = {name for name, value in broken.values.items() if value == np.inf}
    assert infinite == whole.values.keys() - given - coverages
    assert all(broken.values[name] == 0 for name in coverages)
    assert all(broken.values[name] == whole.values[name] for name in given)
    assert set(broken.undefined.values()) == {"the estimate is not finite from 50.0 s on"}
    assert metrics.is_infinite(broken.undefined["ate"])
    far = estimate._replace(position=np.full((900, 3), 1e300))
    far.position[0] = 0
    found = metrics.measure(far, truth)
    assert found.values["ate"] == np.inf and metrics.is_infinite(found.undefined["ate"])


def test_what_is_not_defined_has_not_diverged():
    """Without a reference, too short or never standing there is no error that could be infinite."""
    truth = walk()
    blind = metrics.measure(lost(truth, 500), masked(truth, slice(None)))
    assert blind.values["ate"] is None and blind.undefined["ate"] == "no trusted reference"
    pair = (Trajectory(*(part[:5] for part in path)) for path in (lost(truth, 3), truth))
    short = metrics.measure(*pair)
    assert short.values["ate"] == np.inf and short.values["rpe_1s"] is None
    assert not metrics.is_infinite(short.undefined["rpe_1s"])
