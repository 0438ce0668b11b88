"""`window_rotation="tlio"`: a recorded run of TLIO's tracker, windows cut by brute force, and the
same online."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, interop, models
from gnio_jax.types import Prediction
from tests.support import scekf_numpy, tlio_weights

# The recorded run
# ------------------------------------------------------------------------------------------------

RECORDED = Path(__file__).parents[1] / "recorded" / "tlio_tracker" / "pipeline.npz"


class Recorded(NamedTuple):
    wanted: dict[str, np.ndarray]
    variables: Any
    """The weights of the run."""
    run: Callable[..., filtering.FilterHistory]
    """(weights, samples by which the network's windows come too late) -> our history; one program
    for all."""


@pytest.fixture(scope="module")
def recorded():
    wanted, model = dict(np.load(RECORDED, allow_pickle=False)), models.create("tlio")
    dt = float(wanted["dt"])
    config = filtering.FilterConfig(
        dt, wanted["samples_per_clone"], wanted["clones_per_window"], window_rotation="tlio"
    )
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16227766e-2, dt)

    @jax.jit
    def filtered(frozen, late):
        def predict(windows):
            shifted = jnp.minimum(jnp.arange(config.window) + late, config.window - 1)
            return models.Inference(model)(frozen, jnp.take(windows, shifted, axis=1))

        state = filtering.initial_state(
            config, *(wanted[name] for name in ("rotation0", "velocity0", "position0"))
        )
        return filtering.run_odometry(
            predict, state, wanted["gyro"], wanted["accel"], config, noise
        )[1]

    return Recorded(
        wanted,
        interop.load_tlio_state_dict(tlio_weights.weights()),
        lambda variables, late=0: filtered(models.inference_variables(model, variables), late),
    )


def test_the_whole_tracker_as_recorded(recorded):
    history, wanted = recorded.run(recorded.variables), recorded.wanted
    assert np.isnan(wanted["out_displacement"]).any(1).sum() == wanted["clones_per_window"]
    for name in ("displacement", "position", "velocity", "rotation", "gyro_bias", "accel_bias"):
        np.testing.assert_allclose(
            getattr(history, name), wanted[f"out_{name}"], atol=1e-5, rtol=0, err_msg=name
        )
    np.testing.assert_allclose(
        history.measurement_std**2, wanted["out_measurement_covariance_diagonal"], rtol=1e-4
    )


def test_a_window_that_is_a_sample_late_would_be_seen(recorded):
    history, wanted = recorded.run(recorded.variables, 1), recorded.wanted
    assert np.nanmax(np.abs(history.displacement - wanted["out_displacement"])) > 1e-4
    assert np.abs(history.position - wanted["out_position"]).max() > 1e-4


def test_a_network_that_is_too_sure_is_held_to_the_floor(recorded):
    """Weights whose log standard deviation is below −4 for two axes, above it for the third."""
    variables = jax.tree.map(lambda leaf: leaf, recorded.variables)
    fixed = {
        "kernel": jnp.zeros((512, 3), jnp.float32),
        "bias": jnp.asarray([-9.0, -4.25, -1.5], jnp.float32),
    }
    variables["params"]["log_std"]["fc3"] = fixed
    variance = np.asarray(recorded.run(variables).measurement_std) ** 2
    assert np.isnan(variance[:20]).all()
    np.testing.assert_allclose(
        variance[20:], np.tile(10.0 * np.exp([-8.0, -8.0, -3.0]), (220, 1)), rtol=1e-12
    )


# Small networks
# ------------------------------------------------------------------------------------------------

N, CLONES, INTERVALS, DT = 4, 4, 40, 0.02
CONFIG = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    convergence_seconds=0.6,
    bridge_seconds=0.04,
    window_rotation="tlio",
)
WEIGHTS = np.random.default_rng(5).standard_normal((6, 3)) * 0.02
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=2.0)


def recording():
    rng = np.random.default_rng(0)
    t = np.arange(N * INTERVALS) * DT
    gyro = np.sin(t[:, None] * rng.uniform(2, 5, 3) + rng.uniform(0, 6, 3))
    return gyro, np.cos(t[:, None] * rng.uniform(2, 5, 3)) + Rotation.from_euler(
        "xyz", [0.3, -0.2, 1.0]
    ).inv().apply([0, 0, 9.81])


def start():
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    return filtering.initial_state(
        CONFIG, rotation, np.array([0.5, 0.0, 0.0]), np.zeros(3), np.array([0.2, -0.1, 0.3]), 0.1
    )


def predict(windows):
    ramp = jnp.linspace(0.5, 1.5, N * CLONES, dtype=jnp.float32)[None, :, None]
    pooled = jnp.mean(ramp * windows, axis=1) @ jnp.asarray(WEIGHTS, jnp.float32)
    return Prediction(pooled, -2.0 + 0.1 * pooled)


def by_hand(gyro, accel, lead, corrected, own):
    """The filter in NumPy, its windows cut sample by sample: they begin `lead` samples early, show
    biases or not, and a sample is turned by its own rate or by that of the one before."""

    def measure(k, clone_rotation, gyro_bias, accel_bias):
        first = (k - CLONES + 1) * N - lead
        unyaw, R, rows = scekf_numpy.yaw_matrix(clone_rotation).T, clone_rotation, []
        for j in range(first, first + N * CLONES):
            if j > first:
                R = (
                    R
                    @ Rotation.from_rotvec((gyro[j if own else j - 1] - gyro_bias) * DT).as_matrix()
                )
            w, a = (
                (gyro[j] - gyro_bias, accel[j] - accel_bias) if corrected else (gyro[j], accel[j])
            )
            rows.append(np.concatenate([unyaw @ R @ a, unyaw @ R @ w]))
        pooled = (np.linspace(0.5, 1.5, N * CLONES)[:, None] * np.array(rows)).mean(0) @ WEIGHTS
        return pooled, np.diag(np.exp(2 * np.maximum(-2.0 + 0.1 * pooled, -4.0)))

    options = {"n": N, "clones": CLONES, "convergence": 0.6, "scale": 2.0, "measure": measure}
    return scekf_numpy.run_from(start(), NOISE, DT, gyro, accel, **options)


@jax.jit
def scanned(valid):
    return filtering.run_odometry(predict, start(), *recording(), CONFIG, NOISE, valid)[1]


def test_windows_are_cut_as_described():
    gyro, accel = recording()
    history = scanned(np.ones(len(gyro), bool))
    wanted = by_hand(gyro, accel, 1, False, True)
    assert np.nansum(wanted["accepted"]) > 5
    np.testing.assert_array_equal(history.accepted, wanted["accepted"])
    for name in (
        "displacement",
        "position",
        "velocity",
        "rotation",
        "gyro_bias",
        "accel_bias",
        "innovation",
    ):
        np.testing.assert_allclose(getattr(history, name), wanted[name], atol=3e-6, err_msg=name)
    for other in [
        (0, False, True),
        (1, True, True),
        (1, False, False),
    ]:  # each of the three differences is large enough to be seen
        assert (
            np.nanmax(np.abs(by_hand(gyro, accel, *other)["displacement"] - wanted["displacement"]))
            > 1e-4
        )


def test_online_it_is_the_scan_and_a_gap_under_any_sample_of_a_window_voids_it():
    gyro, accel = recording()
    valid = ~np.isin(
        np.arange(len(gyro)), range(100, 104)
    )  # two are held, samples 102 and 103 are coasted through
    history = scanned(valid)
    # the last of these windows begins with sample 103, which drove the filter to the clone that it
    # starts from
    assert np.flatnonzero(np.isnan(np.asarray(history.displacement)[CLONES:, 0])).tolist() == [
        k - CLONES for k in (25, 26, 27, 28, 29)
    ]
    tracker = filtering.Tracker(predict, CONFIG, NOISE, start())
    found = {}
    for k in range(len(gyro)):
        pose = tracker.push(k * DT, np.where(valid[k], gyro[k], np.nan), accel[k])
        if pose is not None:
            found[round(pose.time / (N * DT)) - 1] = pose
    assert len(found) == INTERVALS
    for name in ("rotation", "velocity", "position", "gyro_bias", "accel_bias", "accepted", "nis"):
        rows = np.array([getattr(found[k], name) for k in range(INTERVALS)])
        np.testing.assert_allclose(rows, getattr(history, name), rtol=1e-9, atol=1e-9, err_msg=name)
    assert np.nansum(history.accepted) > 10
