"""The trajectory in the viewer Rerun (rerun.io) while it grows, or in a file for it.

Needs `gnio-jax[rerun]`. The places are those of the file of an evaluation.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from gnio_jax.errors import require_packages
from gnio_jax.evaluation.exporting.rerun_file import BLUE, OPTION, check_file, ellipsoids
from gnio_jax.files import replacing
from gnio_jax.filtering import Pose
from gnio_jax.numerics import quaternion_from_matrix, xyzw_from_wxyz

VIEWER = "viewer"
"""In the place of a file's name: show it now."""
LINE_EVERY = 10
"""Poses between two drawings of the newest piece of the path."""
LONGEST_PIECE = 600
"""Poses. A piece is sent anew when it grows: with the whole path that would be ever more."""
PLACE = "live"


def check(target: str) -> None:
    """Refuse, before the work, what cannot be shown or written. Raises `InputError`."""
    if target == VIEWER:
        require_packages(OPTION, "rerun", "rerun")
    else:
        check_file(Path(target))


@contextlib.contextmanager
def streaming(target: str) -> Iterator[RerunStream]:
    """To the viewer, which is started, or into the file NAME.rrd, whole or not at all."""
    import rerun

    recording = rerun.RecordingStream("gnio-jax")
    with contextlib.ExitStack() as file:
        if target == VIEWER:
            recording.spawn()
        else:
            recording.save(file.enter_context(replacing(Path(target))))
        stream = RerunStream(recording)
        yield stream
        stream.finish()
        recording.flush()
        recording.disconnect()


class RerunStream:
    """What has been sent of a trajectory."""

    def __init__(self, recording: Any):
        import rerun

        self._recording = recording
        self._piece: list[np.ndarray] = []
        self._pieces = 0
        self._start: float | None = None
        recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def add(self, pose: Pose) -> None:
        """Send the pose, its 3σ ellipsoid and its NIS; now and then the path. Nothing of a filter
        that has diverged."""
        import rerun

        if not pose.healthy:
            return
        recording = self._recording
        self._start = pose.time if self._start is None else self._start
        recording.set_time("time", duration=timedelta(seconds=pose.time - self._start))
        quaternion = xyzw_from_wxyz(quaternion_from_matrix(pose.rotation[None]))[0]
        moved = rerun.Transform3D(translation=pose.position, quaternion=quaternion)
        recording.log(f"{PLACE}/pose", moved)
        half_sizes, axes = ellipsoids(pose.covariance[None, 6:9, 6:9])
        contour = rerun.Ellipsoids3D(
            centers=[pose.position], half_sizes=half_sizes, quaternions=xyzw_from_wxyz(axes)
        )
        recording.log(f"{PLACE}/ellipsoid", contour)
        if np.isfinite(pose.nis):
            recording.log(f"{PLACE}/nis", rerun.Scalars([pose.nis]))
        self._piece.append(np.array(pose.position))
        if len(self._piece) % LINE_EVERY == 0:
            self._draw()

    def finish(self) -> None:
        """Send the end of the path."""
        if len(self._piece) > 1:
            self._draw()

    def _draw(self) -> None:
        import rerun

        line = rerun.LineStrips3D([np.array(self._piece)], colors=[BLUE])
        self._recording.log(f"{PLACE}/estimate/{self._pieces:04d}", line, static=True)
        if len(self._piece) >= LONGEST_PIECE:
            self._piece, self._pieces = self._piece[-1:], self._pieces + 1
