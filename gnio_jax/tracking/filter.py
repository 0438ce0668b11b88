"""The filter of a track, of a recording and live."""

from __future__ import annotations

import dataclasses

from gnio_jax.filtering.settings import FilterSetup, filter_setup
from gnio_jax.training.checkpoint import Run

ZERO_VELOCITY_STD = 0.02
"""m/s that the filter measures while the IMU is quiet (ours): what lies on a table stays there."""
GAP_GYRO_STD, GAP_ACCEL_STD = 0.8, 0.8
"""rad/s and m/s²: what a carrier does unseen where samples are missing. Over a second walkers turn
by 0.5 to 0.8 rad and change their velocity by 0.5 to 0.7 m/s, root mean square of each axis, on
OxIOD and on computed walks; over two and three by less for each second (ours)."""


def tracking_filter(run: Run) -> FilterSetup:
    """The run's own filter, for which rest is a measurement too, and missing samples a walk."""
    setup = filter_setup(run.config.data, run.config.filter)
    config = dataclasses.replace(
        setup.config,
        zero_velocity_std=ZERO_VELOCITY_STD,
        gap_gyro_std=GAP_GYRO_STD,
        gap_accel_std=GAP_ACCEL_STD,
    )
    return setup._replace(config=config)
