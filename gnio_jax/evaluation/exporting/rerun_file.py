"""Results for the viewer Rerun (rerun.io): trajectory, reference, IMU, covariance, network.

Needs `gnio-jax[rerun]`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation import Estimate, Recording
from gnio_jax.evaluation.report import file_names
from gnio_jax.files import replacing
from gnio_jax.numerics import finite_rows, quaternion_from_matrix, xyzw_from_wxyz

OPTION = "--rerun"
BLACK, BLUE, VERMILION, GREEN = (0, 0, 0), (0, 114, 178), (213, 94, 0), (0, 158, 115)
AXES = ("x", "y", "z")
SIGMAS = 3.0
"""Size of the ellipsoids, in standard deviations."""


class Logged(NamedTuple):
    """One sequence of the file."""

    estimate: Estimate
    """In the frame in which it is looked at, and so its reference."""
    recording: Recording
    """Its IMU is shown."""


def check_file(path: Path) -> None:
    """Refuse, before the work, what cannot be written. Raises `InputError`."""
    require_packages(OPTION, "rerun", "rerun")
    if path.suffix.lower() != ".rrd":
        raise InputError(OPTION, f"'{path}' is no name of Rerun's files", "name it NAME.rrd")
    if path.is_dir():
        raise InputError(OPTION, f"'{path}' is a folder", "name a file in it, NAME.rrd")


def write_rerun(path: Path, logged: list[Logged], name: str = "gnio") -> None:
    """Write the sequences as one recording of Rerun, whole or not at all.

    Each has a folder of its own, named as its files. Times are those from its start, s.
    """
    import rerun

    stems = file_names([each.estimate.name for each in logged])
    with replacing(path) as temporary:
        recording = rerun.RecordingStream("gnio-jax", recording_id=name)
        recording.save(temporary)
        recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for stem, each in zip(stems, logged, strict=True):
            _log_paths(recording, stem, each.estimate)
            _log_network_and_filter(recording, stem, each.estimate)
            _log_imu(recording, stem, each.recording)
        recording.disconnect()


def _log_paths(recording: Any, stem: str, estimate: Estimate) -> None:
    """Both paths as lines; the pose of the estimate and its 3σ ellipsoid over time."""
    import rerun

    path, reference = estimate.trajectory, estimate.reference
    for kind, line, colour in (("reference", reference, BLACK), ("estimate", path, BLUE)):
        points = line.position[finite_rows(line.position)]
        if len(points):
            strip = rerun.LineStrips3D([points], colors=[colour])
            recording.log(f"{stem}/{kind}", strip, static=True)
    rows = finite_rows(path.position) & finite_rows(path.orientation)
    if not rows.any():
        return
    pose = rerun.Transform3D.columns(
        translation=path.position[rows], quaternion=xyzw_from_wxyz(path.orientation[rows])
    )
    time = _times(path.time[rows] - path.time[0])
    recording.send_columns(f"{stem}/pose", [time], pose)
    if estimate.filtered is not None:
        half_sizes, axes = ellipsoids(estimate.filtered.covariance[rows])
        contour = rerun.Ellipsoids3D.columns(
            centers=path.position[rows], half_sizes=half_sizes, quaternions=xyzw_from_wxyz(axes)
        )
        recording.send_columns(f"{stem}/ellipsoid", [time], contour)


def ellipsoids(
    covariance: Float[np.ndarray, "k 3 3"],
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 4"]]:
    """Half sizes, m, and attitudes (wxyz) of the contours of covariances (m²) at `SIGMAS`."""
    variance, axes = np.linalg.eigh(covariance)
    axes = axes * np.linalg.det(axes)[:, None, None]  # rotations, no reflections
    return SIGMAS * np.sqrt(np.maximum(variance, 0.0)), quaternion_from_matrix(axes)


def _log_network_and_filter(recording: Any, stem: str, estimate: Estimate) -> None:
    """Gate, scale and σ of the network, the innovations of the filter."""
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    found, filtered = estimate.displacements, estimate.filtered
    curves = {
        **({} if found is None else found.diagnostics),
        "network_std": found and found.std,
        "nis": filtered and filtered.nis[:, None],
    }
    for name, values in curves.items():
        if values is not None:
            _log_curves(recording, f"{stem}/{name}", time, values)


def _log_imu(log: Any, stem: str, recording: Recording) -> None:
    """Gyro, rad/s, and accelerometer, m/s²."""
    seconds = recording.time[-1] - recording.time[0]
    time = np.linspace(0.0, seconds, len(recording.gyro), endpoint=False)
    for name, values in (("gyro", recording.gyro), ("accel", recording.accel)):
        _log_curves(log, f"{stem}/imu/{name}", time, values)


def _log_curves(
    recording: Any, place: str, time: Float[np.ndarray, "n"], values: Float[np.ndarray, "n w"]
) -> None:
    """Curves over time, where they are known."""
    import rerun

    known = finite_rows(values)
    if not known.any():
        return
    names = list(AXES) if values.shape[1] == 3 else [place.rpartition("/")[2]]
    colours = [BLUE, VERMILION, GREEN][: len(names)]
    recording.log(place, rerun.SeriesLines(names=names, colors=colours), static=True)
    curves = rerun.Scalars.columns(scalars=values[known])
    recording.send_columns(place, [_times(time[known])], curves)


def _times(seconds: Float[np.ndarray, "n"]) -> Any:
    import rerun

    return rerun.TimeColumn("time", duration=seconds)
