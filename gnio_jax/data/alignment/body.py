"""The pose of an IMU on a tracked body, and the difference of their clocks.

An optical tracker gives the poses of a *marker body* on its own clock in its own, slightly tilted
world. The IMU is mounted somewhere else on that body, with another orientation and another clock.
`align` estimates all of this together from one recording. With the tracker's attitude R and
position p of the marker body at its time t, the two equations are, in the marker body,

    ω(t)                        = Rx (gyro(t + lag(t)) − b_g)
    Rᵀ (p̈ + R̈ l + g u)          = Rx (accel(t + lag(t) + δ) − b_a)

ω comes from differences of the tracked attitude, p̈ and R̈ from second differences. The unknowns
are the extrinsic rotation Rx (IMU → marker body), the lever arm l (in the marker body), the biases
b_g and b_a, the upward direction u in the tracker's world, a lag that is piecewise linear in time,
and a delay δ of the accelerometer relative to the gyro (phones filter it: 10 to 50 ms).

Both sides pass the same Gaussian filter once, before the fit; the lag changes so slowly that it
commutes with the filter. First guesses of the lag are the peaks of the correlation of the
magnitudes of both angular rates, ranked by how well one rotation explains the angular rates
(Wahba's problem). A robust least-squares fit starts from each of the best guesses. The fit that
leaves the smallest share of the signals' power unexplained is repeated with all its knots. The
model of the errors and the choice of the fit are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import fminbound, least_squares
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Samples, Streams, sort_streams
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.reference import LOST_POSES, Poses, longest_trusted, one_sign
from gnio_jax.data.resampling import covered_at, interpolate_splines
from gnio_jax.numerics import (
    hat,
    interpolate,
    levelling,
    midpoints,
    quaternions,
    robust_std,
    rotations,
    turns_between,
    within,
)
from gnio_jax.types import GRAVITY

RATE = 100.0
"""Rate of the clocks on which both sides are filtered, Hz."""
FILTER_SECONDS = 0.03
"""Standard deviation of the Gaussian filter, s: its pass band of 5 Hz contains the motion of a
gait."""
ROW_SECONDS = 0.05
"""Time between errors of the fit, s: the filter leaves little information between them."""
THINNED = 3
"""Every n-th of these errors is used to choose between first guesses."""
MARGIN = 0.2
"""Time at the ends of the IMU's samples that is not used, s: the filter's reach and the delay."""
SHORTEST_OVERLAP = 10.0
"""Shortest time of usable poses for a fit, s."""

STARTS = 3
"""Number of peaks of the correlation from which a fit starts. These fits have a knot of the lag per
30 s."""
SAME_LAG = 0.15
"""Largest difference of the lags of two fits that count as the same, s: less than half a step of a
runner."""
FASTEST_TURN = 6.0
"""Largest rate that is compared, rad/s: flips of the tracker give rates beyond those of a hand."""
TRUSTED_SHARE = 0.9
"""Share of the rows whose errors decide about a fit; the worst rows are the tracker's flips."""

PRIOR_STD = np.repeat([0.05, 0.15, 0.2, 0.05, 0.05], [3, 3, 3, 2, 1])
"""Standard deviations of weak priors around zero for unknowns that a recording does not determine:
biases of a phone (rad/s, m/s²), a lever arm on the hand (m), the tilt of the world (rad), the
accelerometer's delay (s)."""
TURN_STEP, LAG_STEP = 0.2, 0.05
"""Ranges within which the errors are about linear, rad and s; with `PRIOR_STD` the scale of the
trust region."""
LAG_BEND_STD = 0.02
"""Standard deviation of the second difference of the lag from knot to knot, s: clocks have almost
constant rates."""
BLOCK_SECONDS = 2.0
"""Time within which errors share an offset, s."""
LONGEST_POSE_LAG = 0.4
"""Largest lag of poses of the IMU's own body, s, in either direction."""
POSE_LAG_FILTER_SECONDS = 0.05
"""Standard deviation of the Gaussian filter of both angular rates in `pose_lag`, s."""
MOST_UNEXPLAINED = {"turning": 0.1, "acceleration": 0.5}
"""Largest shares of the signals' power that may remain unexplained in the fit of a phone to its own
tracker. The largest in OxIOD and Tyrex are 0.011 for the angular rate, and 0.19 for the
acceleration on a trolley, which mainly vibrates. With another walk's tracker 0.6 and more of the
angular rate remains."""
OUTLIER = 10.0
"""Number of robust standard deviations beyond which a row is not used in the next fit."""

