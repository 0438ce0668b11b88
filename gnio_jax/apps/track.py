"""The trajectory of your own recording and its accuracy (`gnio track`).

recording + network → check → prepare → estimate → score → summarise → write
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax import config as configuration
from gnio_jax.apps import export, rerun
from gnio_jax.apps.importing import GAPS, Imported
from gnio_jax.apps.publish import describe_data
from gnio_jax.config import TrainConfig
from gnio_jax.data.assembly import RECORDED_RATE
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.validation import WINDOW_SECONDS, check_gaps
from gnio_jax.errors import InputError
from gnio_jax.evaluation import (
    PreparedRecording,
    SequenceEstimate,
    estimate,
    metrics,
    prepare,
    report,
)
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.evaluation.trajectory import write_tum
from gnio_jax.files import check_writable_folder, replacing_folder, shown_name
from gnio_jax.filtering import Filter, make_filter
from gnio_jax.filtering.zero_velocity import quiet_samples
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import GRAVITY, Sequence

LYING = 0.95
"""Share of rest from which a warning says that a recording lies still (ours)."""
RUNNING, RUNNING_SHARE = 5.0, 0.7
"""Root mean square of |accel| − g over a second, m/s², above which the person may run, and the
share of such seconds that gives a warning (ours). Runs have 92 % or more of them (Tyrex). Walks
have at most 1 % on Tyrex and OxIOD, for every way of carrying, and up to 52 % in Indoor Location's
mall."""
CLIMB = 3.0
"""Height between the lowest and the highest point of a path, m, from which it indicates stairs or
drift (ours)."""
REFUSED = 0.15
"""Share of refused displacements that gives a warning (ours). For people that a network has not
seen the filter refuses 0 to 5 %. For walks of a kind that it has not seen it refused 29 %, and the
error was 20 sigma."""
FASTEST = 3.0
"""Largest plausible mean speed of a walk, m/s, as in the self-check of recordings."""
COVERED = 50.0
"""Smallest share of rows in which the 95 % region of the filter must contain the reference, %
(ours)."""
NAMES = ("summary.json", "trajectory.txt", "track.png")
"""Files of every track."""


class Summary(NamedTuple):
    """The figures and remarks about a track."""

    recording: str
    network: str
    trained_on: str
    """The training data, and the measured error of the network if there is one."""
    start_time: float
    """Duration by the recording's own clock, s."""
    seconds: float
    path_length: float
    """Horizontal length of the path, through points 1 s apart, m."""
    from_start: float
    """Horizontal distance of the end from the start, m."""
    expected_error: float
    """Expected horizontal error at the end, root mean square by the filter's covariance, m."""
    at_rest: float
    """Share of the time in which the IMU is quieter than a hand."""
    running: float
    """Share of the seconds with accelerations as in a run."""
    climb: float
    """Height between the lowest and the highest point, m."""
    accepted: float | None
    """Share of the displacements that the filter used; None if there was none."""
    errors: dict[str, float | None]
    """Metrics against the reference, start aligned; empty where there is none."""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    """Notes about what the import and the start detected, assumed or repaired."""
    limits: str
    """The accuracy of the track, in one line."""


class Tracked(NamedTuple):
    """The result of `track` and its folder."""

    estimate: SequenceEstimate
    summary: Summary
    folder: Path


