"""What a trained run does not know of its own errors, fitted on recordings that it did not learn
from."""

from gnio_jax.calibration.run import Calibration, calibrate

__all__ = ["Calibration", "calibrate"]
