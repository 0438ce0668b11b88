"""`window_rotation="tlio"`: a recorded run of TLIO's tracker."""

from pathlib import Path

import jax
import numpy as np

from gnio_jax import filtering, interop, models
from tests.support import tlio_weights

RECORDED = Path(__file__).parents[1] / "recorded" / "tlio_tracker" / "pipeline.npz"


def test_the_whole_tracker_as_recorded():
    recorded, model = dict(np.load(RECORDED, allow_pickle=False)), models.create("tlio")
    dt, *lengths = (recorded[key] for key in ("dt", "samples_per_clone", "clones_per_window"))
    config = filtering.FilterConfig(dt, *lengths, window_rotation="tlio")
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16227766e-2, config.dt)

    @jax.jit
    def filtered(weights):
        start = (recorded[name] for name in ("rotation0", "velocity0", "position0"))
        inputs = (
            filtering.initial_state(filtering.Filter(config), *start),
            recorded["gyro"],
            recorded["accel"],
        )

        def predict(windows):
            return models.Inference(model)(weights, windows)

        return filtering.run_odometry(predict, filtering.Filter(config, noise), *inputs)[1]

    variables = interop.load_tlio_state_dict(tlio_weights.weights())
    history = filtered(models.inference_variables(model, variables))
    assert np.isnan(recorded["out_displacement"]).any(1).sum() == config.clones_per_window
    for name in ("displacement", "position", "velocity", "rotation", "gyro_bias", "accel_bias"):
        np.testing.assert_allclose(
            getattr(history, name), recorded[f"out_{name}"], atol=1e-5, rtol=0, err_msg=name
        )
    variances = recorded["out_measurement_covariance_diagonal"]
    np.testing.assert_allclose(history.measurement_std**2, variances, rtol=1e-4)