def track(
    recording: Imported,
    trained: TrainedNetwork,
    out: Path,
    formats: tuple[str, ...] = (),
    progress: Progress = silent,
    command: str = "",
    rerun_file: Path | None = None,
) -> Tracked:
    """Track a recording and write trajectory, picture, page and summary into a folder.

    The stamps are the recording's own. `estimate_recording` says where the trajectory starts. A
    reference is only compared with it.

    Args:
        recording: The recording, on a uniform clock.
        trained: The network.
        out: The folder. It is written whole or not at all and replaces an earlier track.
        formats: Further formats of the trajectory, of `export.FORMATS`.
        progress: A function that gets the finished share.
        command: The command line, for the page.
        rerun_file: A file to write for the viewer Rerun.

    Raises:
        InputError: The results could not be written, or the recording is too short or has a hole
            that is too long.
    """
    sequence, config = recording.sequence, trained.config
    start_time = float(sequence.attributes.get("start_time", 0.0))
    _check_results(out, formats, rerun_file, sequence.time + start_time)
    result, ready, ekf = estimate_recording(sequence, trained, progress)
    compared = np.isfinite(result.reference.position).any() or result.waypoints is not None
    errors = metrics.score([result])[result.name].values if compared else {}
    summary = summarise(result, errors, ready, recording, trained, ekf)
    with replacing_folder(out) as folder:
        _write_figures(folder, result, summary, formats)
        _draw(folder, result, summary, config, command)
    if rerun_file is not None:
        rerun.write(rerun_file, [result], [ready])
    return Tracked(result, summary, out)


def _check_results(
    out: Path, formats: tuple[str, ...], rerun_file: Path | None, stamps: Float[np.ndarray, "n"]
) -> None:
    """Raise `InputError`, before any work, for results that could not be written afterwards."""
    track = all((out / name).is_file() for name in NAMES)
    if out.exists() and not (track or (out.is_dir() and not any(out.iterdir()))):
        raise InputError(out, "exists and is not an earlier track", "name another --out")
    check_writable_folder(out.parent)
    for kind in formats:
        export.check("--format", kind, stamps)
    if rerun_file is not None:
        rerun.check(rerun_file)


def estimate_recording(
    sequence: Sequence, trained: TrainedNetwork, progress: Progress = silent
) -> tuple[SequenceEstimate, PreparedRecording, Filter]:
    """The estimate of a recording, the recording as the filter took it, and the filter.

    The trajectory starts at the origin with yaw zero. The tilt at the start comes from the gravity
    of the first second. The velocity is zero, with a standard deviation that depends on how quiet
    that second is, and a rest at the start gives the gyro's bias. A reference is not used. Raises
    `InputError` for a recording that is too short or has a hole that is too long.
    """
    _check_bridged(sequence)
    config = trained.config
    ekf = make_filter(config.data, config.filter)
    ready, left_out = prepare(
        [sequence],
        config.data,
        ekf,
        init="static",
        gyro_bias="rest",
        from_first=True,
    )
    if not ready:
        raise InputError(sequence.name, left_out[sequence.name], "record for longer")
    if ekf.considered is not None and not ready[0].start.raw_gyro:
        considered = ekf.considered._replace(raw_gyro_bias=0.0)
        ekf = dataclasses.replace(ekf, considered=considered if any(considered) else None)
    network = Network.of(trained.model, trained.variables)
    (result,) = estimate(ready, network, config.data, ekf, 1, progress)
    return result, ready[0], ekf


def _check_bridged(sequence: Sequence) -> None:
    """Raise `InputError` for a hole that is too long to be bridged, because no sample shows the
    motion in it."""
    # An earlier resampling interpolated the holes, and each clock has widened a hole by up to a
    # sample at each end.
    measured = np.union1d(sequence.time[sequence.measured_rows], sequence.time[[0, -1]])
    bridged = longest_bridge(1.0 / float(np.median(np.diff(sequence.time))))
    check_gaps(sequence.time, sequence.name)
    check_gaps(measured, sequence.name, WINDOW_SECONDS + bridged)


