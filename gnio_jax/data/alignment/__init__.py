"""Where an IMU sits on a tracked body, and the reference that follows from it.

An optical tracker gives the poses of a *marker body* on its own clock in its own, slightly tilted
world. The IMU is bolted somewhere else on that body, turned against it, on another clock. `align`
estimates all of it at once from one recording:

    gyro(t + lag(t))  = Rxᵀ ω_marker(t) + b_g                      ω from differences of the tracked
    attitude accel(t + lag(t) + δ) = Rxᵀ R(t)ᵀ (p̈(t) + d²/dt² [R(t) l] − g) + b_a    p̈ from second
    differences of the tracked position

with the extrinsic rotation Rx (IMU → marker body), lever arm l, biases b_g and b_a, the direction
of gravity g in the tracker's world, a lag that is piecewise linear in time and a delay δ of the
accelerometer against the gyro (phones filter it: 10 to 50 ms). First guesses of the lag are the
peaks of the cross-correlation of the magnitudes of the angular rates: whoever walks in rounds or in
figures of eight has several, and the highest need not be the right one. Wahba's problem on the
angular rates (people turn about one axis, so alone it errs by degrees about that axis) ranks them.
A robust Gauss-Newton fit of gyro and accel together starts from each of the best few, and the one
that leaves least unexplained is carried on. Both sides of each equation pass the same Gaussian
filter, so that filtering removes noise but biases nothing.

Quaternions never appear here: attitudes are SciPy rotations, body→world.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.signal import correlate, correlation_lags, find_peaks
from scipy.spatial.transform import Rotation, Slerp

from gnio_jax.data.sequence import cumulative_rotation
from gnio_jax.types import GRAVITY

FILTER_SECONDS = 0.03
"""Standard deviation of the Gaussian that both sides of the fit pass: a pass band of 5 Hz holds the
motion of a gait."""

BLOCK_SECONDS = 2.0
"""Errors within this time share an offset."""

SHORTEST_OVERLAP = 10.0
"""s of usable poses below which nothing is fitted."""

FITS = 4
"""Peaks of the correlation from which a fit starts."""

FIRST_ITERATIONS = 8
"""Of these fits; the best one is then repeated to its end, with all its knots."""

SAME_LAG = 0.15
"""s by which two fits may differ in lag and be one: less than half a step of a runner."""

TRUSTED_SHARE = 0.9
"""Share of the samples by whose residuals a fit is judged; the worst are the tracker's flips."""


class Track(NamedTuple):
    """Poses of a marker body on a uniform clock."""

    time: Float[np.ndarray, " n"]
    """s, on the tracker's clock, uniform."""
    position: Float[np.ndarray, "n 3"]
    """m, in the tracker's world; anything finite where not `good`."""
    attitude: Rotation
    """n rotations, marker body → tracker's world."""
    good: Bool[np.ndarray, " n"]
    """False where the tracker had no pose, or one that cannot be."""


class TooLittle(ValueError):
    """Too little of the track overlaps the IMU's recording."""