TURN, GYRO_BIAS, ACCEL_BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
LEVER, TILT, DELAY, LAG = slice(9, 12), slice(12, 14), 14, slice(15, None)
"""Entries of the unknowns in a fit's vector: the turn from the first guess of the rotation (a
rotation vector, rad), biases, lever, horizontal part of the upward direction over its vertical
part, the accelerometer's delay, and the lag at each knot."""


class TooLittle(ValueError):
    """The overlap of the track and the IMU's recording is too short."""


class BodyFit(NamedTuple):
    """The result of `align`, in SI units."""

    extrinsic: Rotation
    """IMU → marker body."""
    lever: Float[np.ndarray, "3"]
    """Vector from the marker body's origin to the IMU, in the marker body, m."""
    up: Float[np.ndarray, "3"]
    """Unit vector against gravity in the tracker's world."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at even knots, s."""
    accel_delay: float
    """Delay of the accelerometer relative to the gyro, s."""
    gyro_residual: float
    """Robust standard deviation of the filtered angular rate's error, rad/s."""
    accel_residual: float
    """Robust standard deviation of the filtered acceleration's error, m/s²."""
    gyro_unexplained: float
    """Power of the filtered angular rate's error over that of the tracker's angular rate: 0 for a
    perfect fit, 1 for one that explains nothing."""
    accel_unexplained: float
    """Power of the filtered acceleration's error over that of the tracker's acceleration, without
    gravity."""
    runner_up: float
    """The unexplained share of this fit over that of the best fit with another lag; 0 if there is
    no other, 1 if both are equally good."""
    turn_std: float
    """Standard deviation of the extrinsic rotation about its least certain axis, rad: large if the
    body rests, or turns only about the vertical."""
    poses: Poses
    """The tracker's poses as poses of the IMU, with their noise: its attitude in a level world on
    its own clock, with the lever arm to it. Poses that strongly contradict its acceleration are
    left out."""

    def figures(self) -> dict[str, float]:
        """The figures of the fit for the attributes of a sequence."""
        vectors = {"lever": self.lever, "gyro_bias": self.gyro_bias, "accel_bias": self.accel_bias}
        return {
            "lag": float(np.mean(self.lag)),
            "lag_drift": float(np.ptp(self.lag)),
            "accel_delay_removed": self.accel_delay,
            "gyro_unexplained": self.gyro_unexplained,
            "accel_unexplained": self.accel_unexplained,
            "runner_up": self.runner_up,
            "extrinsic_uncertainty_degrees": float(np.degrees(self.turn_std)),
            "extrinsic_yaw_degrees": float(self.extrinsic.as_euler("ZXY", degrees=True)[0]),
            "extrinsic_tilt_degrees": _degrees_off(self.extrinsic.as_matrix()[2, 2]),
            "tilt_x": float(self.up[0] / self.up[2]),
            "tilt_y": float(self.up[1] / self.up[2]),
            "gyro_residual": self.gyro_residual,
            "accel_residual": self.accel_residual,
            **{f"{name}_{'xyz'[i]}": float(v[i]) for name, v in vectors.items() for i in range(3)},
        }


def with_tracker_poses(
    phone: Streams,
    track: Poses,
    limits: Mapping[str, tuple[float, str]],
    knot_seconds: float,
    search_seconds: float = 5.0,
    closest_runner_up: float = 1.0,
) -> Streams:
    """The phone's streams with the tracker's poses moved to the phone and its clock, with the delay
    of its accelerometer removed, and with the fit's figures as attributes. Raises `Refusal` if both
    do not fit together."""
    try:
        fit = align(phone, track, knot_seconds, search_seconds)
    except TooLittle as error:
        raise Refusal(track.source, f"cannot be aligned with the phone ({error})") from None
    check_fit(fit, track.source, limits, closest_runner_up)
    return phone._replace(
        accel=phone.accel._replace(time=phone.accel.time - fit.accel_delay),
        poses=fit.poses,
        attributes=phone.attributes | fit.figures(),
    )


