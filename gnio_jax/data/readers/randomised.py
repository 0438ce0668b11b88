"""Ten hours of computed walks on which a network can learn to track people it has never met: each
walk has a walker, a gait, a way to carry the phone and an IMU of its own (`random_gait`).

The network that the package ships is trained on them. `synthetic` has the few walks of the demo.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.random_gait import CARRYING, random_errors, random_motion
from gnio_jax.data.readers.simulated_phone import device_attitude, imu, phone_sequence
from gnio_jax.types import Sequence

# split: (first seed, number of walks, seconds).
_SPLITS = {"train": (100_000, 600, 60.0), "val": (200_000, 40, 60.0), "test": (300_000, 24, 120.0)}


def random_walk(seed: int, seconds: float = 60.0, rate: float = 100.0) -> Sequence:
    """A walk of `seconds` at `rate` Hz with everything drawn from `seed`; starts with 3 s of
    standing. The true biases, at the start, are among the attributes."""
    rng = np.random.default_rng([11, seed])
    names = list(CARRYING)
    placement = str(rng.choice(names, p=[CARRYING[name].share for name in names]))
    count, dt = round(seconds * rate), 1.0 / rate
    errors = random_errors(rng)
    walk = random_motion(rng, CARRYING[placement], np.arange(count + 1) * dt, dt)
    samples = imu(rng, walk, dt, errors, with_errors=True)
    attributes = {
        "dataset": "randomised",
        "placement": placement,
        "seed": seed,
        "licence": DATASET.licence,
        "gyro_density": errors.gyro_density,
        "accel_density": errors.accel_density,
    }
    device = device_attitude(rng, walk, dt)
    return phone_sequence(_name(seed), walk, samples, device, attributes)


def recordings(root: Path | None, split: str) -> list[Recording]:
    """The walks of a split, not yet computed."""
    del root
    first, count, seconds = _SPLITS[split]
    return [single(_name(s), random_walk, s, seconds) for s in range(first, first + count)]


def _name(seed: int) -> str:
    return f"randomised_{seed}"


DATASET = Dataset(
    name="randomised",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=100.0,
    source="computed by gnio_jax.data.readers.randomised",
    layout="no files are needed",
    licence="Apache-2.0, as this package",
    needs_root=False,
)
