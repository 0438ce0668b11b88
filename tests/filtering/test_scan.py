"""The filter against recorded runs of TLIO's tracker and against a plain NumPy filter."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import scan
from gnio_jax.filtering.state import CORRELATED
from gnio_jax.numerics import filled_up
from tests.support import scekf_numpy, whole_covariance
from tests.support.random_walk import random_walk

RECORDED = Path(__file__).parents[1] / "recorded" / "scekf"
DECISIONS = ("accepted", "gate_passed")
covariance = jax.jit(whole_covariance.covariance)
MEAN = ("rotation", "velocity", "position", "gyro_bias", "accel_bias")


def assert_close(values, expected, absolute, relative=0.0):
    np.testing.assert_allclose(
        np.asarray(values), np.asarray(expected), atol=absolute, rtol=relative, equal_nan=True
    )


def replay(name):
    run = dict(np.load(RECORDED / f"{name}.npz"))
    names = ("dt", "samples_per_clone", "clones_per_window", "mahalanobis_fail_scale")
    settings = {name: run[name] for name in names}
    config = filtering.FilterConfig(**settings, history="core", error="additive")
    state = filtering.initial_state(
        filtering.Filter(config), run["rotation0"], run["velocity0"], run["position0"]
    )
    covariance = run["displacement_std"][:, :, None] ** 2 * np.eye(3)
    signals = run["gyro"], run["accel"], run["displacement"], covariance
    if name.startswith("nominal_200hz"):  # filled up, it has the program of "outliers_200hz"
        fill = zip(signals, (7000, 7000, 700, 700), (0.0, 0.0, np.nan, np.nan), strict=True)
        signals = [filled_up(*arguments) for arguments in fill]
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16227766e-2, config.dt)
    final, history = jax.device_get(
        filtering.run_filter(filtering.Filter(config, noise), state, *signals)
    )
    rows = len(covariance)
    return run, rows == len(signals[2]), final, jax.tree.map(lambda leaf: leaf[:rows], history)


@pytest.mark.parametrize(
    "name",
    ["nominal_100hz_10hz", "nominal_200hz_20hz", "outliers_200hz_20hz", "fail_scale_200hz_10hz"],
)
def test_recorded_runs(name):
    run, whole, final, history = replay(name)
    for field in MEAN:
        assert_close(getattr(history, field), run[f"out_{field}"], 1e-9)
    assert_close(history.covariance_diagonal, run["out_covariance_diagonal"], 0, 1e-8)
    # off the diagonal, 1e-8 of what the two variances allow
    last, sigma = history.covariance[-1], np.sqrt(np.diag(run["out_final_covariance"]))
    scale = np.outer(sigma, sigma)
    assert_close(last / scale, run["out_final_covariance"] / scale, 1e-8)
    if whole:
        assert_close(last, np.asarray(covariance(final))[:15, :15], 1e-15, 1e-12)
    for field in DECISIONS:
        np.testing.assert_array_equal(getattr(history, field), run[f"out_{field}"])
    measured = np.isfinite(run["out_accepted"])
    assert_close(history.displacement[measured], run["displacement"][measured], 0)
    std = np.sqrt(10) * run["displacement_std"][measured]
    assert_close(history.measurement_std[measured], std, 0, 1e-12)
    for field in ("displacement", "measurement_std", "innovation", "nis"):
        finite = np.isfinite(getattr(history, field)).reshape(len(measured), -1).all(1)
        np.testing.assert_array_equal(finite, measured)


N, CLONES, INTERVALS, DT = 5, 4, 80, 0.02
STD = filtering.InitialStd(
    tilt=0.02, yaw=0.01, velocity=0.3, position=0.02, gyro_bias=2e-3, accel_bias=0.05
)
BIASES = np.array([1e-4, -2e-4, 3e-4]), np.array([0.01, 0.02, -0.01])
"""Where the filter begins, wrongly."""
GATED = functools.partial(
    filtering.FilterConfig,
    convergence_seconds=1.0,
    success_seconds=0.3,
    pause_seconds=0.5,
    history="core",
    error="additive",  # as the oracle has it
)
# One rejected row; ten in a row, so that the gate gives up and pauses; rejected rows around missing
# ones.
OUTLIERS = (20, *range(30, 41), 48, 52)
MISSING = (7, 22, 23, 49, 50, 51, 60, 61, 62, 63, 64, 65)
WALK = random_walk(
    1, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, nan_rows=MISSING, outliers=OUTLIERS
)
ERRORS = filtering.CorrelatedError(0.8, 0.3)
FAR = 23
"""The interval whose fix is a kilometre off."""


def noise_of(config, correlation=None):
    noise = filtering.NoiseModel.per_sample(4e-3, 2e-2, config.dt, 2e-3, 3e-3)
    return noise._replace(correlation=correlation)


def ours(config, noise, walk=WALK, measurements=(), every=None):
    """The filter over a walk, in pieces of `every` intervals."""
    pose, gyro, accel, *measured = walk
    state, histories = (
        filtering.initial_state(filtering.Filter(config, start=STD), *pose, *BIASES),
        [],
    )
    every, n = every or len(measured[0]), config.samples_per_clone
    for begin in range(0, len(measured[0]), every):
        rows, samples = slice(begin, begin + every), slice(begin * n, (begin + every) * n)
        signals = gyro[samples], accel[samples], *(column[rows] for column in measured)
        others = jax.tree.map(lambda leaf, rows=rows: leaf[rows], measurements)
        state, history = filtering.run_filter(
            filtering.Filter(config, noise), state, *signals, measurements=others
        )
        histories.append(history)
    return state, jax.tree.map(lambda *parts: np.concatenate(parts), *histories)


def oracle(config, noise, walk=WALK, **others):
    start = filtering.initial_state(filtering.Filter(config, start=STD), *walk[0], *BIASES)
    return scekf_numpy.run_from(start, noise, config, *walk[1:], std=STD._asdict(), **others)


@functools.cache
def plain():
    return ours(GATED(DT, N, CLONES), noise_of(GATED(DT, N, CLONES)))


def assert_same(history, expected):
    for field in DECISIONS:
        np.testing.assert_array_equal(getattr(history, field), expected[field], err_msg=field)
    for field in (*MEAN, "innovation", "displacement"):
        assert_close(getattr(history, field), expected[field], 1e-9)
    assert_close(history.nis, expected["nis"], 0, 1e-6)
    measured = np.isfinite(expected["nis"])
    spread = expected["innovation_covariance"][measured]
    likelihood = np.where(measured, -0.5 * expected["nis"], np.nan)
    likelihood[measured] -= 0.5 * np.linalg.slogdet(2 * np.pi * spread)[1]
    assert_close(history.log_likelihood, likelihood, 0, 1e-6)
    assert_close(history.covariance_diagonal, expected["covariance_diagonal"], 0, 1e-7)
    sigma = np.sqrt(expected["covariance_diagonal"])
    scale = sigma[:, :, None] * sigma[:, None, :]
    if history.covariance is not None:
        assert_close(history.covariance / scale, expected["covariance"] / scale, 1e-7)


def drawn_fixes(axes):
    """{k: (position, covariance, seconds before the end, standard deviation of the time)} near to
    where the filter without fixes is, before the ring is full and after each move of the anchor."""
    rng, (_, history) = np.random.default_rng(axes), plain()
    fixes = {}
    for k in (0, 2, 7, 8, 11, FAR, 24, 30, 38, 66):
        root = 0.2 * (np.eye(axes) + 0.3 * rng.normal(size=(axes, axes)))
        before = rng.uniform(-0.5, 0.5) * N * DT * (k > 0)
        z = np.asarray(history.position[k] - before * history.velocity[k])[:axes]
        z = z + root @ rng.normal(size=axes)
        z[0] += 1000.0 * (k == FAR)
        fixes[k] = z, root @ root.T, before, 0.1
    return fixes


def interval_fixes(fixes):
    """As the filter takes them, on a clock that begins at 100 s."""
    time = [100.0 + (k + 1) * N * DT - before for k, (_, _, before, _) in fixes.items()]
    position, covariance, _, time_std = (np.stack(x) for x in zip(*fixes.values(), strict=True))
    config = GATED(DT, N, CLONES)
    return filtering.fixes_on_intervals(
        time, position, covariance, INTERVALS, config, 100.0, time_std[0]
    )


@pytest.mark.parametrize(
    "fail_scale, correlation, axes, every",
    [(0.0, None, 0, None), (8.0, ERRORS, 2, 10), (0.0, ERRORS, 3, 8)],
    ids=["plain", "scaled, correlated, fixes, in rounds", "correlated, whole fixes, in pieces"],
)
def test_random_walk(fail_scale, correlation, axes, every):
    """With missing and rejected rows. A run goes on from the state that another returned: ring,
    gate and clock included. Pieces of 8 intervals end within a round of the ring of 5, and pieces
    of 10 with a whole round."""
    config = GATED(DT, N, CLONES, mahalanobis_fail_scale=fail_scale)
    noise, fixes = noise_of(config, correlation), drawn_fixes(axes) if axes else {}
    measurements = (interval_fixes(fixes),) if axes else ()
    final, history = ours(config, noise, measurements=measurements, every=every)
    expected = oracle(config, noise, fixes=fixes)
    assert np.isnan(expected["accepted"]).sum() == 4 + len(MISSING)
    rejected = expected["gate_passed"] == 0
    # the gate worked, and a pause let outliers pass
    assert rejected.sum() >= 5 and (expected["gate_passed"][list(OUTLIERS)] == 1).any()
    assert (expected["accepted"][rejected] == float(fail_scale > 0)).all()
    assert_same(history, expected)
    if correlation is not None:
        assert np.abs(expected["correlated"][-1]).min() > 1e-3
        assert_close(final.correlated, expected["correlated"][-1], 1e-9)
        spread = final.core_covariance[CORRELATED, CORRELATED]
        assert_close(spread, expected["correlated_covariance"][-1], 1e-12, 1e-7)
    if axes:
        outcome = history.outcomes["fix"]
        presence = np.isfinite(expected["fix_nis"])
        np.testing.assert_array_equal(outcome.present, presence)
        refused = np.flatnonzero(presence & ~np.asarray(outcome.accepted))
        assert FAR in refused and len(refused) < len(fixes) / 2
        assert_close(outcome.nis[presence], expected["fix_nis"][presence], 0, 1e-6)


def test_what_was_measured_can_be_given_again():
    config = GATED(DT, N, CLONES)
    noise = noise_of(config)._replace(std_factor=(1.5, 0.5, 2.0))
    _, history = ours(config, noise)
    displacement, covariance = WALK[-2:]
    measured = np.isfinite(history.nis)
    assert np.abs(covariance[measured][:, 0, 1]).min() > 0 and measured.sum() > INTERVALS / 2
    for values, expected in zip(
        history.unscaled_displacements(noise), (displacement, covariance), strict=True
    ):
        assert_close(values[measured], expected[measured], 0, 1e-12)


def test_without_size_and_without_fixes_nothing_changes():
    """Also where the only fix is refused. The variance of a correlated error is 1 at all times."""
    config, (_, reference) = GATED(DT, N, CLONES), plain()
    none = interval_fixes(drawn_fixes(3))
    none.position[:] = np.nan
    none.position[FAR] = 1e6
    nothing = noise_of(config, ERRORS._replace(share=0.0))
    final, history = ours(config, nothing, measurements=(none,), every=8)
    for name in history._fields:
        if name not in ("outcomes", "diagnostics"):
            assert_close(getattr(history, name), getattr(reference, name), 1e-12, 1e-9)
    assert_close(final.core_covariance[CORRELATED, CORRELATED], np.eye(3), 1e-12)
    # Another noise, as arrays, and a state that a run left compile nothing.
    compiled = scan._run_filter._cache_size()
    ours(config, jax.tree.map(jnp.asarray, noise_of(config, ERRORS)), measurements=(none,), every=8)
    assert scan._run_filter._cache_size() == compiled


def test_the_shortest_intervals_and_windows():
    walk = random_walk(2, n=1, clones=1, intervals=30, dt=0.05, nan_rows=(9, 10))
    config = filtering.FilterConfig(0.05, 1, 1, convergence_seconds=0.5, error="additive")
    _, history = ours(config, noise_of(config), walk)
    assert history.covariance is None
    assert_same(history, oracle(config, noise_of(config), walk))