def align(
    imu: Streams,
    track: Poses,
    knot_seconds: float = 30.0,
    search_seconds: float = 5.0,
) -> BodyFit:
    """The mounting of an IMU on a body whose noisy poses are `track`, both on clocks of their own.

    `knot_seconds` is the spacing of the lag's knots; first guesses of the lag are within ±
    `search_seconds`. Raises `TooLittle` if too little of the track is usable, and `InputError` for
    damaged stamps. `check_fit` decides whether the best fit is good enough.
    """
    imu = sort_streams(imu._replace(poses=track))
    assert imu.poses is not None
    track = imu.poses
    check_lengths(SHORTEST_OVERLAP, imu.gyro, imu.accel, track)
    inertial, tracker = _inertial_signals(imu), _tracker_signals(track)
    thinned, knots = tracker.rows(slice(None, None, THINNED)), uniform_knots(track.time, 30.0)
    candidates = []
    for lag, extrinsic in _first_guesses(tracker, inertial, search_seconds)[:STARTS]:
        with suppress(TooLittle):
            unknowns = np.concatenate([np.zeros(LAG.start), np.full(len(knots), lag)])
            candidates.append(_fit(thinned, inertial, knots, extrinsic, unknowns))
    if not candidates:
        raise TooLittle(f"less than {SHORTEST_OVERLAP:g} s of the track overlap the IMU's samples")
    best = min(candidates, key=lambda fit: fit.unexplained)
    lag = best.unknowns[LAG]
    others = [
        fit.unexplained
        for fit in candidates
        if abs(float(np.mean(fit.unknowns[LAG] - lag))) > SAME_LAG
    ]
    finer = uniform_knots(track.time, knot_seconds)
    unknowns = np.concatenate([best.unknowns[: LAG.start], np.interp(finer, knots, lag)])
    fit = _fit(tracker, inertial, finer, best.extrinsic, unknowns)
    x, up = fit.unknowns, upward(fit.unknowns[TILT])
    return BodyFit(
        extrinsic=fit.extrinsic,
        lever=x[LEVER],
        up=up,
        gyro_bias=x[GYRO_BIAS],
        accel_bias=x[ACCEL_BIAS],
        lag=x[LAG],
        accel_delay=float(x[DELAY]),
        gyro_residual=robust_std(fit.gyro),
        accel_residual=robust_std(fit.accel),
        gyro_unexplained=unexplained_share(fit.gyro, fit.tracker.rate),
        accel_unexplained=unexplained_share(fit.accel, fit.tracker.acceleration),
        runner_up=best.unexplained / min(others) if others else 0.0,
        turn_std=fit.turn_std,
        poses=_poses_of_the_imu(fit, finer, track, levelling(up)),
    )


def check_fit(
    fit: BodyFit,
    source: object,
    limits: Mapping[str, tuple[float, str]],
    closest_runner_up: float = 1.0,
) -> None:
    """Raise `Refusal` naming the tracker's file `source` if a fit does not explain the motion
    (`MOST_UNEXPLAINED`), exceeds the `limits` (most, unit) of a phone on its body, or is hardly
    better than a fit with another lag."""
    remedy = "check that both files are of one walk"
    shares = {"turning": fit.gyro_unexplained, "acceleration": fit.accel_unexplained}
    for what, share in shares.items():
        if not share <= MOST_UNEXPLAINED[what]:
            problem = f"does not move as the phone does: {share:.0%} of the power of its {what}"
            most = f"stays unexplained, at most {MOST_UNEXPLAINED[what]:.0%} is plausible"
            raise Refusal(source, f"{problem} {most}", remedy)
    figures = {
        "lag": np.abs(fit.lag).max(),
        "lag's drift": np.ptp(fit.lag),
        "accel's delay": abs(fit.accel_delay),
        "lever arm": np.linalg.norm(fit.lever),
        "mounting's turn": np.degrees(fit.extrinsic.magnitude()),
        "mounting's uncertainty": np.degrees(fit.turn_std),
        "world's tilt": _degrees_off(fit.up[2]),
        "gyro's bias": np.linalg.norm(fit.gyro_bias),
        "accel's bias": np.linalg.norm(fit.accel_bias),
    }
    for what, (most, unit) in limits.items():
        if not figures[what] <= most:
            value = f"the {what} would be {figures[what]:.3g} {unit}, at most {most:g} {unit}"
            problem = f"fits the phone only with impossible values: {value} is plausible"
            raise Refusal(source, problem, remedy)
    if not fit.runner_up <= closest_runner_up:
        problem = "fits the phone about as well at a second lag, because the walk repeats itself"
        share = f"the best lag leaves {fit.runner_up:.0%} of what the second leaves unexplained"
        raise Refusal(source, f"{problem} ({share})")


