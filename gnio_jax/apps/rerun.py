"""Results for the viewer Rerun (rerun.io): as a file, or sent while a trajectory is estimated.

Needs `gnio-jax[rerun]`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gnio_jax.drawing import AXES, BLUE, REFERENCE
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation import PreparedRecording, SequenceEstimate, Trajectory
from gnio_jax.evaluation.estimate import in_one_frame
from gnio_jax.evaluation.trajectory import Alignment
from gnio_jax.evaluation.views import SIGMAS
from gnio_jax.files import file_stems, replacing
from gnio_jax.filtering import Pose
from gnio_jax.numerics import finite_rows, quaternion_from_matrix, xyzw_from_wxyz

OPTION, VIEWER = "--rerun", "viewer"
"""This word in the place of a file's name starts the viewer."""
LINE_EVERY = 10
"""Number of poses between two drawings of the newest piece of a growing path."""
LONGEST_PIECE = 600
"""Number of poses of a piece. A piece is sent again when it grows; sending the whole path would
take more and more data."""


def check(target: str | Path) -> None:
    """Raise `InputError`, before any work, for a target that cannot be shown or written."""
    require_packages(OPTION, "rerun", "rerun")
    if target == VIEWER:
        return
    path = Path(target)
    if path.suffix.lower() != ".rrd":
        raise InputError(OPTION, f"'{path}' is not the name of Rerun's files", "name it NAME.rrd")
    if path.is_dir():
        raise InputError(OPTION, f"'{path}' is a folder", "name a file in it, NAME.rrd")


def write(
    path: Path,
    estimates: list[SequenceEstimate],
    recordings: list[PreparedRecording],
    alignment: Alignment | None = None,
) -> None:
    """Write sequences as one recording of Rerun, whole or not at all: for each its estimate and its
    reference in one frame (`estimate.in_one_frame`), and the IMU.

    Each sequence has a folder of its own with the name of its files. Times are counted from its
    start, s.
    """
    import rerun

    stems = file_stems([original.name for original in estimates])
    with replacing(path) as temporary:
        log = rerun.RecordingStream("gnio-jax", recording_id="gnio")
        log.save(temporary)
        log.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for stem, original, recording in zip(stems, estimates, recordings, strict=True):
            estimate = in_one_frame(original, alignment)
            _log_paths(log, stem, estimate)
            time = estimate.trajectory.time - estimate.trajectory.time[0]
            displacements, history = estimate.displacements, estimate.filtered
            curves = {
                **({} if displacements is None else displacements.diagnostics),
                "network_std": displacements and displacements.std,
                "nis": history and history.nis[:, None],
            }
            for name, values in curves.items():
                _log_curves(log, f"{stem}/{name}", time, values)
            samples = np.linspace(0.0, time[-1], len(recording.gyro), endpoint=False)
            _log_curves(log, f"{stem}/imu/gyro", samples, recording.gyro)
            _log_curves(log, f"{stem}/imu/accel", samples, recording.accel)
        log.disconnect()


def _log_paths(log: Any, stem: str, estimate: SequenceEstimate) -> None:
    """Log both paths as lines, and the pose of the estimate and its 3σ ellipsoid over time."""
    import rerun

    path, reference = estimate.trajectory, estimate.reference
    for kind, line, colour in (("reference", reference, REFERENCE), ("estimate", path, BLUE)):
        points = line.position[finite_rows(line.position)]
        if len(points):
            strip = rerun.LineStrips3D([points], colors=[_rgb(colour)])
            log.log(f"{stem}/{kind}", strip, static=True)
    if (rows := path.known).any():
        covariance = estimate.filtered and estimate.filtered.covariance[rows]
        poses = Trajectory(*(part[rows] for part in path))
        _log_poses(log, stem, poses._replace(time=poses.time - path.time[0]), covariance)


