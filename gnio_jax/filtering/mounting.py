"""The mounting of an IMU in a car, found from a drive without any position (ours).

Over a piece of some seconds the IMU determines the velocity in its own axes up to a few numbers.
With the attitude R_t since the start of the piece, which the gyro gives,

    u_t = R_tᵀ (v_0 + Σ R f Δt + γ t),

where v_0 is the velocity at the start and γ gravity, both in the axes of the start. γ is known up
to the tilt and the bias of the accelerometer. A car moves along its axis ahead a, so for the right
a, v_0 and γ the part of u_t across a is small. For each a the best v_0 and γ are the solution of a
linear least-squares problem. So a search over a remains, which has two angles. The car drives ahead
and not back, so a · u_t is positive in the mean. The axis up is the part across a of the mean
direction −R_tᵀ γ. The mean force would lean towards the inside of the bends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gnio_jax.errors import InputError
from gnio_jax.numerics import cumulative_rotation
from gnio_jax.types import GRAVITY

PIECE_SECONDS = 20.0
"""Length of the pieces, s: in a longer one the gyro's bias turns the attitude too far."""
EVERY = 0.2
"""Time between the velocities that are compared, s."""
GRAVITY_STD, VELOCITY_STD, ACROSS_STD = 0.3, 20.0, 0.1
"""Standard deviations of a component of γ, m/s², of v_0, m/s, and of the velocity across, m/s."""
CORRELATED_SECONDS = 2.0
"""Time for which an error of the velocity across lasts, s."""
LEAST_SPEED = 1.0
"""Mean speed below which a recording does not count as a drive, m/s."""
LARGEST_STD = np.radians(5.0)
"""Standard deviation of the axis ahead, above which no mounting is given, rad."""


class Mounting(NamedTuple):
    """Body ← car, R_z(yaw) R_y(pitch) R_x(roll), rad: the numbers of `NonHolonomic`."""

    yaw: float
    pitch: float
    roll: float
    std: float
    """The larger standard deviation of the two angles of the axis ahead, rad."""


class Piece(NamedTuple):
    """Velocities in the body at some times t of a piece: `fixed` + `slopes` x, with x the errors of
    v_0 and γ over their standard deviations."""

    fixed: Float[np.ndarray, "m 3"]
    slopes: Float[np.ndarray, "m 3 6"]
    back: Float[np.ndarray, "m 3 3"]
    """R_tᵀ."""
    gravity: Float[np.ndarray, "3"]
    """γ without its error, m/s²."""


class PieceMotion(NamedTuple):
    """The best v_0 and γ of a piece for an axis ahead."""

    residuals: Float[np.ndarray, "k"]
    """Over their standard deviations."""
    velocity: Float[np.ndarray, "m 3"]
    """u_t, m/s."""
    upward: Float[np.ndarray, "m 3"]
    """−R_tᵀ γ, m/s²."""


