"""Tables that take as little time as can be: short walks, and a calibration of one unknown."""

import dataclasses

from gnio_jax import calibration
from gnio_jax.calibration import run as calibration_run
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data.simulated import walks

WALKS = {"train": (1000, 0, 2, 2), "val": (2000, 9, 1, 1), "test": (3000, 8, 1, 1)}
"""Splits, as `data.simulated.walks` has them, but for the seconds."""


def patch(context):
    """Synthetic walks have 20 s until the context `context` of pytest's monkeypatch ends."""
    calibrate = calibration.calibrate

    def quickly(config, **more):
        return calibrate(dataclasses.replace(config, fit=("measurement",)), **more)

    splits = {split: (*numbers, 20.0) for split, numbers in WALKS.items()}
    context.setattr(walks, "_SPLITS", splits)
    context.setattr(calibration, "calibrate", quickly)
    context.setattr(calibration_run, "MOST_STEPS", 1)


def base(rate, epochs, width=4):
    """The experiment from which the rows are derived."""
    return TrainConfig(
        dataset="synthetic",
        data=DataConfig(rate=rate, train_stride_seconds=0.5),
        model=ModelConfig(width=width),
        optim=OptimConfig(epochs=epochs, batch_size=8, learning_rate=1e-3),
    )
