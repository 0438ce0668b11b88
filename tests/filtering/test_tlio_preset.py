"""`window_rotation="tlio"`: a recorded run of TLIO's tracker."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering, interop, models
from tests.support import tlio_weights

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