def find_mounting(
    gyro: Float[np.ndarray, "n 3"], accel: Float[np.ndarray, "n 3"], rate: float, source: str
) -> Mounting:
    """The mounting from the whole drive.

    Args:
        gyro: Angular rate in the body, rad/s, with a bias of at most a few tenths of a degree a
            second.
        accel: Specific force in the body, m/s².
        rate: Samples per second.
        source: The recording, for messages.

    Raises:
        InputError: A shape or a number cannot be, the IMU hardly moves, or it does not turn and
            brake enough.
    """
    gyro, accel = np.asarray(gyro, np.float64), np.asarray(accel, np.float64)
    if gyro.ndim != 2 or gyro.shape[1] != 3 or accel.shape != gyro.shape:
        problem = f"gyro and accel must be (n, 3), found {gyro.shape} and {accel.shape}"
        raise InputError(source, problem, "pass one row for each sample")
    if not (np.isfinite(gyro).all() and np.isfinite(accel).all()):
        raise InputError(source, "gyro or accel is not finite", "fill or leave out these samples")
    if not 0 < rate < np.inf:
        raise InputError(source, f"rate: found {rate:g}", "give samples per second, above 0")
    remedy = "state yaw, pitch and roll in filter.measurements.nonholonomic of the settings"
    length = round(PIECE_SECONDS * rate)
    count = len(gyro) // length
    if not count:
        problem = f"{len(gyro) / rate:.0f} s are too short to find the mounting"
        raise InputError(source, problem, remedy)
    force = accel.mean(0)
    up = force / np.linalg.norm(force)
    starts = [slice(k * length, (k + 1) * length) for k in range(count)]
    pieces = [_piece(gyro[rows], accel[rows], rate) for rows in starts]
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    basis = np.stack([side, np.cross(up, side), up])

    def axis(angles: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
        (c, s), (cosine, sine) = ((np.cos(x), np.sin(x)) for x in angles)
        return np.array([cosine * c, cosine * s, sine]) @ basis

    def across(angles: Float[np.ndarray, "2"]) -> Float[np.ndarray, "k"]:
        return np.concatenate([_fit(piece, axis(angles)).residuals for piece in pieces])

    grid = np.radians(np.arange(0.0, 180.0, 5.0))
    costs = [np.sum(across(np.array([angle, 0.0])) ** 2) for angle in grid]
    best = least_squares(across, np.array([grid[int(np.argmin(costs))], 0.0]), xtol=1e-6)
    ahead = axis(best.x)
    motions = [_fit(piece, ahead) for piece in pieces]
    speed = np.mean([motion.velocity @ ahead for motion in motions])
    if abs(speed) < LEAST_SPEED:
        problem = f"drives at {abs(speed):.1f} m/s in the mean, too slowly to find the mounting"
        raise InputError(source, problem, remedy)
    ahead *= np.sign(speed)
    independent = CORRELATED_SECONDS / EVERY
    scale = max(1.0, 2 * best.cost / max(len(best.fun) / 2, 1.0))
    spread = np.linalg.inv(best.jac.T @ best.jac + 1e-9 * np.eye(2)) * independent * scale
    std = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
    if not std < LARGEST_STD:
        degrees = np.degrees(min(std, np.pi))
        problem = f"turns and brakes too little to find the mounting (±{degrees:.0f}°)"
        raise InputError(source, problem, remedy)
    leftward = np.cross(np.mean([motion.upward.mean(0) for motion in motions], axis=0), ahead)
    leftward /= np.linalg.norm(leftward)
    upward = np.cross(ahead, leftward)
    yaw, pitch = np.arctan2(ahead[1], ahead[0]), -np.arcsin(np.clip(ahead[2], -1.0, 1.0))
    return Mounting(float(yaw), float(pitch), float(np.arctan2(leftward[2], upward[2])), std)


def _piece(gyro: Float[np.ndarray, "n 3"], accel: Float[np.ndarray, "n 3"], rate: float) -> Piece:
    attitude = cumulative_rotation(Rotation.from_rotvec(gyro / rate)).as_matrix()
    force = np.einsum("kij,kj->ki", attitude[:-1], accel)
    gravity = -force.mean(0) * GRAVITY / np.linalg.norm(force.mean(0))
    time = np.arange(1, len(gyro) + 1) / rate
    moved = np.cumsum(force, axis=0) / rate + np.outer(time, gravity)
    rows = slice(round(EVERY * rate) - 1, None, round(EVERY * rate))
    back = np.swapaxes(attitude[1:][rows], 1, 2)
    slopes = [VELOCITY_STD * back, GRAVITY_STD * time[rows, None, None] * back]
    fixed = np.einsum("kij,kj->ki", back, moved[rows])
    return Piece(fixed, np.concatenate(slopes, axis=2), back, gravity)


def _fit(piece: Piece, ahead: Float[np.ndarray, "3"]) -> PieceMotion:
    aside = (np.eye(3) - np.outer(ahead, ahead)) / ACROSS_STD
    rows = np.concatenate([(aside @ piece.slopes).reshape(-1, 6), np.eye(6)])
    values = np.concatenate([(piece.fixed @ aside).ravel(), np.zeros(6)])
    x = np.linalg.solve(rows.T @ rows, -rows.T @ values)
    upward = -piece.back @ (piece.gravity + GRAVITY_STD * x[3:])
    return PieceMotion(values + rows @ x, piece.fixed + piece.slopes @ x, upward)
