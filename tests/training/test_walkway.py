"""Walks at another pace: position and acceleration belong together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax.config import AugmentConfig
from gnio_jax.training.walkway import (
    Pace,
    SlowMotion,
    change_pace,
    draw_pace,
    slow_motion,
    unchanged,
)

RATE, DT = 100.0, 0.01
UP = np.array([0, 0, 9.81])


def walk(samples=3000):
    """Positions of somebody who walks in curves, starts and stops, with steps."""
    t = np.arange(samples) * DT
    speed = 1.2 * np.clip(np.sin(0.3 * t) + 0.6, 0, 1)
    heading = 0.5 * np.sin(0.2 * t) + 0.1 * t
    x, y = (np.cumsum(speed * turn(heading)) * DT for turn in (np.cos, np.sin))
    steps = [0.02 * np.sin(11 * t), 0.03 * np.sin(5.5 * t), 0.025 * np.cos(11 * t)]
    return np.stack([x, y, 0 * t], axis=1) + np.stack(steps, axis=1)


def integrated(accel, position):
    """As the filter does, from the first two positions: v' = v + a Δt, p' = p + ½ (v + v') Δt."""
    velocity = (position[1] - position[0]) / DT - 0.5 * accel[0] * DT
    path = [position[0]]
    for a in accel[:-1]:
        path.append(path[-1] + velocity * DT + 0.5 * a * DT**2)
        velocity = velocity + a * DT
    return np.stack(path)


def accelerations(position):
    """With which `integrated` gives these positions: velocities follow from one another."""
    steps, velocity, accel = np.diff(position, axis=0) / DT, None, []
    velocity = steps[0]
    for step in steps:
        accel.append(2 * (step - velocity) / DT)
        velocity = 2 * step - velocity
    return np.array([*accel, accel[-1]])


def test_the_slow_motion_is_its_acceleration_integrated_twice():
    position = walk()
    usable = np.ones(len(position), bool)
    usable[1000:1100] = False
    position[1000:1100] = np.nan
    slow = slow_motion(np.where(usable[:, None], position, 0.0), usable, RATE)
    for rows in (slice(0, 1000), slice(1100, None)):
        path = integrated(slow.accel[rows], slow.position[rows])
        np.testing.assert_allclose(path, slow.position[rows], atol=1e-8)
        # It is the walk without its steps.
        inner = slice(rows.start + 300, (rows.stop or len(position)) - 300)
        assert np.abs(slow.position[inner] - position[inner]).max() < 0.15
        assert np.abs(slow.accel[inner]).max() < 1.0
    assert not slow.position[1000:1100].any() and not slow.accel[1000:1100].any()


def test_a_short_stretch_is_no_error():
    position = walk()[:3]
    slow = slow_motion(position, np.array([True, False, True]), RATE)
    assert np.isfinite(slow.position).all() and np.isfinite(slow.accel).all()


@pytest.mark.parametrize(
    "walkway, gain, vertical", [(1.0, 1.0, 1.0), (1.7, 1.0, 0.5), (0.6, 1.3, 1.2)]
)
def test_changed_accelerations_integrate_to_changed_positions(walkway, gain, vertical):
    position = walk(1500)
    with jax.enable_x64(True):
        slow = slow_motion(position, np.ones(len(position), bool), RATE)
        accel = accelerations(position) + UP
        pace = Pace(*(jnp.array([x]) for x in (walkway, gain, vertical, 1.0)))
        arguments = (jnp.asarray(x)[None] for x in (accel, position))
        batch = SlowMotion(*(jnp.asarray(x)[None] for x in slow))
        changed, moved = jax.device_get(jax.jit(change_pace)(*arguments, batch, pace))
    path = integrated(changed[0] - UP, moved[0])
    np.testing.assert_allclose(path, moved[0], atol=1e-6)
    speeds = [np.abs(np.diff(x[400:-400:100], axis=0)[:, :2]).mean() for x in (moved[0], position)]
    assert speeds[0] / speeds[1] == pytest.approx(walkway, rel=0.05)
    steps = [
        np.std((x - slow.position * [k, k, 1])[300:-300], axis=0)
        for x, k in ((moved[0], walkway), (position, 1.0))
    ]
    expected = np.array([gain, gain, gain * vertical])
    moves = steps[1] > 1e-6
    assert moves[2] and steps[0][moves] / steps[1][moves] == pytest.approx(
        expected[moves], rel=1e-3
    )


def test_factors_are_drawn_within_their_bounds():
    config = AugmentConfig(
        walkway_share=0.25,
        walkway=(0.5, 2.0),
        alternating_gain=(0.8, 1.25),
        vertical_gain=(0.3, 1.5),
        time_stretch=(1.0, 1.5),
    )
    pace = jax.device_get(draw_pace(jax.random.key(0), 4000, config))
    moved = pace.walkway != 1
    assert 0.2 < moved.mean() < 0.3
    for values, low, high in (
        (pace.walkway[moved], 0.5, 2.0),
        (pace.gain, 0.8, 1.25),
        (pace.vertical_gain, 0.3, 1.5),
        (pace.stretch, 1.0, 1.5),
    ):
        share = (np.log(values) - np.log(low)) / (np.log(high) - np.log(low))
        assert -1e-6 < share.min() < 0.01 and 0.99 < share.max() < 1 + 1e-6
        assert share.mean() == pytest.approx(0.5, abs=0.03)
    factors = np.log([pace.gain, pace.vertical_gain, pace.stretch])
    assert np.abs(np.corrcoef(factors) - np.eye(3)).max() < 0.06
    plain = jax.device_get(draw_pace(jax.random.key(0), 5, AugmentConfig()))
    jax.tree.map(np.testing.assert_array_equal, plain, unchanged(5))
