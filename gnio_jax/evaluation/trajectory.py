"""Trajectories: their definition, their alignment with each other, and the TUM format of evo."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.data.parsing.tables import Table, read_text
from gnio_jax.data.validation import check_increasing
from gnio_jax.errors import InputError
from gnio_jax.numerics import (
    finite_rows,
    quaternion_from_matrix,
    quaternion_product,
    quaternions,
    rotation_z,
    xyzw_from_wxyz,
)
from gnio_jax.types import Waypoints

Quaternions = Float[np.ndarray, "n 4"]
Alignment = Literal["origin", "none", "yaw_position", "se3"]
TUM = "t x y z qx qy qz qw"
TXY = "t x y"
SAME_MOMENT = 0.01
"""Largest difference of matching stamps of an estimate and a reference, s, as in evo."""
PACE = 0.1
"""Largest relative error of a time that is counted in rows (ours)."""
SCATTERED = 100
"""Mean number of steps per shared stamp above which two files are not of the same walk (ours)."""
NEAR = 0.2
"""Largest time of a waypoint before the start or after the end of a trajectory, s (ours); it then
counts at that end. A person does not tap more accurately, and a trajectory ends with a whole
stride."""


class Undefined(ValueError):
    """A metric or an alignment has no value for this trajectory. The text is the reason."""


class Trajectory(NamedTuple):
    """Poses at uniform times. A row that is not known is NaN."""

    time: Float[np.ndarray, "n"]
    """Stamps, s."""
    position: Float[np.ndarray, "n 3"]
    """In the world (z up), m."""
    orientation: Quaternions
    """Body→world, unit quaternions wxyz."""

    @property
    def known(self) -> Bool[np.ndarray, "n"]:
        """Rows whose position and orientation are finite."""
        return finite_rows(self.position) & finite_rows(self.orientation)


def relative_yaw(estimate: Quaternions, reference: Quaternions) -> Float[np.ndarray, "n"]:
    """Yaw error of attitudes R̂ against R, rad in (−π, π].

    It is the angle ψ that minimises ‖R̂ − R_z(ψ) R‖. With E = R̂ Rᵀ the square of that norm is 6 −
    2 (cos ψ (E00 + E11) + sin ψ (E10 − E01) + E22), so ψ = atan2(E10 − E01, E00 + E11): the twist
    of E about z, whatever the attitude of the phone. Between level attitudes it is the difference
    of their yaws. It is 0 where E is half a turn about a horizontal axis, where all ψ are equally
    near (ours), and NaN where an input is NaN.
    """
    (a, b, c, d), (w, x, y, z) = estimate.T, reference.T
    scalar, vertical = a * w + b * x + c * y + d * z, d * w - a * z + c * x - b * y
    return np.arctan2(2 * scalar * vertical, scalar**2 - vertical**2)


def align(
    estimate: Trajectory, reference: Trajectory | Waypoints, how: Alignment = "origin"
) -> Trajectory:
    """The estimate moved into the frame of the reference by one rigid motion.

    The motion is fitted to the rows that are known in both trajectories. `origin` matches position
    and yaw of the first of these rows, which a user of odometry knows. `yaw_position` is the
    least-squares motion of the four degrees of freedom that inertial odometry cannot observe. `se3`
    is that of all six, without scale (Horn/Kabsch, as evo). `none` changes nothing. For waypoints,
    and any `how`, the estimate is turned about z and shifted horizontally so that it is nearest to
    them at their times, in least squares. Raises `Undefined` if there is no such row, or fewer than
    three for `se3` or two waypoints.
    """
    if isinstance(reference, Waypoints):
        positions = positions_at(estimate, reference.time)
        finite = finite_rows(positions)
        if finite.sum() < 2:
            raise Undefined("fewer than two waypoints are within the estimate")
        source, target = positions[finite].mean(0), reference.position[finite].mean(0)
        turn = _best_turn(positions[finite] - source, reference.position[finite] - target)
        return _move(estimate, turn, np.append(source, 0.0), np.append(target, 0.0))
    if how == "none":
        return estimate
    trusted = reference.known if how == "origin" else finite_rows(reference.position)
    if not trusted.any():
        raise Undefined("no trusted reference")
    rows = np.flatnonzero(trusted & estimate.known)
    if not len(rows):
        raise Undefined("the estimate is not finite in any trusted row")
    if how == "se3" and len(rows) < 3:
        raise Undefined("fewer than three trusted rows to align")
    if how == "origin":
        rows = rows[:1]
    source, target = estimate.position[rows].mean(0), reference.position[rows].mean(0)
    a, b = estimate.position[rows] - source, reference.position[rows] - target
    if how == "origin":
        turn = rotation_z(relative_yaw(reference.orientation[rows], estimate.orientation[rows])[0])
    elif how == "yaw_position":
        turn = _best_turn(a, b)
    else:
        u, _, vt = np.linalg.svd(b.T @ a)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt  # no reflection
    return _move(estimate, turn, source, target)


def positions_at(path: Trajectory, stamps: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 2"]:
    """Horizontal positions at given times, on straight lines between the rows, m. NaN next to an
    unknown row and at times further than `NEAR` from the trajectory."""
    x, y = (np.interp(stamps, path.time, axis) for axis in path.position[:, :2].T)
    within = (stamps >= path.time[0] - NEAR) & (stamps <= path.time[-1] + NEAR)
    return np.where(within[:, None], np.stack([x, y], 1), np.nan)


def _best_turn(
    source: Float[np.ndarray, "k _"], target: Float[np.ndarray, "k _"]
) -> Float[np.ndarray, "3 3"]:
    """The turn about z that brings centred points nearest to others, in least squares; the identity
    if all points of either set are the same."""
    sine = source[:, 0] @ target[:, 1] - source[:, 1] @ target[:, 0]
    cosine = source[:, 0] @ target[:, 0] + source[:, 1] @ target[:, 1]
    return rotation_z(np.arctan2(sine, cosine))


def _move(
    estimate: Trajectory,
    turn: Float[np.ndarray, "3 3"],
    source: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
) -> Trajectory:
    """Turn the trajectory about `source`, which moves to `target`."""
    return Trajectory(
        estimate.time,
        (estimate.position - source) @ turn.T + target,
        quaternion_product(quaternion_from_matrix(turn), estimate.orientation),
    )


def pair(
    estimate: Trajectory, reference: Trajectory, most: float = SAME_MOMENT
) -> tuple[Trajectory, Trajectory]:
    """Bring both trajectories to the stamps that they share, to `most` s: each pose of the
    reference with the nearest one of the estimate, as evo matches them.

    The step of the rows is the median step of the shared stamps, halved until no two stamps fall in
    one row and the rows keep the time of the stamps to `PACE`; then it is their mean. Rows are
    counted from stamp to stamp, so that a rate which is not quite constant leaves no row without a
    stamp. Such rows are ignored: the reference is NaN there, and the estimate keeps its last pose.
    Raises `Undefined` for fewer than two shared stamps, or where they are scattered over more than
    a hundred times as many rows.
    """
    if len(reference.time) < 2:
        raise Undefined("the reference has a single pose")
    after = np.searchsorted(reference.time[1:-1], estimate.time) + 1
    delay, lead = (np.abs(reference.time[row] - estimate.time) for row in (after, after - 1))
    nearest, offset = np.where(delay < lead, after, after - 1), np.minimum(delay, lead)
    order = np.argsort(offset, kind="stable")
    matches, first = np.unique(nearest[order[offset[order] <= most]], return_index=True)
    estimate_rows = order[first]
    if len(estimate_rows) < 2:
        raise Undefined(f"fewer than two stamps are the same to {most:g} s")
    time = reference.time[matches]
    step, rows = float(np.median(np.diff(time))), np.zeros(len(time), int)
    while True:
        rows[1:] = np.cumsum(np.round(np.diff(time) / step))
        if rows[-1] > SCATTERED * len(rows):
            span = f"{time[-1] - time[0]:.0f} s"
            raise Undefined(f"only {len(rows)} stamps in {span}, unevenly spaced, are the same")
        if (np.diff(rows) > 0).all() and _keep_time(rows, time):
            break
        step /= 2
    step = float((time[-1] - time[0]) / rows[-1])
    shared = np.isin(np.arange(rows[-1] + 1), rows)
    clock = time[0] + step * np.arange(rows[-1] + 1)
    poses = [np.full((len(clock), width), np.nan) for width in (3, 4)]
    for part, values in zip(poses, reference[1:], strict=True):
        part[rows] = values[matches]
    latest = estimate_rows[np.cumsum(shared) - 1]
    path = Trajectory(clock, estimate.position[latest], estimate.orientation[latest])
    return path, Trajectory(clock, *poses)


def _keep_time(rows: Int[np.ndarray, "n"], time: Float[np.ndarray, "n"]) -> bool:
    """Whether every second that is counted in rows, or every ten rows if they are longer, is as
    long by the stamps, to `PACE`."""
    step = (time[-1] - time[0]) / rows[-1]
    stop = np.searchsorted(rows, rows + max(10.0, 1.0 / step) - 1e-6)
    begin = np.flatnonzero(stop < len(rows))
    of_rows, of_stamps = (part[stop[begin]] - part[begin] for part in (step * rows, time))
    return bool((np.abs(of_rows - of_stamps) <= PACE * of_stamps).all())


def align_if_possible(
    path: Trajectory, other: Trajectory | Waypoints, how: Alignment = "origin"
) -> Trajectory:
    """`align`, or `path` unchanged if an alignment is impossible; for pictures."""
    try:
        return align(path, other, how)
    except Undefined:
        return path


def write_waypoints(path: Path, waypoints: Waypoints) -> None:
    """Write a line `t x y` (s, m) for every waypoint."""
    np.savetxt(path, np.column_stack(waypoints), fmt="%.9f", header=TXY)


def read_waypoints(path: Path) -> Waypoints:
    """Read what `write_waypoints` wrote. Raises `InputError` for anything else."""
    table = _read_columns(path, TXY)
    return Waypoints(table.take("t"), np.stack([table.take("x"), table.take("y")], 1))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a line `t x y z qx qy qz qw` (s, m, body→world) for every row that is known."""
    poses = [trajectory.time, trajectory.position, xyzw_from_wxyz(trajectory.orientation)]
    np.savetxt(path, np.column_stack(poses)[trajectory.known], fmt="%.9f", header=TUM)


def read_tum(path: Path) -> Trajectory:
    """Read a file in TUM format. Raises `InputError` for anything else."""
    table = _read_columns(path, TUM)
    attitude = table.rotations("qx", "qy", "qz", "qw", scalar_first=False)
    return Trajectory(table.take("t"), table.axes(""), quaternions(attitude))


def _read_columns(path: Path, names: str) -> Table:
    """A file whose columns are these, the first with stamps that increase."""
    table, columns = read_text(path, separator=" ", header=False), names.split()
    if table.width() != len(columns):
        problem = f"has {table.width()} columns, not {len(columns)}"
        raise InputError(path, problem, f"they are {names}")
    table = table.rename(columns)
    check_increasing(table.take("t"), path, table.row)
    return table
