"""The heading from a magnetometer as a measurement (ours): the horizontal direction of the earth's
field stays as it is.

With the field m in the body, without the phone's own field, and h = R m, the azimuth of h is that
of the world's field,

    α_0 = atan2(h_y, h_x) + w,   w ~ N(0, σ²).

The field of a building differs from the earth's for metres, so w is the same for many intervals,
and σ must be several times its size. Where strength or dip of the field are not those of the
beginning, there is no measurement.

The world's yaw is that of the filter's start, so α_0 is the direction at the beginning, and not the
north. `magnetometer_on_intervals` fits it there, with the phone's own field (hard iron).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config.schema import ABOVE_ZERO, NOT_NEGATIVE
from gnio_jax.errors import InputError
from gnio_jax.filtering.readings import (
    ONE_DEGREE,
    check_numbers,
    finite_readings,
    interval_ends,
    readings_at,
)
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.geometry import matmul
from gnio_jax.numerics import rotation_z
from gnio_jax.types import Array

STRENGTH_RATIO = 1.25
"""Largest ratio of the strength of a field to that of the beginning, and of its inverse."""
LARGEST_DIP = np.radians(15.0)
"""Largest difference of the dip from that of the beginning, rad."""
LEAST_LEVEL = 5.0
"""Horizontal field below which there is no heading, µT. The earth's is 15 to 40 µT except in the
polar regions."""
FIELDS = 15.0, 150.0
"""Strengths of which the median of a recording must be, µT: the earth's is 22 to 67 µT, and the
phone's own field may be as large."""
IRON_STD, FIELD_STD = 30.0, 2.0
"""Standard deviations of a component of the phone's own field and of a reading, µT."""
EARTH = 48.0, 12.0
"""Mean and standard deviation of the strength of the earth's field, µT."""
CORRELATED_SECONDS, OUTLIER = 2.0, 2.0
"""Time for which the field of a building is the same error, s, and standard deviations from which a
residual counts less."""
FIT_ROWS = 300
"""Largest number of readings of a fit, about."""
SURE_BIAS, LIKELY_COST = 1.5e-3, 8.0
"""Standard deviation of the gyro's bias down to which the time of the fit is doubled, rad/s, and by
how much half the sum of squares of a solution may exceed the best one's to be tried again with more
time."""
LEVEL_STD = 0.005
"""Standard deviation of the level components of the gyro's bias after a run, rad/s, which gravity
has shown."""


class Magnetometer(NamedTuple):
    """A row for each of K clone intervals: an entry of `measurements` of a run."""

    field: Float[Array, "*k 3"]
    """Field in the body at the end of the interval, without the phone's own, µT; NaN: none."""
    direction: Float[Array, "*k"]
    """α_0, the azimuth of the world's field, from x counter-clockwise, rad."""
    strength: Float[Array, "*k"]
    """Strength of the world's field, µT."""
    dip: Float[Array, "*k"]
    """Angle of the world's field below the horizontal, rad."""
    std: Float[Array, "*k"]
    """σ, rad."""
    name = "magnetometer"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """The azimuth turns with the world as δθ_z does, so its Jacobian does not depend on the
        estimate of any position, and the update is that of a measurement in the carrier's frame."""
        dtype = state.offset.dtype
        magnet = [jnp.asarray(part, dtype) for part in self]
        present = jnp.isfinite(jnp.stack([*magnet[0], *magnet[1:]])).all()
        # No NaN may enter the arithmetic, because otherwise the derivatives would be NaN too.
        field, direction, strength, dip, std = (jnp.where(present, part, 1.0) for part in magnet)
        x, y, z = matmul(state.rotation, field[:, None])[:, 0]
        level = jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12))
        size = jnp.sqrt(level**2 + z**2)
        usual = (size < STRENGTH_RATIO * strength) & (STRENGTH_RATIO * size > strength)
        usual = usual & (jnp.abs(jnp.arctan2(-z, level) - dip) < LARGEST_DIP)
        present = present & usual & (level > LEAST_LEVEL) & (std > 0)
        # A safe branch for the derivative of atan2 where the field is vertical.
        x, y = (jnp.where(present, part, safe) for part, safe in ((x, 1.0), (y, 0.0)))
        difference = direction - jnp.arctan2(y, x)
        residual = jnp.arctan2(jnp.sin(difference), jnp.cos(difference))
        squared = jnp.where(present, level**2, 1.0)
        turn = jnp.stack([-x * z / squared, -y * z / squared, jnp.ones_like(z)])
        linear = linearise(
            state,
            jnp.where(present, residual, jnp.nan)[None],
            jnp.where(present, std**2, 1.0)[None, None],
            rotation=turn[None],
        )
        return measure(state, linear, step, ONE_DEGREE)