def _degrees_off(cosine: float) -> float:
    """Angle of this cosine, degrees."""
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _poses_of_the_imu(
    fit: _Fit, knots: Float[np.ndarray, " k"], track: Poses, level: Rotation
) -> Poses:
    # A track that strongly contradicts the accelerometer has jumped.
    contradiction = np.linalg.norm(fit.accel, axis=1)
    jumps = fit.tracker.time[contradiction > max(6.0, 8.0 * robust_std(fit.accel))]
    poses = track.rows(np.flatnonzero(~near_any(track.time, jumps, jumps, 0.1)))
    return poses._replace(
        time=poses.time + np.interp(poses.time, knots, fit.unknowns[LAG]),
        attitude=level * poses.attitude * fit.extrinsic,
        position=level.apply(poses.position),
        lever=fit.extrinsic.inv().apply(fit.unknowns[LEVER]),
        noisy=True,
    )


def without_jumps(poses: Poses, fastest_turn: float, fastest: float) -> Poses:
    """The poses that are not within 0.1 s of a step faster than `fastest_turn` (rad/s) or `fastest`
    (m/s), which is impossible for a person."""
    steps = np.diff(poses.time)
    angle = np.linalg.norm(turns_between(poses.attitude), axis=1)
    distance = np.linalg.norm(np.diff(poses.position, axis=0), axis=1)
    jumps = np.flatnonzero((angle > fastest_turn * steps) | (distance > fastest * steps))
    near = near_any(poses.time, poses.time[jumps], poses.time[jumps + 1], 0.1)
    return poses.rows(np.flatnonzero(~near))


# --- both sides of the equations, filtered


class _TrackerSignals(NamedTuple):
    """The tracker's side of both equations, filtered, where its poses are reliable."""

    time: Float[np.ndarray, " n"]
    """s, on the tracker's clock, `ROW_SECONDS` apart."""
    rate: Float[np.ndarray, "n 3"]
    """ω, rad/s."""
    acceleration: Float[np.ndarray, "n 3"]
    """Rᵀ p̈, m/s²."""
    lever_gain: Float[np.ndarray, "n 3 3"]
    """Rᵀ R̈, 1/s²."""
    to_body: Float[np.ndarray, "n 3 3"]
    """Rᵀ."""

    def rows(self, rows: np.ndarray | slice) -> _TrackerSignals:
        return _TrackerSignals(*(values[rows] for values in self))


