"""A computed surveyor: a phone held before the body, straight legs, and taps where they end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from gnio_jax.data.simulated.walker import PhoneMotion, integral, smooth_steps, wander
from gnio_jax.data.simulated.walks import PHONE, walk_sequence
from gnio_jax.numerics import about_z
from gnio_jax.types import Sequence, Waypoints

RATE = 50.0


class Survey(NamedTuple):
    """A walk whose truth is known, and where and when its legs end."""

    truth: Sequence
    ends: np.ndarray
    """s; the first is the start."""

    def tapped(self, early_or_late: np.ndarray) -> Sequence:
        """The walk as a surveyor records it: without poses, each waypoint tapped so many s late."""
        nothing = np.full_like(self.truth.position, np.nan)
        at = np.searchsorted(self.truth.time, self.ends)
        time = np.clip(self.ends + early_or_late, self.truth.time[0], self.truth.time[-1])
        return self.truth._replace(
            orientation=np.full_like(self.truth.orientation, np.nan),
            position=nothing,
            velocity=nothing,
            valid=np.zeros_like(self.truth.valid),
            waypoints=Waypoints(time, self.truth.position[at, :2]),
        )


def survey(seed: int, legs: int = 8, pause: float = 0.0) -> Survey:
    """Legs of 4 to 9 s at about 1.1 m/s with corners between them; the surveyor stands still for
    `pause` (s) after every third leg."""
    rng = np.random.default_rng([38, seed])
    lengths, turns = rng.uniform(4.0, 9.0, legs), rng.uniform(-1.8, 1.8, legs)
    waits = np.where(np.arange(legs) % 3 == 2, pause, 0.0)
    ends = np.cumsum(lengths + waits)
    time = np.arange(round((ends[-1] + 0.5) * RATE) + 1) / RATE
    leg = np.minimum(np.searchsorted(ends, time, side="right"), legs - 1)
    standing = time > (ends - waits)[leg]
    pace = rng.uniform(0.9, 1.35)
    speed = smooth_steps(np.where(standing, 0.0, pace), 0.8, 1 / RATE)
    speed = speed * (1.0 + 0.1 * wander(rng, time, 1, 1.0, 0.03, 0.3)[:, 0])
    heading = smooth_steps(np.cumsum(turns)[leg], 0.8, 1 / RATE)
    course = np.stack([np.cos(heading), np.sin(heading)], axis=1) * speed[:, None]
    phase = 2.0 * np.pi * integral(time, 1.8 * speed / pace)
    gait = np.stack([0.01 * np.sin(phase), 0.015 * np.sin(phase / 2), 0.02 * np.cos(phase)], axis=1)
    turn = about_z(heading)
    position = np.column_stack([integral(time, course), np.zeros(len(time))]) + turn.apply(gait)
    path = make_interp_spline(time, position, k=5)
    aim, tilt = rng.normal(0.0, 0.05), rng.uniform(0.2, 0.7)
    held = Rotation.from_euler("ZXY", [aim - np.pi / 2, tilt, rng.normal(0.0, 0.05)])
    attitude = turn * Rotation.from_rotvec(wander(rng, time, 3, 0.05, 0.02, 0.9)) * held
    motion = PhoneMotion(time, path(time) - path(0.0), path.derivative()(time), attitude)
    truth = walk_sequence(rng, f"survey {seed}", motion, 1 / RATE, PHONE, {})
    return Survey(truth, np.concatenate([[0.0], ends]))
