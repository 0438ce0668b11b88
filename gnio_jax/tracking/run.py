"""One recording to its folder of results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.apps.importing import Imported
from gnio_jax.apps.packages import Weights
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.validation import WINDOW_SECONDS, check_gaps
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Estimate, Trajectory, estimate, exporting, prepare
from gnio_jax.evaluation.estimate import in_one_frame
from gnio_jax.evaluation.exporting import rerun_file
from gnio_jax.evaluation.prepare import measured_rows
from gnio_jax.evaluation.trajectory import write_tum
from gnio_jax.files import check_writable_folder, replacing_folder, shown_name
from gnio_jax.models import Network
from gnio_jax.reporting import Progress, silent
from gnio_jax.tracking.filter import tracking_filter
from gnio_jax.tracking.summary import Summary, as_json, summarise
from gnio_jax.types import Sequence

SUMMARY, TRAJECTORY, REFERENCE = "summary.json", "trajectory.txt", "reference.txt"
PICTURE, PAGE = "track.png", "report.html"


class Tracked(NamedTuple):
    """What `track` found and where it is."""

    estimate: Estimate
    summary: Summary
    folder: Path


def track(
    recording: Imported,
    weights: Weights,
    out: Path,
    formats: tuple[str, ...] = (),
    progress: Progress = silent,
    command: str = "",
    rerun: Path | None = None,
) -> Tracked:
    """Track a recording and leave trajectory, picture, page and summary in the folder `out`.

    The trajectory starts at the origin with yaw zero; its stamps are the recording's own. `formats`
    are further ones of `exporting.FORMATS`, `command` is how this was called, for the page, `rerun`
    a file to write for the viewer Rerun. The folder is written whole or not at all and takes the
    place of an earlier track. Raises `InputError`.
    """
    _check(out, formats)
    if rerun is not None:
        rerun_file.check_file(rerun)
    ekf = tracking_filter(weights.run)
    windows, sequence = weights.run.config.data, recording.sequence
    _check_bridged(sequence)
    # Level from the gravity of the first second, its velocity as surely zero as that second is
    # quiet, the gyro's bias from a rest at the start. A reference starts nothing.
    how = {"init": "static", "gyro_bias": "rest", "from_first": True}
    ready, left_out = prepare([sequence], windows, ekf.initial_std, **how)
    if not ready:
        raise InputError(sequence.name, left_out[sequence.name], "record for longer")
    network = Network.of(weights.run.model, weights.run.variables)
    (found,) = estimate(ready, network, windows, ekf, 1, progress)
    summary = summarise(found, ready[0], recording, weights, ekf)
    # Bokeh and Matplotlib take seconds to import.
    from gnio_jax.evaluation import plots
    from gnio_jax.tracking import page

    seen = plots.view(found, alignment=None)
    length = f"{summary.path_length:.0f} m in {summary.seconds:.0f} s"
    expected = f"expected error at the end {summary.expected_error:.1f} m"
    title = f"{shown_name(summary.recording)}: {length}, {expected}"
    with replacing_folder(out) as folder:
        _write(folder, found, summary, formats)
        plots.save(folder / PICTURE, plots.sequence(seen, title))
        page.write(folder / PAGE, seen, summary, weights.run.config, command)
    if rerun is not None:
        logged = rerun_file.Logged(in_one_frame(found, alignment=None), ready[0])
        rerun_file.write_rerun(rerun, [logged])
    return Tracked(found, summary, out)


def _check(out: Path, formats: tuple[str, ...]) -> None:
    """What can be refused before the work."""
    if out.exists() and not _may_be_replaced(out):
        raise InputError(out, "is there already and is no track", "name another --out")
    for kind in formats:
        exporting.check_format("--format", kind)
    check_writable_folder(out.parent)


def _may_be_replaced(out: Path) -> bool:
    """An earlier track, or an empty folder."""
    track = all((out / name).is_file() for name in (SUMMARY, TRAJECTORY, PICTURE))
    return track or (out.is_dir() and not any(out.iterdir()))


def _check_bridged(sequence: Sequence) -> None:
    """Raise `InputError` for a hole that nothing bridges: what was walked in it is in no sample."""
    check_gaps(sequence.time, sequence.name)
    # Lines of an earlier resampling; each clock has widened a hole by up to a sample at each end.
    there = np.union1d(sequence.time[measured_rows(sequence)], sequence.time[[0, -1]])
    bridged = longest_bridge(1.0 / float(np.median(np.diff(sequence.time))))
    check_gaps(there, sequence.name, WINDOW_SECONDS + bridged)


def _write(
    folder: Path,
    estimate: Estimate,
    summary: Summary,
    formats: tuple[str, ...],
) -> None:
    text = json.dumps(as_json(summary), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
    own_clock = _stamped(estimate.trajectory, summary.start_time)
    write_tum(folder / TRAJECTORY, own_clock)
    if np.isfinite(estimate.reference.position).any():
        write_tum(folder / REFERENCE, _stamped(estimate.reference, summary.start_time))
    for kind in formats:
        path = folder / f"trajectory.{kind}"
        filtered = estimate.filtered
        exporting.export(path, own_clock, kind, filtered and filtered.covariance)


def _stamped(trajectory: Trajectory, start: float) -> Trajectory:
    """With the stamps of the recording's own clock."""
    return trajectory._replace(time=trajectory.time + start)
