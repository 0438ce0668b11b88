"""The fit of a trained run's uncertainty to its errors on recordings that were not used for
training."""

from gnio_jax.calibration.run import Calibration, calibrate

__all__ = ["Calibration", "calibrate"]