class _InertialSignals(NamedTuple):
    """The IMU's side of both equations, filtered, at any time of its clock (s)."""

    gyro: CubicSpline
    """rad/s."""
    accel: CubicSpline
    """m/s²."""
    unknown: list[tuple[np.ndarray, np.ndarray]]
    """For each sensor, the beginnings and ends of its gaps, including the times before and after
    its samples."""

    def covers(self, time: Float[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
        """Whether both sensors were measured at a time and within `MARGIN` of it."""
        return ~np.any([near_any(time, *gaps, MARGIN) for gaps in self.unknown], axis=0)


def _tracker_signals(track: Poses) -> _TrackerSignals:
    clock, steps = np.arange(track.time[0], track.time[-1], 1.0 / RATE), np.diff(track.time)
    longest, sigma = LOST_POSES * float(np.median(steps)), FILTER_SECONDS * RATE
    present = covered_at(track.time, clock, longest)
    rows = np.flatnonzero(~within(~present, int(np.ceil(3 * sigma))))[:: round(ROW_SECONDS * RATE)]
    if len(rows) * ROW_SECONDS < SHORTEST_OVERLAP:
        raise TooLittle(f"less than {SHORTEST_OVERLAP:g} s of the track hold poses in a row")
    poses = np.concatenate([one_sign(quaternions(track.attitude)), track.position], axis=1)
    wxyz, position = np.split(
        interpolate_splines(track.time, poses, clock, steps > longest), [4], axis=1
    )
    attitude = rotations(wxyz)
    turning, matrices = turns_between(attitude) * RATE, attitude.as_matrix()
    to_body = matrices.transpose(0, 2, 1)
    sides = (
        np.concatenate([turning[:1], midpoints(turning), turning[-1:]]),
        np.einsum("nij,nj->ni", to_body, second_difference(position, 1.0 / RATE)),
        to_body @ second_difference(matrices, 1.0 / RATE),
        to_body,
    )
    return _TrackerSignals(clock[rows], *(smooth(side, sigma)[rows] for side in sides))


def _inertial_signals(imu: Streams) -> _InertialSignals:
    """Filter both sensors on uniform clocks."""
    splines, unknown = [], []
    for time, values, _ in (imu.gyro, imu.accel):
        clock, broken = np.arange(time[0], time[-1], 1.0 / RATE), gaps(time)
        filtered = smooth(interpolate_splines(time, values, clock, broken), FILTER_SECONDS * RATE)
        splines.append(CubicSpline(clock, filtered, axis=0))
        gap_starts = np.concatenate([[-np.inf], time[:-1][broken], time[-1:]])
        unknown.append((gap_starts, np.concatenate([time[:1], time[1:][broken], [np.inf]])))
    gyro, accel = splines
    return _InertialSignals(gyro, accel, unknown)


# --- first guesses


def _first_guesses(
    tracker: _TrackerSignals, inertial: _InertialSignals, search_seconds: float
) -> list[tuple[float, Rotation]]:
    """(lag s, extrinsic rotation) where the magnitudes of both angular rates correlate better than
    nearby, the most plausible first.

    A walk in circles or figures of eight has several such peaks, and the highest need not be the
    right one. A constant lag is therefore rated by the share of the angular rate that remains
    unexplained after the best rotation (Wahba's problem).
    """
    # This import takes half a second.
    from scipy.signal import correlate, correlation_lags, find_peaks

    grid = np.arange(
        tracker.time[0] - search_seconds, tracker.time[-1] + search_seconds, 1.0 / RATE
    )
    tracker_rate, inertial_rate = (
        np.interp(grid, time, np.minimum(np.linalg.norm(rate, axis=1), FASTEST_TURN), 0.0, 0.0)
        for time, rate in (
            (tracker.time, tracker.rate),
            (inertial.gyro.x, inertial.gyro(inertial.gyro.x)),
        )
    )
    score = correlate(
        inertial_rate - inertial_rate.mean(), tracker_rate - tracker_rate.mean(), method="fft"
    )
    lags = correlation_lags(len(grid), len(grid)) / RATE
    near = np.abs(lags) <= search_seconds
    # A peak may be at the end of the search.
    padded = np.pad(score[near], 1, constant_values=-np.inf)
    peaks, _ = find_peaks(padded, distance=max(round(SAME_LAG * RATE), 1))
    guesses = []
    for lag in lags[near][peaks - 1]:
        rows = inertial.covers(tracker.time + lag)
        if rows.sum() * ROW_SECONDS >= SHORTEST_OVERLAP:
            rate, turning = inertial.gyro(tracker.time[rows] + lag), tracker.rate[rows]
            u, _, vt = np.linalg.svd(turning.T @ rate)
            u[:, 2] *= np.linalg.det(u @ vt)  # a rotation, no reflection
            rotation = Rotation.from_matrix(u @ vt)
            guesses.append(
                (unexplained_share(turning - rotation.apply(rate), turning), lag, rotation)
            )
    guesses.sort(key=lambda guess: guess[0])
    return [(lag, rotation) for _, lag, rotation in guesses]


# --- the fit


class _Fit(NamedTuple):
    extrinsic: Rotation
    unknowns: Float[np.ndarray, " u"]
    """The vector with the slices above; `TURN` is included in `extrinsic`."""
    tracker: _TrackerSignals
    """The tracker's side in the rows that the IMU covers at the start."""
    gyro: Float[np.ndarray, "n 3"]
    """Errors of the angular rate in these rows, rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """Errors of the acceleration, m/s²."""
    turn_std: float
    """`BodyFit.turn_std`."""

    @property
    def unexplained(self) -> float:
        """Geometric mean of the shares of both signals' power. For noise of unknown size the fit
        with the smallest mean is the most likely."""
        turning = unexplained_share(self.gyro, self.tracker.rate)
        return float(np.sqrt(turning * unexplained_share(self.accel, self.tracker.acceleration)))


def _fit(
    tracker: _TrackerSignals,
    inertial: _InertialSignals,
    knots: Float[np.ndarray, " k"],
    extrinsic: Rotation,
    unknowns: Float[np.ndarray, " u"],
) -> _Fit:
    """The unknowns that explain both signals best, from a first guess.

    There are two rounds. Scale of the errors, variance of their offsets (`_Noise`) and outliers are
    those of the round before, or of the guess. Raises `TooLittle`.
    """
    hats = hat_functions(tracker.time, knots)
    covered = inertial.covers(tracker.time + hats @ unknowns[LAG])
    tracker, hats = tracker.rows(covered), hats[covered]
    if np.minimum(np.diff(tracker.time, append=np.inf), 1.0).sum() < SHORTEST_OVERLAP:
        raise TooLittle(f"less than {SHORTEST_OVERLAP:g} s of the track overlap the IMU's samples")
    reach = np.concatenate([np.full(3, TURN_STEP), PRIOR_STD, np.full(len(knots), LAG_STEP)])
    errors = Problem(tracker, inertial, hats, extrinsic).errors(unknowns)
    for _ in range(2):
        scales = max(robust_std(errors[0]), 1e-4), max(robust_std(errors[1]), 1e-3)
        deviations = [np.linalg.norm(e, axis=1) / s for e, s in zip(errors, scales, strict=True)]
        inliers = np.maximum(*deviations) <= max(OUTLIER, np.median(np.maximum(*deviations)))
        noises = [
            _noise(tracker.time[inliers], e[inliers], s)
            for e, s in zip(errors, scales, strict=True)
        ]
        problem = Problem(
            tracker.rows(inliers), inertial, hats[inliers], extrinsic, noises, unknowns
        )
        result = least_squares(
            problem.residuals,
            np.zeros(len(unknowns)),
            problem.derivatives,
            loss="cauchy",
            f_scale=3.0,
            x_scale=reach,
            ftol=1e-5,
            max_nfev=20,
        )
        unknowns = unknowns + result.x
        extrinsic = extrinsic * Rotation.from_rotvec(unknowns[TURN])
        unknowns[TURN] = 0.0
        errors = Problem(tracker, inertial, hats, extrinsic).errors(unknowns)
    return _Fit(extrinsic, unknowns, tracker, *errors, _turn_std(result.jac, int(inliers.sum())))


def _turn_std(jacobian: Float[np.ndarray, "r u"], rows: int) -> float:
    """Standard deviation of the turn about its least certain axis, rad, for unknown values of the
    other unknowns, from the derivatives of residuals of unit variance.

    The sensors' own noise seems to give information about the turn, 2 for each row and sensor, but
    it gives none; this part is subtracted.
    """
    information = jacobian.T @ jacobian
    turn, mixed, others = (
        information[rows, columns]
        for rows, columns in (
            (TURN, TURN),
            (TURN, slice(TURN.stop, None)),
            (slice(TURN.stop, None), slice(TURN.stop, None)),
        )
    )
    turn_information = turn - mixed @ np.linalg.pinv(others, hermitian=True) @ mixed.T
    return float(1.0 / np.sqrt(max(np.linalg.eigvalsh(turn_information)[0] - 4.0 * rows, 1e-12)))


class Problem(NamedTuple):
    """Both equations in some rows, and one round of least squares, whose unknowns are changes from
    `start`."""

    tracker: _TrackerSignals
    inertial: _InertialSignals
    hats: Float[np.ndarray, "n k"]
    guess: Rotation
    noises: list[_Noise] = []
    start: Float[np.ndarray, " u"] = np.zeros(0)

    def errors(
        self, x: Float[np.ndarray, " u"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """The tracker's side minus the IMU's, in the marker body: rad/s and m/s²."""
        extrinsic = self.guess * Rotation.from_rotvec(x[TURN])
        imu_time = self.tracker.time + self.hats @ x[LAG]
        rate = self.inertial.gyro(imu_time) - x[GYRO_BIAS]
        force = self.inertial.accel(imu_time + x[DELAY]) - x[ACCEL_BIAS]
        tracked = self.tracker.acceleration + self.tracker.lever_gain @ x[LEVER]
        tracked = tracked + GRAVITY * self.tracker.to_body @ upward(x[TILT])
        return self.tracker.rate - extrinsic.apply(rate), tracked - extrinsic.apply(force)

    def jacobians(
        self, x: Float[np.ndarray, " u"]
    ) -> tuple[Float[np.ndarray, "n 3 u"], Float[np.ndarray, "n 3 u"]]:
        """Derivatives of `errors` by the unknowns; finite differences would take three times as
        long."""
        rotation = (self.guess * Rotation.from_rotvec(x[TURN])).as_matrix()
        # Derivative by the rotation vector, to the second order of the turn.
        turned = np.eye(3) - hat(x[TURN]) / 2.0 + hat(x[TURN]) @ hat(x[TURN]) / 6.0
        imu_time = self.tracker.time + self.hats @ x[LAG]
        accel_time = imu_time + x[DELAY]
        gyro, accel = (np.zeros((len(self.hats), 3, len(x))) for _ in range(2))
        gyro[:, :, TURN] = rotation @ hat(self.inertial.gyro(imu_time) - x[GYRO_BIAS]) @ turned
        gyro[:, :, GYRO_BIAS] = rotation
        turning = self.inertial.gyro(imu_time, 1) @ rotation.T
        gyro[:, :, LAG] = -turning[:, :, None] * self.hats[:, None, :]
        accel[:, :, TURN] = rotation @ hat(self.inertial.accel(accel_time) - x[ACCEL_BIAS]) @ turned
        accel[:, :, ACCEL_BIAS] = rotation
        accel[:, :, LEVER] = self.tracker.lever_gain
        up = upward(x[TILT])
        by_tilt = up[2] * np.eye(3)[:, :2] - up[2] * np.outer(up, up[:2])
        accel[:, :, TILT] = GRAVITY * self.tracker.to_body @ by_tilt
        accel[:, :, DELAY] = -self.inertial.accel(accel_time, 1) @ rotation.T
        accel[:, :, LAG] = accel[:, :, DELAY, None] * self.hats[:, None, :]
        return gyro, accel

    def residuals(self, change: Float[np.ndarray, " u"]) -> Float[np.ndarray, " r"]:
        x = self.start + change
        return self._whiten(self.errors(x), x)

    def derivatives(self, change: Float[np.ndarray, " u"]) -> Float[np.ndarray, "r u"]:
        x = self.start + change
        return self._whiten(self.jacobians(x), np.eye(len(x)))

    def _whiten(self, sides: tuple[np.ndarray, np.ndarray], x: np.ndarray) -> np.ndarray:
        """Rows of both sides and of the priors, for the errors or their derivatives."""
        rows = (noise.whiten(side) for noise, side in zip(self.noises, sides, strict=True))
        prior = (x[3:15].T / PRIOR_STD).T
        return np.concatenate([*rows, prior, np.diff(x[LAG], 2, axis=0) / LAG_BEND_STD])


class _Noise(NamedTuple):
    """Errors that are white except for an offset that each block of them shares: a gyro's bias
    drifts, and a tracker's attitude has an error of some tenths of a degree that depends on the
    place. With white noise a minute at rest would count as thousands of independent measurements of
    one direction."""

    scale: float
    """Standard deviation of the white part."""
    starts: Int[np.ndarray, " b"]
    """First row of each block."""
    counts: Int[np.ndarray, " b"]
    """Rows of each block."""
    spread: Float[np.ndarray, " b"]
    """Standard deviation of each block's mean over `scale`."""

    def whiten(self, values: Float[np.ndarray, "n 3 *u"]) -> Float[np.ndarray, "r *u"]:
        """Errors, or their derivatives, as uncorrelated rows of unit variance."""
        values, ones = values / self.scale, (1,) * (values.ndim - 1)
        mean = np.add.reduceat(values, self.starts) / self.counts.reshape(-1, *ones)
        inner = values - np.repeat(mean, self.counts, axis=0)
        whole = np.concatenate([inner, mean / self.spread.reshape(-1, *ones)])
        return whole.reshape(-1, *values.shape[2:])


def _noise(time: np.ndarray, error: Float[np.ndarray, "n 3"], scale: float) -> _Noise:
    blocks = np.floor(time / BLOCK_SECONDS)
    _, starts, counts = np.unique(blocks, return_index=True, return_counts=True)
    mean = np.add.reduceat(error / scale, starts) / counts[:, None]
    return _Noise(scale, starts, counts, np.sqrt(robust_std(mean) ** 2 + 1.0 / counts))


def upward(tilt: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
    """Unit vector whose horizontal part over its vertical part is `tilt`."""
    return np.array([*tilt, 1.0]) / np.sqrt(1.0 + tilt @ tilt)


def unexplained_share(error: Float[np.ndarray, "n 3"], signal: Float[np.ndarray, "n 3"]) -> float:
    """Power of the errors over that of the signal, on the `TRUSTED_SHARE` of the rows with the
    smallest errors."""
    square = (error**2).sum(axis=1)
    trusted = square <= np.quantile(square, TRUSTED_SHARE)
    return float(max(square[trusted].sum(), 1e-12) / max((signal[trusted] ** 2).sum(), 1e-12))


# --- the lag alone, of poses that are the IMU's own


class PoseLag(NamedTuple):
    """The result of `pose_lag`."""

    lag: float
    """Stamp of a pose minus stamp of the IMU's sample of the same event, s."""
    correlation: float
    """Correlation of the angular rates after the lag is removed, all axes together; 1 if nothing
    turns, so that no lag can be found."""


def pose_lag(
    time: Float[np.ndarray, " n"],
    gyro: Float[np.ndarray, "n 3"],
    stamps: Float[np.ndarray, " m"],
    attitude: Rotation,
) -> PoseLag:
    """Lag of poses of the IMU's body, from the angular rates of both.

    `time`, `stamps` s; `gyro` rad/s; `attitude` m rotations body→world. It is the lag with the
    smallest mean size of gyro(t) − bias − rate(t + lag), both smoothed over 0.05 s (σ).
    """
    steps, middle = np.diff(stamps), midpoints(stamps)
    margin = round((LONGEST_POSE_LAG + 0.1) * RATE)
    if not steps.any():
        return PoseLag(0.0, 1.0)
    adjacent = (steps > 0.0) & (steps <= LOST_POSES * np.median(steps[steps > 0.0]))
    clock = np.arange(max(time[0], middle[0]), min(time[-1], middle[-1]), 1.0 / RATE)
    if len(clock) < 5 * RATE + 2 * margin:
        return PoseLag(0.0, 1.0)
    turning = turns_between(attitude)[adjacent] / steps[adjacent, None]
    gyro_rate, pose_rate = (
        smooth(interpolate(clock, sample_times, rate), POSE_LAG_FILTER_SECONDS * RATE)
        for sample_times, rate in ((time, gyro), (middle[adjacent], turning))
    )
    pose_rate = CubicSpline(clock, pose_rate, axis=0)
    clock, gyro_rate = clock[margin:-margin], gyro_rate[margin:-margin]
    if float(np.median(np.linalg.norm(gyro_rate - np.median(gyro_rate, axis=0), axis=1))) < 0.02:
        return PoseLag(0.0, 1.0)

    def mismatch(lag: float) -> float:
        error = gyro_rate - pose_rate(clock + lag)
        return float(np.abs(error - np.median(error, axis=0)).mean())

    most = round(LONGEST_POSE_LAG * 100)
    lag = min((i / 100.0 for i in range(-most, most + 1)), key=mismatch)
    best = float(fminbound(mismatch, lag - 0.01, lag + 0.01, xtol=1e-5))
    first, second = (rate - rate.mean(axis=0) for rate in (gyro_rate, pose_rate(clock + best)))
    power = np.sqrt((first**2).sum() * (second**2).sum())
    return PoseLag(best, float((first * second).sum() / power))


# --- shared with `positions`


def check_lengths(seconds: float, *streams: Samples | Poses) -> None:
    """Raise `TooLittle` if one of the streams is shorter than this."""
    for stream in streams:
        if len(stream.time) < 2 or stream.time[-1] - stream.time[0] < seconds:
            raise TooLittle(f"less than {seconds:g} s are recorded in {stream.source}")


def gaps(time: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " i"]:
    """Which intervals between samples are too long to be interpolated."""
    return np.diff(time) > longest_trusted(time)


def near_any(
    time: Real[np.ndarray, " n"],
    starts: Real[np.ndarray, " k"],
    ends: Real[np.ndarray, " k"],
    margin: float,
) -> Bool[np.ndarray, " n"]:
    """Whether a time is within an interval from one of `starts` to its end, extended by `around`.
    Starts and ends increase."""
    started = np.searchsorted(starts, time + margin, side="right")
    return started != np.searchsorted(ends, time - margin)


def smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """Rows filtered by a Gaussian of `sigma` samples; the first and last row are repeated beyond
    the ends."""
    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def second_difference(values: Float[np.ndarray, "n *w"], step: float) -> Float[np.ndarray, "n *w"]:
    """Second derivative of uniform samples by central differences; the ends repeat their
    neighbours.

    For a constant it is exactly zero, unlike a sampled derivative of a Gaussian.
    """
    inner = (values[2:] - 2.0 * values[1:-1] + values[:-2]) / step**2
    return np.concatenate([inner[:1], inner, inner[-1:]])


def uniform_knots(time: Float[np.ndarray, " n"], spacing: float) -> Float[np.ndarray, " k"]:
    """Knots over a clock, evenly spaced by at most `spacing` (s)."""
    intervals = max(int(np.ceil((time[-1] - time[0]) / spacing)), 1)
    return np.linspace(time[0], time[-1], intervals + 1)


def hat_functions(
    time: Float[np.ndarray, " n"], knots: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "n k"]:
    """Basis of piecewise linear functions of time: each is 1 at one knot and 0 at the others."""
    return np.clip(1.0 - np.abs((time[:, None] - knots) / (knots[1] - knots[0])), 0.0, 1.0)
