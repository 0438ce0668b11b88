"""How far a track goes and how far to trust it: figures, warnings, one line."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gnio_jax.apps.importing import GAPS, Imported
from gnio_jax.apps.packages import Weights
from gnio_jax.evaluation import Estimate, Recording, metrics
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.types import GRAVITY

LYING = 0.95
"""Share of rest from which a recording is said to lie still (ours)."""
REFUSED = 0.15
"""Share of refused displacements that is told (ours). On people that a network has not met it
refuses 0 to 5 %; walks of a kind that it has not met went wrong by 20 sigma with 29 %."""
FASTEST = 3.0
"""Mean speed in m/s above which nobody walks; the self-check of recordings has the same."""
ERRORS = ("ate", "ate_2d", "rte_60s", "rpe_1s", "yaw_rmse", "path_length", "path_length_ratio")
"""What is shown of the errors against a reference; summary.json has them all."""


class Summary(NamedTuple):
    """What is told of a track."""

    recording: str
    weights: str
    trained_on: str
    """And the error that was measured of these weights, where one was."""
    start_time: float
    """Of the recording's own clock, s."""
    seconds: float
    path_length: float
    """Horizontal, through points 1 s apart, m."""
    from_start: float
    """Horizontal distance of the end from the start, m."""
    expected_error: float
    """Horizontal at the end, root mean square by the filter's covariance, m."""
    considered: bool
    """Whether the filter counts errors that last: biases, scale, heading."""
    rest: float
    """Share of the time that the IMU is quiet."""
    accepted: float | None
    """Share of the displacements that the filter used; None if there was none."""
    errors: dict[str, float | None]
    """Metrics against the reference, start aligned; empty where there is none."""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    """What the import and the start detected, assumed or repaired."""

    @property
    def limits(self) -> str:
        """How far to trust the track, in one line."""
        walked = f"{self.path_length:.1f} m in {self.seconds:.0f} s"
        return f"limits: {walked}; {'; '.join(self._doubts())}"

    def _doubts(self) -> list[str]:
        share = self.expected_error / self.path_length if self.path_length >= 1.0 else math.nan
        of_path = f" ({share:.1%} of the path)" if math.isfinite(share) else ""
        counted = (
            "with lasting errors considered"
            if self.considered
            else "without errors that last (gnio calibrate finds them), so expect more"
        )
        return [
            f"expected error at the end {self.expected_error:.1f} m{of_path} by the filter, "
            f"{counted}",
            f"trained on {self.trained_on}",
            "place and heading are relative to the start",
        ]


def summarise(
    estimate: Estimate,
    ready: Recording,
    recording: Imported,
    weights: Weights,
    ekf: FilterSetup,
) -> Summary:
    """The figures of a finished track. An estimate that diverged is told of up to there."""
    sequence, healthy = recording.sequence, estimate.trajectory.known
    last = int(np.flatnonzero(healthy)[-1])
    position, time = estimate.trajectory.position[: last + 1, :2], estimate.trajectory.time
    filtered = estimate.filtered
    assert filtered is not None
    used = filtered.accepted[: last + 1]
    used = used[np.isfinite(used)]
    horizontal = np.diagonal(filtered.covariance[last])[:2]
    summary = Summary(
        recording=sequence.name,
        weights=weights.name,
        trained_on=weights.about,
        start_time=float(sequence.attributes.get("start_time", 0.0)),
        seconds=float(time[last] - time[0]),
        path_length=metrics.path_length(position, float(time[1] - time[0])) if last else 0.0,
        from_start=float(np.linalg.norm(position[-1] - position[0])),
        expected_error=float(np.sqrt(horizontal.sum())),
        considered=ekf.considered is not None,
        rest=_rest(ready, ekf.config),
        accepted=float(used.mean()) if len(used) else None,
        errors=_errors(estimate),
        warnings=(),
        notes=(*recording.notes, *ready.notes),
    )
    own_rate = 1.0 / float(np.median(np.diff(sequence.time)))
    found = [*recording.warnings, *_warnings(summary, own_rate, 1.0 / ekf.config.dt)]
    holes = ready.imu_valid is not None
    if holes or any(GAPS in note for note in recording.notes):
        where = "" if holes else " (see above)"
        found.append(
            f"gaps: samples are missing{where}, and what happened there is guessed: from there on "
            "heading and place are less certain than the filter says"
        )
    if ready.start.std.velocity > ROUGH_START:
        found.append("start: it moves in its first second, so its velocity and tilt are rough")
    diverged = (note for note in estimate.notes if note not in ready.notes)
    return summary._replace(warnings=(*found, *diverged))


def as_json(summary: Summary) -> dict[str, Any]:
    """Plain values; what is not finite is None."""
    errors = {
        name: value if value is not None and math.isfinite(value) else None
        for name, value in summary.errors.items()
    }
    return {**summary._asdict(), "errors": errors, "limits": summary.limits}


def _errors(estimate: Estimate) -> dict[str, float | None]:
    if not np.isfinite(estimate.reference.position).any():
        return {}
    return metrics.score([estimate])[estimate.name].values


def _rest(ready: Recording, config: FilterConfig) -> float:
    """Share of the strides in which the IMU is as quiet as the filter's rest; a line across a gap
    is not."""
    turn = np.linalg.norm(ready.gyro - ready.start.gyro_bias, axis=1)
    pull = np.abs(np.linalg.norm(ready.accel, axis=1) - GRAVITY)
    quiet = (turn < config.rest_gyro) & (pull < config.rest_accel)
    if ready.imu_valid is not None:
        quiet = quiet & ready.imu_valid
    return float(quiet.reshape(-1, config.samples_per_clone).all(axis=1).mean())


def _warnings(summary: Summary, own_rate: float, rate: float) -> list[str]:
    """What makes the track worth less than its figures."""
    found = []
    if own_rate < 0.99 * rate:
        found.append(
            f"rate: recorded at {own_rate:.4g} Hz, the network has learnt at {rate:g} Hz: "
            f"what lies above {own_rate / 2.0:.3g} Hz is guessed"
        )
    if summary.rest >= LYING:
        found.append(f"rest: it lies still {summary.rest:.0%} of the time, and is held there")
    if summary.accepted is not None and summary.accepted < 1.0 - REFUSED:
        found.append(
            f"gate: the filter refused {1.0 - summary.accepted:.0%} of the network's "
            "displacements: the motion is unlike what the network has learnt"
        )
    if summary.path_length > FASTEST * summary.seconds:
        speed = summary.path_length / summary.seconds
        found.append(f"speed: {speed:.1f} m/s in the mean is nobody's walk: the track is wrong")
    return found
