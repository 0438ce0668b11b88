"""The trajectory of your own recording and its accuracy (`gnio track`).

recording + network → check → prepare → estimate → other sensors → score → summarise → write
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax import config as configuration
from gnio_jax.apps import drive, export, heading, rerun, sensors
from gnio_jax.apps.importing import Imported
from gnio_jax.apps.summary import Summary, summarise
from gnio_jax.config import TrainConfig
from gnio_jax.data.validation import check_bridged
from gnio_jax.errors import InputError
from gnio_jax.evaluation import (
    PreparedRecording,
    SequenceEstimate,
    estimate,
    metrics,
    prepare,
    report,
)
from gnio_jax.evaluation.trajectory import write_tum
from gnio_jax.files import check_writable_folder, replacing_folder, shown_name, write_part
from gnio_jax.filtering import Filter, make_filter
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork, load_corrector
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import Readings, Sequence

NAMES = ("summary.json", "trajectory.txt", "track.png")
"""Files of every track."""


class Tracked(NamedTuple):
    """The result of `track` and its folder."""

    estimate: SequenceEstimate
    summary: Summary
    folder: Path


def track(
    recording: Imported,
    source: TrainedNetwork | TrainConfig,
    out: str | Path,
    formats: tuple[str, ...] = (),
    progress: Progress = silent,
    command: str = "",
    rerun_file: Path | None = None,
    without: tuple[str, ...] = (),
) -> Tracked:
    """Track a recording and write trajectory, picture, page and summary into a folder.

    The stamps are the recording's own. `estimate_recording` says where the trajectory starts. A
    reference is only compared with it.

    Args:
        recording: The recording, on a uniform clock.
        source: The network; or the configuration of a car's filter (`drive.estimate_drive`).
        out: The folder. It is written whole or not at all and replaces an earlier track.
        formats: Further formats of the trajectory, of `export.FORMATS`.
        progress: A function that gets the finished share.
        command: The command line, for the page.
        rerun_file: A file to write for the viewer Rerun.
        without: Sensors beside the IMU that are not used (`sensors.NAMES`).

    Raises:
        InputError: The results could not be written, or the recording is too short or has a hole
            that is too long.
    """
    out, sequence = Path(out), recording.sequence
    start_time = float(sequence.attributes.get("start_time", 0.0))
    _check_results(out, formats, rerun_file, sequence.time + start_time)
    readings = sensors.usable_readings(sequence, without)
    if sensors.GNSS not in readings:
        export.check_map(formats)
    if isinstance(source, TrainConfig):
        config, fused = source, drive.estimate_drive(sequence, readings, source, progress)
    else:
        config = source.config
        fused = estimate_recording(sequence, readings, source, progress)
    result, ready, ekf, uses, origin = fused
    compared = np.isfinite(result.reference.position).any() or result.waypoints is not None
    errors = metrics.score([result])[result.name].values if compared else {}
    summary = summarise(result, errors, ready, recording, source, ekf, uses, origin)
    unplaced = [kind for kind in formats if kind in export.MAP_FORMATS and origin is None]
    unwritten = (f"{kind}: not written: no fixes place the path on the map" for kind in unplaced)
    summary = summary._replace(warnings=(*summary.warnings, *unwritten))
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
    check_writable_folder(out)
    for kind in formats:
        export.check("--format", kind, stamps)
    if rerun_file is not None:
        rerun.check(rerun_file)


def estimate_recording(
    sequence: Sequence,
    readings: dict[str, Readings],
    trained: TrainedNetwork,
    progress: Progress = silent,
) -> sensors.Fused:
    """The estimate of a recording with these readings of its other sensors, the recording as the
    filter took it, and the filter.

    The trajectory starts at the origin with yaw zero; with fixes, whose axes are east and north,
    with the yaw that they show. The tilt at the start comes from the gravity of the first second.
    The velocity is zero, with a standard deviation that depends on how quiet that second is, and a
    rest at the start gives the gyro's bias. A reference is not used. Raises `InputError` for a
    recording that is too short or has a hole that is too long.
    """
    check_bridged(sequence)
    config = trained.config
    ekf = make_filter(config.data, config.filter)
    ready, left_out = prepare(
        [sequence],
        config.data,
        ekf,
        init="static",
        gyro_bias="rest",
        orientation="filter" if heading.uses_heading(trained) else None,
        from_first=True,
        corrector=load_corrector(config.filter, config.data.rate, trained),
    )
    if not ready:
        raise InputError(sequence.name, left_out[sequence.name], "record for longer")
    if ekf.considered is not None and not ready[0].start.raw_gyro:
        considered = ekf.considered._replace(raw_gyro_bias=0.0)
        ekf = dataclasses.replace(ekf, considered=considered if any(considered) else None)
    network = Network.of(trained.model, trained.variables)
    (first,) = estimate(ready, network, config.data, ekf, 1, progress)

    def run(ready: PreparedRecording, ekf: Filter) -> SequenceEstimate:
        return estimate([ready], network, config.data, ekf, 1)[0]

    return sensors.fuse(first, ready[0], ekf, readings, run)


def _write_figures(
    folder: Path, result: SequenceEstimate, summary: Summary, formats: tuple[str, ...]
) -> None:
    """Write the summary and the trajectories, with the stamps of the recording's own clock."""
    plain = summary._asdict() | {"errors": report.finite_values(summary.errors)}
    plain["sensors"] = [use._asdict() for use in summary.sensors]
    plain["origin"] = summary.origin and summary.origin._asdict()
    absent = [name for name in ("sensors", "origin") if not plain[name]]
    absent += ["expected_error"] if np.isnan(summary.expected_error) else []
    for name in absent:
        del plain[name]
    text = json.dumps(plain, indent=2, allow_nan=False, ensure_ascii=False)
    write_part(folder / "summary.json", text + "\n")
    path, reference = (
        trajectory._replace(time=trajectory.time + summary.start_time)
        for trajectory in (result.trajectory, result.reference)
    )
    write_tum(folder / "trajectory.txt", path)
    if np.isfinite(reference.position).any():
        write_tum(folder / "reference.txt", reference)
    for kind in formats:
        covariance = result.filtered and result.filtered.covariance
        if kind not in export.MAP_FORMATS:
            export.export(folder / f"trajectory.{kind}", path, kind, covariance)
        elif summary.origin is not None:
            file, name = folder / f"trajectory.{kind}", summary.recording
            export.export_map(file, path, summary.origin, name)


