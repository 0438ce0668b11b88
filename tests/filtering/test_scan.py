"""The filter against recorded runs of TLIO's tracker and against a plain NumPy filter."""

import functools
import itertools
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from tests.support import scekf_numpy, whole_covariance
from tests.support.random_walk import random_walk

RECORDED = Path(__file__).parents[1] / "recorded" / "scekf"
DECISIONS = ("accepted", "gate_passed")
# One program in place of one for every operation.
covariance = jax.jit(whole_covariance.covariance)
MEAN = ("rotation", "velocity", "position", "gyro_bias", "accel_bias")


def assert_close(found, wanted, absolute, relative=0.0):
    np.testing.assert_allclose(
        np.asarray(found), np.asarray(wanted), atol=absolute, rtol=relative, equal_nan=True
    )


def replay(name):
    run = dict(np.load(RECORDED / f"{name}.npz"))
    static = (
        run[key]
        for key in ("dt", "samples_per_clone", "clones_per_window", "mahalanobis_fail_scale")
    )
    config = filtering.FilterConfig(*static, history="core")
    state = filtering.initial_state(config, run["rotation0"], run["velocity0"], run["position0"])
    covariance = run["displacement_std"][:, :, None] ** 2 * np.eye(3)
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16227766e-2, config.dt)
    found = filtering.run_filter(
        state, run["gyro"], run["accel"], run["displacement"], covariance, config, noise
    )
    return run, *jax.device_get(found)


@pytest.mark.parametrize(
    "name",
    ["nominal_100hz_10hz", "nominal_200hz_20hz", "outliers_200hz_20hz", "fail_scale_200hz_10hz"],
)
def test_recorded_runs(name):
    run, final, history = replay(name)
    assert_close(history.position, run["out_position"], 1e-9)
    for field in MEAN:
        assert_close(getattr(history, field), run[f"out_{field}"], 1e-9)
    assert_close(history.covariance_diagonal, run["out_covariance_diagonal"], 0, 1e-8)
    sigma = np.sqrt(
        np.diag(run["out_final_covariance"])
    )  # off the diagonal, 1e-8 of what the two variances allow
    core = np.asarray(covariance(final))[:15, :15]
    assert_close(
        core / np.outer(sigma, sigma), run["out_final_covariance"] / np.outer(sigma, sigma), 1e-8
    )
    assert_close(history.covariance[-1], core, 1e-15, 1e-12)
    for field in DECISIONS:
        np.testing.assert_array_equal(getattr(history, field), run[f"out_{field}"])
    measured = np.isfinite(run["out_accepted"])
    assert_close(history.displacement[measured], run["displacement"][measured], 0)
    assert_close(
        history.measurement_std[measured], np.sqrt(10) * run["displacement_std"][measured], 0, 1e-12
    )
    for field in ("displacement", "measurement_std", "innovation", "nis"):
        np.testing.assert_array_equal(
            np.isfinite(getattr(history, field)).reshape(len(measured), -1).all(1), measured
        )


STD = filtering.InitialStd(
    tilt=0.02, yaw=0.01, velocity=0.3, position=0.02, gyro_bias=2e-3, accel_bias=0.05
)


def both(walk, config, chunks=()):
    """The filter (in pieces, where `chunks` says so) and the oracle over one walk, from wrong
    initial biases."""
    pose, *signals = walk
    start = filtering.initial_state(
        config, *pose, np.array([1e-4, -2e-4, 3e-4]), np.array([0.01, 0.02, -0.01]), STD
    )
    noise = filtering.NoiseModel.per_sample(4e-3, 2e-2, config.dt, 2e-3, 3e-3)
    n, state, histories = config.samples_per_clone, start, []
    for begin, end in itertools.pairwise([0, *chunks, len(signals[2])]):
        samples, rows = slice(begin * n, end * n), slice(begin, end)
        cut = [each[part] for each, part in zip(signals, [samples] * 2 + [rows] * 2, strict=True)]
        state, history = filtering.run_filter(state, *cut, config, noise)
        histories.append(history)
    history = jax.tree.map(lambda *parts: np.concatenate(parts), *histories)
    return state, history, scekf_numpy.run_from(start, noise, config, *signals, std=STD._asdict())