class FieldFit(NamedTuple):
    """The world's field and what was found out with it."""

    rows: Magnetometer
    gyro_bias: Float[np.ndarray, "3"]
    """What the gyro's bias was wrong by in the run that gave the attitudes, rad/s."""
    gyro_bias_std: float
    """Standard deviation of its vertical component, rad/s."""
    misfit: float
    """Root mean square of the residuals, µT."""


def magnetometer_on_intervals(
    time: Any,
    field: Any,
    rotation: Any,
    config: FilterConfig,
    start: float = 0.0,
    std: float = 0.3,
    first_seconds: float = 30.0,
) -> Magnetometer:
    """Readings of a magnetometer as a row for each clone interval, as `fit_field` makes them if the
    gyro's bias is known.

    Args:
        time: (f,) increasing stamps, s, on the clock of `start`.
        field: (f, 3) readings in the body, µT. Those that are not finite are none.
        rotation: (K, 3, 3) attitudes at the ends of the intervals, of a run without a magnetometer.
        config: The settings of the filter, for the length of an interval.
        start: Stamp of the first IMU sample, s.
        std: Standard deviation σ of the direction, rad, with its correlation in time.
        first_seconds: Length of the beginning, s, in which the gyro has not yet drifted.

    Raises:
        InputError: As `fit_field` raises it.
    """
    return fit_field(time, field, rotation, config, start, std, first_seconds).rows


