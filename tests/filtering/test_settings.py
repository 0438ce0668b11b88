"""The filter that the settings of an experiment describe, and its numbers as free parameters."""

import jax
import numpy as np

from gnio_jax import filtering
from gnio_jax.filtering.settings import free_parameters, with_free_parameters
from tests.support.filter_settings import changed


def test_free_parameters_and_back():
    """Logarithms, and a share's logit; with a derivative; what is 0 is not there."""
    correlation = filtering.CorrelatedError(share=0.25, seconds=2.0)
    settings = changed(noise={"correlation": correlation, "gyro_bias_walk": 0.0})
    free = free_parameters(settings, ["noise", "start.gyro_bias"])
    assert {"noise.gyro_density", "noise.std_factor.0", "start.gyro_bias"} <= free.keys()
    assert "noise.gyro_bias_walk" not in free and "start.tilt" not in free
    np.testing.assert_allclose(free["noise.correlation.share"], np.log(1 / 3))
    np.testing.assert_allclose(free["noise.correlation.seconds"], np.log(2.0))
    again = with_free_parameters(settings, free)
    jax.tree.map(np.testing.assert_allclose, again, settings)
    slope = jax.grad(
        lambda u: with_free_parameters(settings, {"noise.correlation.share": u}).noise[6][0]
    )
    np.testing.assert_allclose(slope(np.log(1 / 3)), 0.25 * 0.75)
