"""The effect of a calibration on the trajectories of its recordings: their errors with the filter
of the run, and with the calibrated filter."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from gnio_jax.calibration.fit import apply_start_settings
from gnio_jax.config import ConsideredStd, CorrelatedError, DataConfig, FilterSettings
from gnio_jax.evaluation import Displacements, PreparedRecording, estimate, score
from gnio_jax.evaluation.statistics import Scores, summarise
from gnio_jax.evaluation.tabulate import column, number
from gnio_jax.filtering import make_filter

METRICS = ("ate", "rpe_1s", "path_length_ratio")
"""Metrics that are compared, by their names in `metrics.json`."""
REMEDY = "use the run as it was, calibrate it on more recordings, or give fewer groups to --fit"


class Change(NamedTuple):
    """A figure with the filter of the run, and with the calibrated filter."""

    before: float | None
    after: float | None


class Effect(NamedTuple):
    """The errors of the trajectories with both filters."""

    errors: dict[str, Change]
    """For each of `METRICS` the mean over the recordings on which neither filter diverges; None if
    it has no value on any of them."""
    diverged: Change
    """Number of recordings on which the filter diverges."""
    recordings: int

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence if the calibrated filter diverges, and one if a mean is worse as it is shown
        in a table."""
        (before, after), lines = self.diverged, []
        if after:
            lines.append(
                f"the calibrated filter diverges on {after} of {self.recordings} recordings, and "
                f"the filter of the run on {before}; {REMEDY}"
            )
        worse = [metric for metric, change in self.errors.items() if is_worse(metric, change)]
        if worse:
            figures = ", ".join(_spell_change(metric, self.errors[metric]) for metric in worse)
            lines.append(
                f"these recordings have larger errors with the calibrated filter: {figures}; "
                f"{REMEDY}"
            )
        return tuple(lines)


def is_worse(metric: str, change: Change) -> bool:
    """Whether the mean after the calibration is farther from the best value of the metric, in the
    digits that a table shows."""
    if change.before is None or change.after is None:
        return False
    _, _, digits, best = column(metric)
    before, after = (round(abs(mean - best), digits) for mean in (change.before, change.after))
    return after > before


def _spell_change(metric: str, change: Change) -> str:
    heading, unit, digits, _ = column(metric)
    before, after = (number(mean, digits) for mean in change)
    return f"{heading} {before} -> {after} {unit}".rstrip()


def compare_filters(
    recordings: list[PreparedRecording],
    displacements: list[Displacements],
    windows: DataConfig,
    before: FilterSettings,
    after: FilterSettings,
) -> Effect:
    """The errors of the trajectories that the filter has with the settings of a run (`before`) and
    with the calibrated ones (`after`).

    Both run on the displacements that the calibration was fitted to, as in the loose coupling
    (ours). With the network in its loop, as in an evaluation, a large network would need as much
    time as the whole calibration. In trials the ATE of the two couplings differed by up to 8 %.
    """
    # Recordings of two datasets may have one name.
    numbered = [recording._replace(name=str(k)) for k, recording in enumerate(recordings)]
    scores = [
        _score_filter(numbered, displacements, windows, settings) for settings in (before, after)
    ]
    groups = {recording.name: recording.group for recording in numbered}
    errors = {}
    for metric in METRICS:
        # With the filters as its seeds, a summary is over the recordings that diverge with neither.
        means = summarise(scores, metric, groups).seeds
        errors[metric] = Change(*means) if means else Change(None, None)
    diverged = (sum(measures.diverged for measures in row.values()) for row in scores)
    return Effect(errors, Change(*diverged), len(recordings))


def _score_filter(
    recordings: list[PreparedRecording],
    displacements: list[Displacements],
    windows: DataConfig,
    settings: FilterSettings,
) -> Scores:
    # Consider covariance changes no trajectory. A correlation of share 0 is none; with it, both
    # filters are the same compiled program.
    noise = settings.noise
    noise = noise._replace(correlation=noise.correlation or CorrelatedError(share=0.0))
    settings = dataclasses.replace(settings, noise=noise, considered=ConsideredStd())
    restarted = [
        recording._replace(start=apply_start_settings(recording.start, settings))
        for recording in recordings
    ]
    return score(estimate(restarted, displacements, windows, make_filter(windows, settings)))