def _log_poses(
    log: Any, entity: str, poses: Trajectory, covariance: Float[np.ndarray, "k 3 3"] | None
) -> None:
    """Log poses over time, and the contours of the covariances of their positions (m²) at
    `SIGMAS`."""
    import rerun

    time = rerun.TimeColumn("time", duration=poses.time)
    quaternion = xyzw_from_wxyz(poses.orientation)
    pose = rerun.Transform3D.columns(translation=poses.position, quaternion=quaternion)
    log.send_columns(f"{entity}/pose", [time], pose)
    if covariance is None:
        return
    variance, axes = np.linalg.eigh(covariance)
    axes = axes * np.linalg.det(axes)[:, None, None]  # rotations, no reflections
    contour = rerun.Ellipsoids3D.columns(
        centers=poses.position,
        half_sizes=SIGMAS * np.sqrt(np.maximum(variance, 0.0)),
        quaternions=xyzw_from_wxyz(quaternion_from_matrix(axes)),
    )
    log.send_columns(f"{entity}/ellipsoid", [time], contour)


def _log_curves(log: Any, entity: str, time: Float[np.ndarray, "n"], values: Any) -> None:
    """Log curves (n, w) over time, where they are known; nothing for None."""
    import rerun

    if values is None or not (finite := finite_rows(values)).any():
        return
    colours = AXES if values.shape[1] == 3 else {entity.rpartition("/")[2]: BLUE}
    lines = rerun.SeriesLines(names=list(colours), colors=[*map(_rgb, colours.values())])
    log.log(entity, lines, static=True)
    column = rerun.TimeColumn("time", duration=time[finite])
    log.send_columns(entity, [column], rerun.Scalars.columns(scalars=values[finite]))


def _rgb(colour: str) -> tuple[int, ...]:
    """The three channels of #RRGGBB."""
    return tuple(bytes.fromhex(colour.removeprefix("#")))


# --- while a trajectory grows


@contextlib.contextmanager
def streaming(target: str) -> Iterator[RerunStream]:
    """A stream to the viewer, which is started, or into the file NAME.rrd, whole or not at all."""
    import rerun

    log = rerun.RecordingStream("gnio-jax")
    with contextlib.ExitStack() as file:
        if target == VIEWER:
            log.spawn()
        else:
            log.save(file.enter_context(replacing(Path(target))))
        stream = RerunStream(log)
        yield stream
        stream.finish()
        log.flush()
        log.disconnect()


class RerunStream:
    """A trajectory that is sent pose by pose. Its entities are those of a sequence `live` in a
    file."""

    def __init__(self, log: Any):
        import rerun

        self._log = log
        self._piece: list[np.ndarray] = []
        self._pieces = 0
        self._start: float | None = None
        log.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def add(self, pose: Pose) -> None:
        """Send the pose, its 3σ ellipsoid and its NIS, and sometimes the path. Nothing is sent
        after the filter has diverged."""
        import rerun

        if not pose.healthy:
            return
        self._start = pose.time if self._start is None else self._start
        time, attitude = np.array([pose.time - self._start]), pose.rotation[None]
        poses = Trajectory(time, pose.position[None], quaternion_from_matrix(attitude))
        _log_poses(self._log, "live", poses, pose.covariance[None, 6:9, 6:9])
        if np.isfinite(pose.nis):
            column = rerun.TimeColumn("time", duration=time)
            nis = rerun.Scalars.columns(scalars=[pose.nis])
            self._log.send_columns("live/nis", [column], nis)
        self._piece.append(np.array(pose.position))
        if len(self._piece) % LINE_EVERY == 0:
            self._draw()

    def finish(self) -> None:
        """Send the end of the path."""
        if len(self._piece) > 1:
            self._draw()

    def _draw(self) -> None:
        import rerun

        line = rerun.LineStrips3D([np.array(self._piece)], colors=[_rgb(BLUE)])
        self._log.log(f"live/estimate/{self._pieces:04d}", line, static=True)
        if len(self._piece) >= LONGEST_PIECE:
            self._piece, self._pieces = self._piece[-1:], self._pieces + 1