def summarise(
    result: SequenceEstimate,
    errors: dict[str, float | None],
    ready: PreparedRecording,
    recording: Imported,
    trained: TrainedNetwork,
    ekf: Filter,
) -> Summary:
    """The figures of a finished track, up to a divergence if there was one.

    Args:
        result: The estimate, with the filter's covariances.
        errors: Metrics against the reference by their names; empty without a reference.
        ready: The recording as the filter took it.
        recording: The recording as it was imported, with its notes and warnings.
        trained: The network, for its name and its training data.
        ekf: The filter.
    """
    filtered, sequence = result.filtered, recording.sequence
    assert filtered is not None
    rows = int(np.flatnonzero(result.trajectory.known)[-1]) + 1
    time, position = result.trajectory.time[:rows], result.trajectory.position[:rows]
    seconds = float(time[-1] - time[0])
    length = 0.0 if rows < 2 else metrics.path_length(position[:, :2], float(time[1] - time[0]))
    used = filtered.accepted[:rows]
    used = used[np.isfinite(used)]
    error = float(np.sqrt(np.trace(filtered.covariance[rows - 1, :2, :2])))
    share = f" ({error / length:.1%} of the path)" if length >= 1.0 else ""
    counted = "with consider covariance"
    if ekf.considered is None:
        counted = "without consider covariance (gnio calibrate fits it), "
        counted += "so the real error is probably larger"
    summary = Summary(
        recording=sequence.name,
        network=trained.name,
        trained_on=describe_data(trained),
        start_time=float(sequence.attributes.get("start_time", 0.0)),
        seconds=seconds,
        path_length=length,
        from_start=float(np.linalg.norm((position[-1] - position[0])[:2])),
        expected_error=error,
        at_rest=_share_at_rest(ready, ekf),
        running=_share_running(ready, ekf),
        climb=float(np.ptp(position[:, 2])),
        accepted=float(used.mean()) if len(used) else None,
        errors=errors,
        warnings=(),
        notes=(*recording.notes, *ready.notes),
        limits=f"limits: {length:.1f} m in {seconds:.0f} s; expected error at the end "
        f"{error:.1f} m{share} by the filter, {counted}; network {trained.name}; place and heading "
        "are relative to the start",
    )
    recorded_rate = 1.0 / float(np.median(np.diff(sequence.time)))
    recorded_rate = min(recorded_rate, float(sequence.attributes.get(RECORDED_RATE, recorded_rate)))
    warnings = [*recording.warnings, *_warnings(summary, recorded_rate, 1.0 / ekf.config.dt)]
    holes = ready.imu_valid is not None
    if holes or any(GAPS in note for note in recording.notes):
        where = "" if holes else " (see above)"
        warnings.append(
            f"gaps: samples are missing{where}, and the motion there is not known: from there on "
            "heading and place are less certain than the filter says"
        )
    if ready.start.raw_gyro:
        warnings.append(
            "gyro: raw, and without a rest that shows its bias: the heading may be lost within a "
            "minute; hold the phone still for some seconds first"
        )
    if ready.start.std.velocity > ROUGH_START:
        warnings.append("start: it moves in its first second, so velocity and tilt are inaccurate")
    diverged = (note for note in result.notes if note not in ready.notes)
    return summary._replace(warnings=(*warnings, *diverged))


def _warnings(summary: Summary, recorded_rate: float, rate: float) -> list[str]:
    """Warnings that limit the value of the figures."""
    accepted = 1.0 if summary.accepted is None else summary.accepted
    covered = {
        "place": summary.errors.get("nees_coverage_2d"),
        "place and height": summary.errors.get("nees_coverage"),
    }
    shares = {of: share for of, share in covered.items() if share is not None}
    worst = min(shares, key=shares.__getitem__, default="")
    speed = summary.path_length / max(summary.seconds, 1e-9)
    conditions = {
        f"rate: recorded at {recorded_rate:.4g} Hz, the network was trained at {rate:g} Hz: the "
        f"content above {recorded_rate / 2.0:.3g} Hz is unknown": recorded_rate < 0.99 * rate,
        f"rest: it lies still {summary.at_rest:.0%} of the time, and the filter holds the "
        "position": summary.at_rest >= LYING,
        f"running: in {summary.running:.0%} of the seconds it is shaken as in a run, where "
        "networks trained on walks make the path too short": summary.running > RUNNING_SHARE,
        f"height: it changes by {summary.climb:.1f} m: that is drift unless the way goes up or "
        "down, which few networks have learnt": summary.climb > CLIMB,
        f"gate: the filter refused {1.0 - accepted:.0%} of the network's displacements: the motion "
        "is unlike that in the network's training data": accepted < 1.0 - REFUSED,
        f"speed: {speed:.1f} m/s in the mean is faster than people walk: the track is wrong": (
            speed > FASTEST
        ),
        f"errors: larger than the filter says: its 95 % region of {worst} holds the reference in "
        f"{shares.get(worst, 0.0):.0f} % of the rows": shares.get(worst, 100.0) < COVERED,
    }
    return [text for text, applies in conditions.items() if applies]