def _draw(
    folder: Path, result: SequenceEstimate, summary: Summary, config: TrainConfig, command: str
) -> None:
    """Draw the picture and write the page, in the form of an evaluation's sequence."""
    from gnio_jax import drawing  # they take a second to import
    from gnio_jax.evaluation import page, plots, tabulate
    from gnio_jax.evaluation.views import make_view

    view = make_view(result, alignment=None)
    length = f"{summary.path_length:.1f} m in {summary.seconds:.0f} s"
    error = summary.expected_error
    title = f"{shown_name(summary.recording)}: {length}"
    if np.isnan(error):
        title += f", {summary.warnings[0].partition(':')[0]}"
    else:
        title += f", expected error at the end {error:.1f} m"
    drawing.save(folder / "track.png", plots.sequence(view, title))
    aligned = "start position and yaw" if result.waypoints is None else tabulate.TO_WAYPOINTS
    share = np.isfinite(result.reference.position).all(axis=1).mean()
    partly = f"known for {share:.0%} of the time: errors and ratios are of this part"
    facts = {
        "command": command,
        "path": f"{length}, ends {summary.from_start:.1f} m from the start",
        "expected error at the end": "" if np.isnan(error) else f"{error:.1f} m",
        "steps": "" if summary.steps is None else f"{summary.steps:.0%} of the time",
        **{use.sensor: use.line for use in summary.sensors},
        "network": summary.network,
        "training data": summary.trained_on,
        "measured error": summary.measured,
        "window orientation": "filter",
        "alignment": aligned if summary.errors else "",
        "reference": partly if 0 < share < 1 else "",
        "windows": tabulate.windows(dataclasses.asdict(config.data)),
    }
    figures = {"accepted": None if summary.accepted is None else 100.0 * summary.accepted}
    # The figures are of the whole track, even if the reference covers only a part of it.
    figures |= summary.errors | {"duration": summary.seconds, "path_length": summary.path_length}
    run = page.PageRun(
        "estimate",
        {name: text for name, text in facts.items() if text},
        [view],
        {view.name: figures},
        warnings=summary.warnings,
        remarks=summary.notes,
        settings=configuration.to_yaml(config),
    )
    page.write(folder / "report.html", summary.recording, [run])
