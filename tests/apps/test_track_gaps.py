"""What the filter believes where samples are missing: nothing but what a walker may do.

All filters here have the settings of the network that comes with the package, which predicts
nothing.
"""

import numpy as np
import pytest

from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.data.resampling import resample
from gnio_jax.evaluation import estimate, no_displacements, prepare
from gnio_jax.filtering import InitialStd, make_filter
from gnio_jax.types import Sequence
from tests.support import known_walk

RATE, SECONDS = 50.0, 5.0
WINDOWS = DataConfig(rate=RATE)
SETTINGS = FilterSettings(
    start=InitialStd(1e-3, 1e-3, velocity=0.01, position=0.01, gyro_bias=1e-5, accel_bias=1e-3),
    measurements={"zero_velocity": {"std": 0.02}},
    gap_gyro_std=0.8,
    gap_accel_std=0.8,
)
FILTER = make_filter(WINDOWS, SETTINGS)
"""Sure of its start, so that what it doubts is the hole."""
HOLE = (1.5, 4.0)
"""s: the samples between are missing."""
DRAWS = 24


def recordings():
    """Parts of one walk, each with a hole and with the truth before it alone."""
    stamps = np.arange(0, SECONDS + 0.5 / RATE, 1 / RATE)
    recorded_stamps = stamps[(stamps < HOLE[0] + 1e-9) | (stamps > HOLE[1] - 1e-9)]
    for begin in np.linspace(0.0, 170.0, DRAWS):
        time = begin + recorded_stamps
        sequence = Sequence(
            name=f"{begin:.2f}",
            time=recorded_stamps,
            gyro=known_walk.rate(time),
            accel=known_walk.force(time),
            orientation=known_walk.attitude(time).as_quat(scalar_first=True),
            position=known_walk.position(time),
            velocity=known_walk.velocity(time),
            valid=np.ones(len(recorded_stamps), bool),
        )
        yield resample(sequence, RATE)


def nees(prepared):
    """Horizontal, of the position where the hole ends."""
    n = FILTER.config.samples_per_clone
    row = round(HOLE[1] * RATE) // n
    mute = [no_displacements(recording) for recording in prepared]
    estimates = estimate(prepared, mute, WINDOWS, FILTER, DRAWS)
    time = np.array([float(part.name) + HOLE[1] for part in estimates])
    error = np.array([part.trajectory.position[row] for part in estimates])
    error = (error - known_walk.position(time))[:, :2]
    covariance = np.array([part.filtered.covariance[row, :2, :2] for part in estimates])
    return np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2


@pytest.mark.slow
def test_the_true_end_of_a_hole_lies_within_what_the_filter_says():
    prepared, _ = prepare(recordings(), WINDOWS, FILTER)
    errors = nees(prepared)
    assert 0.4 < errors.mean() < 1.6 and (2 * errors < 11.8).mean() > 0.97  # 99.7 % of χ² with 2
    # The lines across the hole taken for measurements:
    believed = [
        recording._replace(imu_valid=np.ones_like(recording.imu_valid)) for recording in prepared
    ]
    assert nees(believed).mean() > 100.0