class Alignment(NamedTuple):
    """What `align` estimates; SI units."""

    extrinsic: Rotation
    """IMU → marker body."""
    lever: Float[np.ndarray, "3"]
    """From the marker body's origin to the IMU, in the marker body, m."""
    up: Float[np.ndarray, "3"]
    """Unit vector against gravity in the tracker's world."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]
    knots: Float[np.ndarray, " k"]
    """Knots of the lag on the tracker's clock, s."""
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at the knots, s."""
    accel_delay: float
    """How much later than the gyro the accelerometer tells of the same event, s."""
    gyro_residual: float
    """Robust standard deviation of the filtered angular rate's residual, rad/s."""
    accel_residual: float
    """Robust standard deviation of the filtered acceleration's residual, m/s²."""
    gyro_unexplained: float
    """Power of the filtered angular rate's residual over that of the tracker's angular rate; 0 is a
    perfect fit, 1 explains nothing."""
    accel_unexplained: float
    """The same of the acceleration, gravity apart."""
    runner_up: float
    """What this fit leaves unexplained over what the best fit with another lag does; 0 where there
    is no other, 1 where both are as good."""
    mismatch: Bool[np.ndarray, " n"]
    """Samples of the track whose acceleration contradicts the IMU grossly: the tracker jumped."""

    @property
    def unexplained(self) -> float:
        """Geometric mean of both shares: the noise of both being unknown, the least is likeliest."""
        return float(np.sqrt(self.gyro_unexplained * self.accel_unexplained))

    def track_time(self, imu_time: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Tracker's time of the events that the IMU stamped `imu_time`."""
        imu_knots = self.knots + self.lag
        # np.interp holds the ends; here the slopes of the outer intervals go on.
        inner = np.interp(imu_time, imu_knots, self.knots)
        before, after = imu_time < imu_knots[0], imu_time > imu_knots[-1]
        inner = np.where(before, self.knots[0] + imu_time - imu_knots[0], inner)
        return np.where(after, self.knots[-1] + imu_time - imu_knots[-1], inner)

    def leveling(self) -> Rotation:
        """The smallest rotation that turns `up` onto z: tracker's world → level world."""
        axis = np.cross(self.up, [0.0, 0.0, 1.0])
        sine = float(np.linalg.norm(axis))
        return Rotation.from_rotvec(
            axis / sine * np.arctan2(sine, self.up[2]) if sine > 0 else np.zeros(3)
        )


def align(
    time: Float[np.ndarray, " m"],
    gyro: Float[np.ndarray, "m 3"],
    accel: Float[np.ndarray, "m 3"],
    track: Track,
    knot_seconds: float = 30.0,
    search_seconds: float = 5.0,
    iterations: int = 12,
) -> Alignment:
    """Estimate extrinsic rotation, lever arm, gravity, biases and lag (module's docstring).

    `time` s is the IMU's uniform clock, `gyro` rad/s, `accel` m/s² specific force. `knot_seconds`
    is the spacing of the lag's knots, `search_seconds` bounds its first guesses. Raises `TooLittle`
    when too little of the track is usable. Whether the best fit is a good one is the caller's to
    judge, by `gyro_unexplained`, `accel_unexplained` and `runner_up`.
    """
    seen = _seen(track)
    felt = _smooth(gyro, FILTER_SECONDS / float(np.median(np.diff(time))))
    turn, seen_turn = np.linalg.norm(felt, axis=1), np.linalg.norm(seen.rate, axis=1)
    trusted_turn = np.where(seen.bad, 0.0, seen_turn)
    peaks = _correlation_peaks(track.time, trusted_turn, time, turn, search_seconds)
    peaks = sorted(peaks, key=lambda lag: _turn_residual(time, felt, track.time, seen, lag))
    coarse, knots = _knots(track.time, 30.0), _knots(track.time, knot_seconds)
    fits = []
    for guess in peaks[:FITS]:
        lag = _refine_by_segment(track.time, seen_turn, seen.bad, time, turn, coarse, guess)
        with suppress(TooLittle):
            fits.append(_fit(time, gyro, accel, track, seen, coarse, lag, FIRST_ITERATIONS))
    if not fits:
        raise TooLittle(f"less than {SHORTEST_OVERLAP:g} s of the track overlap the IMU's samples")
    best = min(fits, key=lambda fit: fit.unexplained)
    others = [fit.unexplained for fit in fits if abs(float(np.mean(fit.lag - best.lag))) > SAME_LAG]
    runner_up = best.unexplained / min(others) if others else 0.0
    lag = np.interp(knots, coarse, best.lag)
    fit = _fit(time, gyro, accel, track, seen, knots, lag, iterations)
    return fit._replace(runner_up=runner_up)


class _Seen(NamedTuple):
    """What the tracker saw, filtered: the left sides, which do not depend on the unknowns."""

    sigma: float
    """Of the filter, samples."""
    attitude: Float[np.ndarray, "n 3 3"]
    rate: Float[np.ndarray, "n 3"]
    """In the marker body, rad/s."""
    acceleration: Float[np.ndarray, "n 3"]
    """In the tracker's world, m/s²."""
    turning: Float[np.ndarray, "n 3 3"]
    """d²/dt² [R l] = turning @ l."""
    bad: Bool[np.ndarray, " n"]
    """Within the filter's reach of a sample that is not good."""


def _seen(track: Track) -> _Seen:
    step = float(np.median(np.diff(track.time)))
    sigma = FILTER_SECONDS / step
    attitude = track.attitude.as_matrix()
    rate = (track.attitude[:-1].inv() * track.attitude[1:]).as_rotvec() / step
    rate = np.concatenate([rate[:1], 0.5 * (rate[:-1] + rate[1:]), rate[-1:]])
    return _Seen(
        sigma=sigma,
        attitude=attitude,
        rate=_smooth(rate, sigma),
        acceleration=_smooth(_second_difference(track.position, step), sigma),
        turning=_smooth(_second_difference(attitude, step), sigma),
        bad=_within(~track.good, 3 * sigma),
    )


def _fit(
    time: Float[np.ndarray, " m"],
    gyro: Float[np.ndarray, "m 3"],
    accel: Float[np.ndarray, "m 3"],
    track: Track,
    seen: _Seen,
    knots: Float[np.ndarray, " k"],
    lag: Float[np.ndarray, " k"],
    iterations: int,
) -> Alignment:
    """The robust fit that starts from `lag` at `knots`. Raises `TooLittle`."""
    step = float(np.median(np.diff(track.time)))
    sigma, attitude, rate, acceleration, turning, bad = seen
    hats = _hat_functions(track.time, knots)
    # Right sides are the IMU's, interpolated at each guess of the lag, and filtered after they have
    # been turned into the same frame.
    imu_step = float(np.median(np.diff(time)))
    slope = np.gradient(np.concatenate([gyro, accel], axis=1), imu_step, axis=0)

    inside = _covered(track.time + hats @ lag, time, margin=4 * FILTER_SECONDS)
    usable = ~bad & inside
    if usable.sum() * step < SHORTEST_OVERLAP:
        raise TooLittle(f"only {usable.sum() * step:.1f} s of the track overlap the IMU's samples")
    gyro_there = _smooth(_at(time, gyro, track.time + hats @ lag), sigma)
    extrinsic = Rotation.align_vectors(rate[usable], gyro_there[usable])[0]
    gyro_bias, accel_bias, lever, tilt, delay = (
        np.zeros(3),
        np.zeros(3),
        np.zeros(3),
        np.zeros(2),
        0.0,
    )

    # Neighbours are correlated by the filter: one row per standard deviation of it loses nothing.
    rows = np.arange(0, len(track.time), max(int(sigma), 1))
    gyro_scale, accel_scale = 0.3, 3.0
    gyro_error = accel_error = np.zeros((len(track.time), 3))
    for iteration in range(iterations):
        there = track.time + hats @ lag
        usable = (
            ~bad
            & _covered(there, time, margin=4 * FILTER_SECONDS)
            & _covered(there + delay, time, margin=4 * FILTER_SECONDS)
        )
        turned, turned_slope = _at(time, gyro, there), _at(time, slope[:, :3], there)
        force, force_slope = (
            _at(time, accel, there + delay) - accel_bias,
            _at(time, slope[:, 3:], there + delay),
        )
        to_marker = extrinsic.as_matrix()
        to_world = attitude @ to_marker
        omega, omega_slope = _smooth(turned, sigma) - gyro_bias, _smooth(turned_slope, sigma)
        up = np.array([tilt[0], tilt[1], 1.0]) / np.sqrt(1.0 + tilt @ tilt)

        gyro_error = rate - omega @ to_marker.T
        felt = _smooth(np.einsum("nij,nj->ni", to_world, force), sigma)
        accel_error = acceleration + turning @ lever - felt + GRAVITY * up

        if iteration > 0:
            gyro_scale = max(_robust_std(gyro_error[usable]), 1e-4)
            accel_scale = max(_robust_std(accel_error[usable]), 1e-3)
        chosen = rows[usable[rows]]
        gyro_weight = _cauchy(gyro_error[chosen], gyro_scale)
        accel_weight = _cauchy(accel_error[chosen], accel_scale)

        # Jacobians of the errors in (rotation 3, gyro bias 3, accel bias 3, lever 3, tilt 2, delay
        # 1, lag k).
        count = 15 + len(knots)
        gyro_jacobian = np.zeros((len(chosen), 3, count))
        gyro_jacobian[:, :, 0:3] = to_marker @ _hat(omega[chosen])
        gyro_jacobian[:, :, 3:6] = to_marker
        gyro_jacobian[:, :, 15:] = (
            -(omega_slope[chosen] @ to_marker.T)[:, :, None] * hats[chosen][:, None, :]
        )
        accel_jacobian = np.zeros((len(chosen), 3, count))
        accel_jacobian[:, :, 0:3] = _smooth(to_world @ _hat(force), sigma)[chosen]
        accel_jacobian[:, :, 6:9] = _smooth(to_world, sigma)[chosen]
        accel_jacobian[:, :, 9:12] = turning[chosen]
        accel_jacobian[:, [0, 1], [12, 13]] = GRAVITY
        felt_slope = _smooth(np.einsum("nij,nj->ni", to_world, force_slope), sigma)[chosen]
        accel_jacobian[:, :, 14] = -felt_slope
        accel_jacobian[:, :, 15:] = -felt_slope[:, :, None] * hats[chosen][:, None, :]

        block = np.floor(track.time[chosen] / BLOCK_SECONDS).astype(int)
        from_gyro = _normal_equations(gyro_jacobian, gyro_error[chosen], gyro_weight, block)
        from_accel = _normal_equations(accel_jacobian, accel_error[chosen], accel_weight, block)
        normal, gradient = from_gyro[0] + from_accel[0], from_gyro[1] + from_accel[1]

        # Weak priors settle what a recording cannot tell: biases of a phone, a lever on the hand,
        # clocks that run straight.
        state = np.concatenate([gyro_bias, accel_bias, lever, tilt, [delay]])
        precision = np.repeat([0.05, 0.15, 0.2, 0.05, 0.05], [3, 3, 3, 2, 1]) ** -2.0
        normal[3:15, 3:15] += np.diag(precision)
        gradient[3:15] += precision * state
        if len(knots) > 2:
            bend = np.diff(np.eye(len(knots)), 2, axis=0) / 0.02
            normal[15:, 15:] += bend.T @ bend
            gradient[15:] += bend.T @ bend @ lag

        change = -np.linalg.lstsq(normal, gradient, rcond=1e-12)[0]
        # Linearisation holds for a tenth of a gait cycle and a tenth of a radian.
        change[14:] = np.clip(change[14:], -0.05, 0.05)  # delay and lag
        change[:3] *= min(1.0, 0.2 / max(float(np.linalg.norm(change[:3])), 1e-12))
        extrinsic = extrinsic * Rotation.from_rotvec(change[:3])
        gyro_bias, accel_bias, lever = (
            gyro_bias + change[3:6],
            accel_bias + change[6:9],
            lever + change[9:12],
        )
        tilt, delay, lag = tilt + change[12:14], delay + float(change[14]), lag + change[15:]
        if iteration > 3 and np.linalg.norm(change[:3]) < 1e-4 and np.abs(change[14:]).max() < 2e-4:
            break

    up = np.array([tilt[0], tilt[1], 1.0]) / np.sqrt(1.0 + tilt @ tilt)
    limit = max(6.0, 8.0 * accel_scale)
    return Alignment(
        extrinsic=extrinsic,
        lever=lever,
        up=up,
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        knots=knots,
        lag=lag,
        accel_delay=delay,
        gyro_residual=_robust_std(gyro_error[usable]),
        accel_residual=_robust_std(accel_error[usable]),
        gyro_unexplained=_unexplained(gyro_error[usable], rate[usable]),
        accel_unexplained=_unexplained(accel_error[usable], acceleration[usable]),
        runner_up=0.0,
        mismatch=usable & (np.linalg.norm(accel_error, axis=1) > limit),
    )


class Heading(NamedTuple):
    """What `align_heading` estimates; SI units."""

    knots: Float[np.ndarray, " k"]
    """On the tracker's clock, s."""
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at the knots, s."""
    yaw: Float[np.ndarray, " k"]
    """To be added to the IMU's heading, at the knots, rad."""
    correlation: float
    """Median over stretches of the correlation of the horizontal accelerations."""
    runner_up: float
    """What the best constant lag leaves unexplained over what the second best does; 1 where both
    are as good."""


def align_heading(
    time: Float[np.ndarray, " m"],
    acceleration: Float[np.ndarray, "m 2"],
    track_time: Float[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    search_seconds: float = 4.0,
    filter_seconds: float = 0.08,
) -> Heading:
    """Lag and heading that lay an IMU's horizontal acceleration on that of tracked positions.

    `acceleration` m/s² is the IMU's in a level frame of its own whose yaw is arbitrary and drifts
    slowly. As complex numbers the two differ by a factor exp(i yaw), so the magnitude of their
    correlation over a stretch tells the lag whatever the yaw. Both are piecewise linear with a knot
    per 30 s. Raises `ValueError` when there are less than 30 s.
    """
    step = float(np.median(np.diff(track_time)))
    sigma = filter_seconds / step
    seen = _smooth(_second_difference(position[:, :2], step), sigma)
    seen = seen[:, 0] + 1j * seen[:, 1]
    usable = ~_within(~good, 2 * sigma)
    # A tracker that relocalises makes accelerations that no pedestrian makes.
    usable &= np.abs(seen) < 8.0 * max(float(np.median(np.abs(seen))), 0.1)
    felt = _smooth(acceleration, filter_seconds / float(np.median(np.diff(time))))
    felt = felt[:, 0] + 1j * felt[:, 1]
    slope = np.gradient(felt, time)
    stretches = np.floor((track_time - track_time[0]) / 15.0).astype(int)
    if stretches.max() < 2:
        raise ValueError("less than 30 s to align")
    knots = _knots(track_time, 30.0)
    hats = _hat_functions(track_time, knots)

    def products(there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Per stretch: Σ conj(felt) seen, and √(Σ|felt|² Σ|seen|²)."""
        inside = usable & (there > time[0]) & (there < time[-1])
        value = np.interp(there, time, felt) * inside
        both = np.conj(value) * seen
        cross = np.bincount(stretches, both.real) + 1j * np.bincount(stretches, both.imag)
        power = np.bincount(stretches, np.abs(value) ** 2) * np.bincount(
            stretches, np.abs(seen * inside) ** 2
        )
        return cross, np.sqrt(power) + 1e-9

    offsets = np.arange(-round(search_seconds / 0.02), round(search_seconds / 0.02) + 1) * 0.02
    scores = []
    for offset in offsets:
        cross, power = products(track_time + offset)
        scores.append(float(np.mean(np.abs(cross / power) ** 2)))
    best = int(np.argmax(scores))
    lag = np.full(len(knots), offsets[best])
    peaks, _ = find_peaks(np.pad(scores, 1, constant_values=-np.inf))
    others = [scores[i] for i in peaks - 1 if abs(offsets[i] - offsets[best]) > SAME_LAG]
    runner_up = (1.0 - scores[best]) / (1.0 - max(others)) if others else 0.0
    cross, _ = products(track_time + hats @ lag)
    centres = np.array([track_time[stretches == j].mean() for j in range(stretches.max() + 1)])
    # The mean of neighbouring stretches starts the fit on the right turn.
    yaw = np.interp(
        knots, centres, np.unwrap(np.angle(np.convolve(cross, np.ones(3), mode="same")))
    )
    for _ in range(15):
        there = track_time + hats @ lag
        inside = usable & (there > time[0]) & (there < time[-1])
        turned = np.exp(1j * (hats @ yaw)) * np.interp(there, time, felt)
        turned_slope = np.exp(1j * (hats @ yaw)) * np.interp(there, time, slope)
        error = (seen - turned)[inside]
        scale = max(_robust_std(np.stack([error.real, error.imag])), 1e-3)
        # One independent row per filter length.
        weight = (
            1.0 / scale**2 / (1.0 + (np.abs(error) / (2.0 * scale)) ** 2) / max(2.5 * sigma, 1.0)
        )
        jacobian = -np.concatenate(
            [1j * turned[inside, None] * hats[inside], turned_slope[inside, None] * hats[inside]],
            axis=1,
        )
        normal = np.einsum("ni,n,nj->ij", jacobian.conj(), weight, jacobian, optimize=True).real
        gradient = np.einsum("ni,n,n->i", jacobian.conj(), weight, error, optimize=True).real
        count = len(knots)
        for block, value, bend in (
            (slice(0, count), yaw, np.radians(5.0)),
            (slice(count, None), lag, 0.02),
        ):
            stiff = np.diff(np.eye(count), 2, axis=0) / bend if count > 2 else np.zeros((1, count))
            normal[block, block] += stiff.T @ stiff + 1e-6 * np.eye(count)
            gradient[block] += stiff.T @ stiff @ value
        change = -np.linalg.solve(normal, gradient)
        yaw = yaw + np.clip(change[:count], -0.3, 0.3)
        lag = lag + np.clip(change[count:], -0.03, 0.03)
    cross, power = products(track_time + hats @ lag)
    return Heading(knots, lag, yaw, float(np.median(np.abs(cross / power))), runner_up)


def follow_acceleration(
    integrated: Rotation,
    guess: Rotation,
    accel: Float[np.ndarray, "n 3"],
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    step: float,
    knot_seconds: float = 10.0,
    filter_seconds: float = 0.25,
) -> Rotation:
    """Attitude whose accelerations agree with those of tracked positions: integrated gyro times a
    slow correction.

    `integrated` are n rotations from the gyro alone, `guess` what the correction starts from, all
    body→world, `accel` m/s² specific force, `position` m in a level world, `good` where it can be
    trusted, on one clock of `step` s. The correction is a rotation per knot, with the shorter arc
    between; it leads R·accel + g, filtered until no gait is left, onto the second difference of
    `position`. What changes the drift of the gyro between knots (0.005 rad/s in tilt, 0.002 rad/s
    in yaw) pays a price.
    """
    n = len(accel)
    time = np.arange(n) * step
    knots = _knots(time, knot_seconds)
    hats = _hat_functions(time, knots)
    near = np.clip(np.round(knots / step).astype(int), 0, n - 1)
    offset = guess * integrated.inv()
    half = round(1.0 / step)
    correction = Rotation.concatenate([offset[max(i - half, 0) : i + half].mean() for i in near])
    sigma = filter_seconds / step
    seen = _smooth(_second_difference(position, step), sigma) + np.array([0.0, 0.0, GRAVITY])
    usable = ~_within(~good, 3 * sigma)
    rows = np.flatnonzero(usable)[:: max(round(sigma), 1)]
    spread = np.tile([0.05, 0.05, 0.02], max(len(knots) - 2, 0))
    bend = np.kron(np.diff(np.eye(len(knots)), 2, axis=0), np.eye(3)) / spread[:, None]
    for _ in range(8):
        attitude = Slerp(knots, correction)(time) * integrated
        felt = _smooth(attitude.apply(accel), sigma)[rows]
        error = seen[rows] - felt
        scale = max(_robust_std(error), 1e-3)
        weight = _cauchy(error, scale) / 2.5
        jacobian = (_hat(felt)[:, :, None, :] * hats[rows][:, None, :, None]).reshape(
            len(rows), 3, -1
        )
        turns = (correction[1:] * correction[:-1].inv()).as_rotvec()
        drift = np.diff(turns, axis=0).reshape(-1) / spread
        normal = (
            np.einsum("nai,n,naj->ij", jacobian, weight, jacobian, optimize=True) + bend.T @ bend
        )
        gradient = np.einsum("nai,n,na->i", jacobian, weight, error, optimize=True) + bend.T @ drift
        change = -np.linalg.lstsq(normal, gradient, rcond=1e-10)[0].reshape(-1, 3)
        change *= min(1.0, 0.3 / max(float(np.abs(change).max()), 1e-12))
        correction = Rotation.from_rotvec(change) * correction
    return Slerp(knots, correction)(time) * integrated


def integrate_gyro(gyro: Float[np.ndarray, "n 3"], step: float) -> Rotation:
    """Attitude relative to the first sample: n rotations, each rate averaged over the interval
    between two stamps (rad/s, s)."""
    middle = 0.5 * (gyro[:-1] + gyro[1:])
    return cumulative_rotation(
        Rotation.concatenate([Rotation.identity(1), Rotation.from_rotvec(middle * step)])
    )


def follow(
    integrated: Rotation,
    measured: Rotation,
    good: Bool[np.ndarray, " n"],
    step: float,
    seconds: float = 0.3,
) -> tuple[Rotation, Bool[np.ndarray, " n"]]:
    """Integrated attitude times a smooth correction towards the measured one, and where the
    measured one was believed.

    The correction measured · integrated⁻¹ moves as slowly as the gyro's bias does. Samples more
    than 15° off its median course (σ 3 s) are flips of the tracker; the rest is smoothed over
    `seconds` (σ), with weights that fall with the residual. Where nothing was measured the
    correction is interpolated, so that the gyro bridges the gap.
    """
    correction = (measured * integrated.inv()).as_quat()
    # q and −q are one rotation: give neighbours the same sign.
    known = correction[good]
    correction[good] = (
        known
        * np.cumprod(
            np.concatenate([[1.0], np.where((known[1:] * known[:-1]).sum(axis=1) < 0, -1.0, 1.0)])
        )[:, None]
    )

    believed = good
    course = _fill(correction, good)
    for sigma, limit, floor in (
        (3.0, 15.0, 1.0),
        (3.0, 15.0, 1.0),
        (3.0, 15.0, 1.0),
        (3.0, 15.0, 1.0),
        *((seconds, 180.0, 0.3),) * 3,
    ):
        correction = (
            correction * np.where((correction * course).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        )
        angle = 2.0 * np.arccos(np.clip((correction * course).sum(axis=1), -1.0, 1.0))
        nearby = (
            believed & (angle < np.radians(limit))
            if sigma == seconds
            else good & (angle < np.radians(limit))
        )
        believed = nearby if nearby.sum() > 0.2 * good.sum() else good
        scale = max(3.0 * float(np.median(angle[believed])), np.radians(floor))
        weight = np.where(believed, 1.0 / (1.0 + (angle / scale) ** 2) ** 2, 1.0)
        course = _smooth(weight[:, None] * _fill(correction, believed), sigma / step)
        course /= np.linalg.norm(course, axis=1, keepdims=True)
    return Rotation.from_quat(course) * integrated, believed


def _fill(values: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Rows that are not good, interpolated between those that are."""
    rows = np.flatnonzero(good)
    return np.stack(
        [np.interp(np.arange(len(good)), rows, column) for column in values[rows].T], axis=1
    )


def smooth_positions(
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    step: float,
    cutoff: float = 12.0,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Positions (m), velocities (m/s) and which measurements were believed.

    The positions minimise Σ w |p − z|² + λ Σ |Δ³p|² (Whittaker's smoother): the response falls to
    one half at `cutoff` Hz and stays 1 to 0.1 % below a third of it. Weights fall with the
    residual, which removes single jumps; where nothing was measured the smoother bridges with the
    smoothest acceleration.
    """
    n = len(position)
    smoothness = (2.0 * np.sin(np.pi * cutoff * step)) ** -6
    # Bands of Δ³ᵀΔ³, from its stencil (−1, 3, −3, 1).
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))  # upper form: bands[3 - d, j] couples j and j − d
    for a in range(4):
        for b in range(a, 4):
            bands[3 - (b - a), b : n - 3 + b] += stencil[a] * stencil[b]
    bands *= smoothness

    filled = np.where(good[:, None], position, 0.0)
    weight = good.astype(float)
    smooth = filled
    for _ in range(5):
        system = bands.copy()
        system[3] += weight + 1e-9
        smooth = solveh_banded(system, weight[:, None] * filled)
        distance = np.linalg.norm(filled - smooth, axis=1)
        scale = max(4.0 * float(np.median(distance[good])), 2e-3) if good.any() else 1.0
        weight = good / (1.0 + (distance / scale) ** 2) ** 2
    velocity = np.gradient(smooth, step, axis=0)
    return smooth, velocity, good & (weight > 0.1)


def _normal_equations(
    jacobian: np.ndarray, error: np.ndarray, weight: np.ndarray, block: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(Jᵀ W J, Jᵀ W e) when the errors of a block share an unknown offset, whose variance is that
    of the blocks' means.

    A gyro's bias drifts and a tracker's attitude is off by some tenths of a degree that depend on
    the place; white noise would take a minute of standing for thousands of proofs of one direction.
    """
    starts = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
    member = np.cumsum(np.diff(block, prepend=block[0] - 1) != 0) - 1
    total = np.add.reduceat(weight, starts)
    mean_jacobian = np.add.reduceat(weight[:, None, None] * jacobian, starts) / total[:, None, None]
    mean_error = np.add.reduceat(weight[:, None] * error, starts) / total[:, None]
    inner_jacobian, inner_error = jacobian - mean_jacobian[member], error - mean_error[member]
    mean_weight = 1.0 / (_robust_std(mean_error) ** 2 + 1.0 / total)
    rows = np.concatenate([inner_jacobian, mean_jacobian]).reshape(-1, jacobian.shape[2])
    errors = np.concatenate([inner_error, mean_error]).reshape(-1)
    weighted = rows * np.repeat(np.concatenate([weight, mean_weight]), 3)[:, None]
    return weighted.T @ rows, weighted.T @ errors


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def _within(where: np.ndarray, reach: float) -> np.ndarray:
    """True within `reach` samples of a True."""
    return np.asarray(maximum_filter1d(where.astype(np.uint8), 2 * int(np.ceil(reach)) + 1)).astype(
        bool
    )


def _second_difference(values: np.ndarray, step: float) -> np.ndarray:
    """Of a constant it is zero to the last bit, unlike a sampled derivative of a Gaussian."""
    inner = (values[2:] - 2.0 * values[1:-1] + values[:-2]) / step**2
    return np.concatenate([inner[:1], inner, inner[-1:]])


def _at(time: np.ndarray, values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Linear interpolation of rows on a uniform clock: the filter that follows hides what a spline
    would add."""
    place = np.clip(
        (where - time[0]) / (time[-1] - time[0]) * (len(time) - 1), 0.0, len(time) - 1.000001
    )
    left = place.astype(int)
    share = (place - left)[:, None]
    return (1.0 - share) * values[left] + share * values[left + 1]


def _covered(where: np.ndarray, time: np.ndarray, margin: float) -> np.ndarray:
    return (where > time[0] + margin) & (where < time[-1] - margin)


def _knots(time: np.ndarray, spacing: float) -> np.ndarray:
    return np.linspace(time[0], time[-1], max(int(np.ceil((time[-1] - time[0]) / spacing)), 1) + 1)


def _hat_functions(time: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(n, k): value at each time of the piecewise linear function that is 1 at one knot and 0 at
    the others."""
    return np.clip(1.0 - np.abs((time[:, None] - knots) / (knots[1] - knots[0])), 0.0, 1.0)


def _hat(vector: np.ndarray) -> np.ndarray:
    """(n, 3) → (n, 3, 3) cross-product matrices."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _robust_std(error: np.ndarray) -> float:
    return 1.4826 * float(np.median(np.abs(error)))


def _cauchy(error: np.ndarray, scale: float) -> np.ndarray:
    """Weights 1/scale² that fall with the squared length of each row, so that a flip counts for
    nothing."""
    return 1.0 / scale**2 / (1.0 + (error**2).sum(axis=1) / (3.0 * scale) ** 2)


def _unexplained(error: np.ndarray, signal: np.ndarray) -> float:
    """Power of the errors over that of the signal, (n, 3) both, on the `TRUSTED_SHARE` of the rows
    with the smallest errors."""
    square = (error**2).sum(axis=1)
    trusted = square <= np.quantile(square, TRUSTED_SHARE)
    return float(max(square[trusted].sum(), 1e-12) / max((signal[trusted] ** 2).sum(), 1e-12))


def _correlation_peaks(
    track_time: np.ndarray,
    track_turn: np.ndarray,
    time: np.ndarray,
    turn: np.ndarray,
    search: float,
) -> list[float]:
    """Lags (s) within ± `search` at which two magnitudes of angular rate correlate best nearby."""
    step = float(np.median(np.diff(track_time)))
    start = min(track_time[0], time[0])
    grid = np.arange(start, max(track_time[-1], time[-1]) + step, step)
    # Flips make rates that no hand makes: compare what is common.
    first = np.interp(grid, track_time, np.minimum(track_turn, 6.0), left=0.0, right=0.0)
    second = np.interp(grid, time, np.minimum(turn, 6.0), left=0.0, right=0.0)
    first, second = first - first.mean(), second - second.mean()
    score = correlate(second, first, method="fft")
    lags = correlation_lags(len(second), len(first)) * step
    score, lags = score[np.abs(lags) <= search], lags[np.abs(lags) <= search]
    # A peak may lie at the end of the search.
    padded = np.pad(score, 1, constant_values=-np.inf)
    peaks, _ = find_peaks(padded, distance=max(round(SAME_LAG / step), 1))
    return [float(lags[index]) for index in peaks - 1]


def _turn_residual(
    time: np.ndarray, felt: np.ndarray, track_time: np.ndarray, seen: _Seen, lag: float
) -> float:
    """What the best rotation of the IMU's filtered angular rates onto the tracker's leaves
    unexplained at a constant lag."""
    rows = np.arange(0, len(track_time), max(int(seen.sigma), 1))
    rows = rows[~seen.bad[rows] & _covered(track_time[rows] + lag, time, margin=4 * FILTER_SECONDS)]
    if len(rows) < 10:
        return np.inf
    there, rate = _at(time, felt, track_time[rows] + lag), seen.rate[rows]
    return _unexplained(rate - Rotation.align_vectors(rate, there)[0].apply(there), rate)


def _refine_by_segment(
    track_time: np.ndarray,
    track_turn: np.ndarray,
    bad: np.ndarray,
    time: np.ndarray,
    turn: np.ndarray,
    knots: np.ndarray,
    guess: float,
) -> np.ndarray:
    """Lag at each knot from the stretch around it, within ± 0.4 s of the common guess: some phones'
    clocks drift."""
    step = float(np.median(np.diff(track_time)))
    offsets = np.arange(-40, 41) * 0.01
    lag = np.full(len(knots), guess)
    for j, knot in enumerate(knots):
        rows = np.flatnonzero((np.abs(track_time - knot) < 15.0) & ~bad)
        if len(rows) * step < 5.0:
            continue
        seen = np.minimum(track_turn[rows], 6.0)
        if seen.std() < 0.05 or not _covered(track_time[rows] + guess, time, 1.0).all():
            continue
        score = [
            np.corrcoef(seen, np.interp(track_time[rows] + guess + offset, time, turn))[0, 1]
            for offset in offsets
        ]
        if max(score) > 0.6:
            lag[j] = guess + offsets[int(np.argmax(score))]
    # One wild knot among agreeing neighbours is a quiet stretch, not a clock.
    if len(lag) >= 3:
        padded = np.concatenate([lag[:1], lag, lag[-1:]])
        lag = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
    return lag