def fit_field(
    time: Any,
    field: Any,
    rotation: Any,
    config: FilterConfig,
    start: float = 0.0,
    std: float = 0.3,
    first_seconds: float = 30.0,
    bias_std: float = 0.0,
) -> FieldFit:
    """Readings of a magnetometer as a row for each clone interval, and the gyro's bias.

    The world's field h, the phone's own b and the error β of the gyro's bias are the robust
    least-squares solution of

        m_t = b + R_tᵀ Rz(J_t β) h,   J_t = ∫ e_zᵀ R dt,

    over the first seconds, with the priors b ~ N(0, `IRON_STD`²), |h| ~ N(48, 12²) µT, the earth's,
    and β ~ N(0, `bias_std`²): gravity shows the attitude R_t except its yaw, which drifts with the
    vertical part of β. Several starts of it are compared, because the yaw is an angle. If the phone
    turns only about the vertical, the vertical part of b is not known, and has no effect.

    Args:
        time: (f,) increasing stamps, s, on the clock of `start`.
        field: (f, 3) readings in the body, µT. Those that are not finite are none.
        rotation: (K, 3, 3) attitudes at the ends of the intervals, of a run without a magnetometer.
            From the first one on that is not finite no reading takes part in the fit.
        config: The settings of the filter, for the length of an interval.
        start: Stamp of the first IMU sample, s.
        std: Standard deviation σ of the direction, rad, with its correlation in time.
        first_seconds: Length of the beginning, s. If the bias is not known, it is doubled until the
            fit shows it to `SURE_BIAS`.
        bias_std: Standard deviation of an axis of the gyro's bias, rad/s; 0: it is known.

    Raises:
        InputError: Shapes do not fit, the unit is not µT, stamps do not increase, hardly any
            reading is within the recording, an attitude of the beginning is not finite, or a
            standard deviation is impossible.
    """
    time, field, rotation = (np.asarray(part, np.float64) for part in (time, field, rotation))
    if time.ndim != 1 or field.shape != (len(time), 3) or rotation.shape[1:] != (3, 3):
        shapes = f"found {time.shape}, {field.shape} and {rotation.shape}"
        problem = "time, field and rotation must be (f,), (f, 3) and (K, 3, 3)"
        raise InputError("magnetometer", f"{problem}, {shapes}", "pass one row for each stamp")
    check_numbers("magnetometer", ABOVE_ZERO, std=std)
    check_numbers("magnetometer", NOT_NEGATIVE, bias_std=bias_std)
    time, field = finite_readings("magnetometer", time, field)
    ends = interval_ends("magnetometer", len(rotation), config, start)
    at_ends = readings_at(ends, time, field)
    healthy = np.logical_and.accumulate(np.isfinite(rotation).all(axis=(1, 2)))
    if not healthy[ends <= start + first_seconds].all():
        problem = f"rotation: not all attitudes of the first {first_seconds:g} s are finite"
        raise InputError("magnetometer", problem, "pass those of a run that is healthy")
    present = np.isfinite(at_ends[:, 0]) & healthy
    first = present & (ends <= start + first_seconds)
    if first.sum() < 10:
        problem = f"time: only {first.sum()} of the first {first_seconds:g} s have a reading"
        raise InputError("magnetometer", problem, "give it stamps on the clock of the IMU")
    strength = float(np.median(np.linalg.norm(field, axis=1)))
    if not FIELDS[0] <= strength <= FIELDS[1]:
        factor = next((f for f in (100, 1e6, 1e-3, 1e-1) if 20 <= f * strength <= 70), None)
        remedy = f"multiply by {factor:g}" if factor else "leave it out"
        problem = f"field: the median strength is {strength:.3g} µT, and the earth's is 22 to 67"
        raise InputError("magnetometer", problem, remedy)
    drift = np.cumsum(rotation[:, 2], axis=0) * config.clone_seconds
    starts = None
    while True:
        rows = np.flatnonzero(first)
        rows = rows[:: max(len(rows) // FIT_ROWS, 1)]
        seconds = config.clone_seconds * (rows[-1] - rows[0]) / (len(rows) - 1)
        parts = at_ends[rows], rotation[rows], drift[rows]
        up = parts[1][:, 2].mean(axis=0)
        up = up / max(float(np.linalg.norm(up)), 1e-9)
        fits = _FieldProblem(*parts, bias_std, seconds, up).solve(starts)
        fit = fits[0]
        if not bias_std or fit.vertical_std < SURE_BIAS or first.sum() == present.sum():
            break
        first_seconds, starts = 2 * first_seconds, [other.x[6:] for other in fits]
        first = present & (ends <= start + first_seconds)
    iron, world, bias = np.split(fit.x, [3, 6])
    intervals = np.ones(len(rotation))
    rows = Magnetometer(
        at_ends - iron,
        np.arctan2(world[1], world[0]) * intervals,
        np.linalg.norm(world) * intervals,
        np.arctan2(-world[2], np.hypot(world[0], world[1])) * intervals,
        std * intervals,
    )
    return FieldFit(rows, bias, fit.vertical_std, fit.misfit)


class _Solution(NamedTuple):
    x: Float[np.ndarray, "9"]
    """b, h and β."""
    cost: float
    vertical_std: float
    """Standard deviation of the vertical part of β, rad/s."""
    misfit: float
    """Root mean square of the residuals, µT."""


class _FieldProblem(NamedTuple):
    """The least-squares problem of `fit_field`."""

    field: Float[np.ndarray, "f 3"]
    rotation: Float[np.ndarray, "f 3 3"]
    drift: Float[np.ndarray, "f 3"]
    """J_t, s."""
    bias_std: float
    seconds: float
    """Time of a row, s."""
    up: Float[np.ndarray, "3"]
    """The mean upward direction in the body, a unit vector."""

    @property
    def correlated(self) -> float:
        """Number of residuals that share an error."""
        return max(3 * CORRELATED_SECONDS / self.seconds, 1.0)

    def solve(self, biases: list[Float[np.ndarray, "3"]] | None) -> list[_Solution]:
        """The solutions that are nearly as good as the best one, which comes first, from several
        biases; None: from all vertical ones that are likely."""
        if not self.bias_std:
            return [self._solve_from(np.zeros(3))]
        if biases is None:
            up = self.up
            step = 0.5 * np.pi / max(float(np.ptp(self.drift @ up)), 1.0)
            count = int(np.ceil(3 * self.bias_std / step))
            biases = [k * step * up for k in range(-count, count + 1)]
        solutions = sorted(map(self._solve_from, biases), key=lambda solution: solution.cost)
        return [one for one in solutions if one.cost < solutions[0].cost + LIKELY_COST]

    def _start_from(self, bias: Float[np.ndarray, "3"]) -> Float[np.ndarray, "9"]:
        """b, h and β by linear least squares for a bias that is known."""
        turned = rotation_z(self.drift @ bias).swapaxes(1, 2) @ self.rotation
        back = np.swapaxes(turned, 1, 2).reshape(-1, 3)
        rows = np.concatenate([np.tile(np.eye(3), (len(turned), 1)), back], axis=1) / FIELD_STD
        rows = np.concatenate([rows, np.diag(np.repeat([1 / IRON_STD, 1e-6], 3))])
        values = np.concatenate([self.field.ravel() / FIELD_STD, np.zeros(6)])
        return np.concatenate([np.linalg.lstsq(rows, values)[0], bias])

    def _errors(self, x: Float[np.ndarray, "p"]) -> Float[np.ndarray, "f 3"]:
        """Measured minus expected field, µT."""
        iron, world, bias = np.split(x, [3, 6])
        bias = bias if len(bias) else np.zeros(3)
        world_now = np.einsum("fij,j->fi", rotation_z(self.drift @ bias), world)
        return self.field - iron - np.einsum("fji,fj->fi", self.rotation, world_now)

    def _residual(self, x: Float[np.ndarray, "p"]) -> Float[np.ndarray, "r"]:
        """The residuals whose squares are minimised. Those of the field grow with the root of a
        large error, and those of `CORRELATED_SECONDS` count as one."""
        iron, world, bias = np.split(x, [3, 6])
        size = self._errors(x).ravel() / (OUTLIER * FIELD_STD)
        robust = OUTLIER * np.sign(size) * np.sqrt(2 * (np.sqrt(1 + size**2) - 1))
        parts = [robust / np.sqrt(self.correlated), iron / IRON_STD]
        parts += [[(np.linalg.norm(world) - EARTH[0]) / EARTH[1]]]
        if self.bias_std:
            up = self.up
            parts += [[up @ bias / self.bias_std], (bias - up * (up @ bias)) / LEVEL_STD]
        return np.concatenate(parts)

    def _jacobian(self, x: Float[np.ndarray, "p"]) -> Float[np.ndarray, "r p"]:
        """The derivative of `_residual`."""
        world, bias = x[3:6], x[6:] if len(x) > 6 else np.zeros(3)
        back = np.swapaxes(self.rotation, 1, 2)
        turn = rotation_z(self.drift @ bias)
        across = (turn @ world)[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]  # of a small turn about z
        of_turn = np.einsum("fij,fj->fi", back, across)[:, :, None] * self.drift[:, None]
        of_iron = np.tile(np.eye(3), (len(back), 1, 1))
        blocks = [of_iron, back @ turn, *([of_turn] if self.bias_std else [])]
        rows = -np.concatenate(blocks, axis=2).reshape(-1, len(x)) / FIELD_STD
        size = self._errors(x).ravel() / (OUTLIER * FIELD_STD)
        root = np.sqrt(1 + size**2)
        bent = np.sqrt(2 * (root - 1))
        slope = np.where(bent > 1e-6, np.abs(size) / np.maximum(root * bent, 1e-12), 1.0)
        prior = np.zeros((4, len(x)))
        prior[:3, :3] = np.eye(3) / IRON_STD
        prior[3, 3:6] = world / max(float(np.linalg.norm(world)), 1e-9) / EARTH[1]
        parts = [slope[:, None] * rows / np.sqrt(self.correlated), prior]
        if self.bias_std:
            up = self.up
            of_bias = np.zeros((4, 9))
            of_bias[0, 6:] = up / self.bias_std
            of_bias[1:, 6:] = (np.eye(3) - np.outer(up, up)) / LEVEL_STD
            parts.append(of_bias)
        return np.concatenate(parts)

    def _solve_from(self, bias: Float[np.ndarray, "3"]) -> _Solution:
        """The solution that begins at a bias."""
        from scipy.optimize import least_squares

        start = self._start_from(bias)[: 9 if self.bias_std else 6]
        fit = least_squares(self._residual, start, self._jacobian, method="lm", max_nfev=40)
        x = np.concatenate([fit.x, np.zeros(9 - len(fit.x))])
        misfit = float(np.sqrt((self._errors(x) ** 2).sum(axis=1).mean()))
        spread = np.linalg.pinv(fit.jac.T @ fit.jac)[6:, 6:]
        up = self.up
        vertical_std = float(np.sqrt(up @ spread @ up)) if self.bias_std else 0.0
        return _Solution(x, float(fit.cost), vertical_std, misfit)