def _share_at_rest(ready: PreparedRecording, ekf: Filter) -> float:
    """Share of the strides in which the IMU is as quiet as the filter's rest; strides across a gap
    do not count as rest."""
    rate = ready.gyro - ready.start.gyro_bias
    one_program = jax.jit(quiet_samples, static_argnames="config")
    quiet = np.asarray(one_program(rate, ready.accel, config=ekf.config))
    if ready.imu_valid is not None:
        quiet = quiet & ready.imu_valid
    return float(quiet.reshape(-1, ekf.config.samples_per_clone).all(axis=1).mean())


def _share_running(ready: PreparedRecording, ekf: Filter) -> float:
    """Share of the measured seconds with accelerations as in a run."""
    second = round(1.0 / ekf.config.dt)
    off = np.linalg.norm(ready.accel, axis=1) - GRAVITY
    off = off if ready.imu_valid is None else off[ready.imu_valid]
    seconds = off[: len(off) // second * second].reshape(-1, second)
    return float((np.sqrt((seconds**2).mean(axis=1)) > RUNNING).mean())


def _write_figures(
    folder: Path, result: SequenceEstimate, summary: Summary, formats: tuple[str, ...]
) -> None:
    """Write the summary and the trajectories, with the stamps of the recording's own clock."""
    plain = summary._asdict() | {"errors": report.finite(summary.errors)}
    text = json.dumps(plain, indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    path, reference = (
        trajectory._replace(time=trajectory.time + summary.start_time)
        for trajectory in (result.trajectory, result.reference)
    )
    write_tum(folder / "trajectory.txt", path)
    if np.isfinite(reference.position).any():
        write_tum(folder / "reference.txt", reference)
    for kind in formats:
        covariance = result.filtered and result.filtered.covariance
        export.export(folder / f"trajectory.{kind}", path, kind, covariance)


def _draw(
    folder: Path, result: SequenceEstimate, summary: Summary, config: TrainConfig, command: str
) -> None:
    """Draw the picture and write the page, in the form of an evaluation's sequence."""
    from gnio_jax import drawing  # they take a second to import
    from gnio_jax.evaluation import page, plots, tabulate
    from gnio_jax.evaluation.views import make_view

    view = make_view(result, alignment=None)
    length = f"{summary.path_length:.1f} m in {summary.seconds:.0f} s"
    expected = f"{summary.expected_error:.1f} m"
    title = f"{shown_name(summary.recording)}: {length}, expected error at the end {expected}"
    drawing.save(folder / "track.png", plots.sequence(view, title))
    aligned = "start position and yaw" if result.waypoints is None else tabulate.TO_WAYPOINTS
    share = np.isfinite(result.reference.position).all(axis=1).mean()
    partly = f"known for {share:.0%} of the time: errors and ratios are of this part"
    facts = {
        "command": command,
        "walked": f"{length}, ends {summary.from_start:.1f} m from the start",
        "expected error at the end": f"{expected} by the filter",
        "network": f"{summary.network}, trained on {summary.trained_on}",
        "window orientation": "filter",
        "alignment": aligned if summary.errors else "",
        "reference": partly if 0 < share < 1 else "",
        "windows": tabulate.windows(dataclasses.asdict(config.data)),
    }
    figures = {"accepted": None if summary.accepted is None else 100.0 * summary.accepted}
    # The figures are of the whole track, even if the reference covers only a part of it.
    figures |= summary.errors | {"duration": summary.seconds, "path_length": summary.path_length}
    run = page.PageRun(
        "track",
        {name: text for name, text in facts.items() if text},
        [view],
        {view.name: figures},
        warnings=summary.warnings,
        remarks=(summary.limits, *summary.notes),
        settings=configuration.to_yaml(config),
    )
    page.write(folder / "report.html", summary.recording, [run])