def assert_same(history, wanted, absolute=1e-9):
    for field in DECISIONS:
        np.testing.assert_array_equal(getattr(history, field), wanted[field], err_msg=field)
    for field in (*MEAN, "innovation", "displacement"):
        assert_close(getattr(history, field), wanted[field], absolute)
    assert_close(history.nis, wanted["nis"], 0, 1e-6)
    measured = np.isfinite(wanted["nis"])
    spread = wanted["innovation_covariance"][measured]
    likelihood = np.where(measured, -0.5 * wanted["nis"], np.nan)
    likelihood[measured] -= 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
    assert_close(history.log_likelihood, likelihood, 0, 1e-6)
    assert_close(history.covariance_diagonal, wanted["covariance_diagonal"], 0, 1e-7)
    sigma = np.sqrt(wanted["covariance_diagonal"])
    scale = sigma[:, :, None] * sigma[:, None, :]
    if history.covariance is not None:
        assert_close(history.covariance / scale, wanted["covariance"] / scale, 1e-7)


GATED = functools.partial(
    filtering.FilterConfig,
    0.02,
    5,
    4,
    convergence_seconds=1.0,
    success_seconds=0.3,
    pause_seconds=0.5,
    history="core",
)
# One rejected row; ten in a row, so that the gate gives up and pauses; rejected rows around missing
# ones.
OUTLIERS = (20, *range(30, 41), 48, 52)
MISSING = (7, 22, 23, 49, 50, 51, 60, 61, 62, 63, 64, 65)


@pytest.mark.parametrize("fail_scale", [0.0, 8.0])
def test_random_walk_with_missing_and_rejected_rows(fail_scale):
    walk = random_walk(1, n=5, clones=4, intervals=80, dt=0.02, nan_rows=MISSING, outliers=OUTLIERS)
    _, history, wanted = both(walk, GATED(mahalanobis_fail_scale=fail_scale))
    assert np.isnan(wanted["accepted"]).sum() == 4 + len(MISSING)
    rejected = wanted["gate_passed"] == 0
    assert (
        rejected.sum() >= 5 and (wanted["gate_passed"][list(OUTLIERS)] == 1).any()
    )  # the gate worked, and a pause let outliers pass
    assert (wanted["accepted"][rejected] == float(fail_scale > 0)).all()
    assert_same(history, wanted)


@pytest.mark.parametrize("cut", [40, 53])
def test_runs_in_pieces(cut):
    """A run goes on from the state that another returned: ring, gate and clock included. After 40
    intervals all clones have the core's anchor, after 53 three of them have the one before."""
    walk = random_walk(1, n=5, clones=4, intervals=80, dt=0.02, nan_rows=MISSING, outliers=OUTLIERS)
    _, history, wanted = both(walk, GATED(), chunks=[cut])
    assert_same(history, wanted)


@pytest.mark.parametrize("n,clones", [(1, 1), (7, 2)])
def test_other_intervals(n, clones):
    walk = random_walk(2, n=n, clones=clones, intervals=30, dt=0.05, nan_rows=(9, 10))
    _, history, wanted = both(
        walk, filtering.FilterConfig(0.05, n, clones, convergence_seconds=0.5)
    )
    assert history.covariance is None
    assert_same(history, wanted)


def test_gimbal_lock_is_no_update():
    (R, v, p), gyro, accel, displacement, covariance = random_walk(
        3, n=5, clones=4, intervals=40, dt=0.02
    )
    R = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    gyro[:] = np.array(
        [1e-4, -2e-4, 3e-4]
    )  # cancelled by the initial bias: the device stays on its nose until an update turns it
    accel[:] = R.T @ -scekf_numpy.G + np.array([0.01, 0.02, -0.01])
    displacement[4:] = 0.1
    _, history, wanted = both(((R, 0 * v, p), gyro, accel, displacement, covariance), GATED())
    assert (wanted["accepted"][4:] == 0).all() and (np.asarray(history.accepted)[4:] == 0).all()
    assert (np.asarray(history.gate_passed)[4:] == 0).all()
    assert np.isfinite(history.innovation[4:]).all() and np.isfinite(history.nis[4:]).all()
    for field in (*MEAN, "covariance_diagonal"):
        assert_close(getattr(history, field), wanted[field], 1e-9)


def test_covariance_stays_symmetric_and_positive():
    walk = random_walk(1, n=5, clones=4, intervals=80, dt=0.02, nan_rows=MISSING, outliers=OUTLIERS)
    state, _, _ = both(walk, GATED())
    whole = np.asarray(covariance(state))
    assert whole.shape == (45, 45)
    assert_close(whole, whole.T, 1e-14)
    newest = np.r_[39:45]  # the newest clone is the core's own pose
    assert_close(
        whole[newest][:, newest], whole[np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])], 1e-15
    )
    assert_close(state.clone_rotation[-1], state.rotation, 0)
    assert np.linalg.eigvalsh(whole).min() > -1e-12
