"""`gnio calibrate`: fit the filter of a run to the errors of its network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table

from gnio_jax import config as configuration
from gnio_jax.commands import console, options
from gnio_jax.config import CalibrateConfig
from gnio_jax.cores import usable_cores

if TYPE_CHECKING:
    from gnio_jax.calibration.comparison import Effect


def calibrate(request: CalibrateConfig, call: options.Call) -> None:
    """Fit the filter of a run to its validation split, and write a run with it.

    A network's errors are smaller on its training walks than on other walks, so the filter is
    fitted to other walks. First, each axis gets a factor for the network's standard deviations,
    from the errors on the validation split. Then the filter's noises are chosen that make its
    innovations most likely. Last, the errors that the filter reports but does not estimate (its
    consider covariance) are fitted to the errors of its positions. It prints the errors of the
    trajectories of these walks before and after, and a warning if they are larger. The result is a
    run, which gnio evaluate takes like any other; test splits are refused. A run that has learnt
    from several datasets is fitted to the walks of all of them.

    examples:
      {prog}                                    the newest run below runs/
      {prog} --network runs/oxiod --fit measurement noise --out runs/oxiod_honest
      {prog} --network runs/oxiod --average-headings
      {prog} --network runs/oxiod --out-of-fold runs/fold0 runs/fold1
    """
    from gnio_jax import calibration  # late, so that mistakes do not wait for JAX

    console.prepare_filter()
    with console.terminal() as terminal:
        result = calibration.calibrate(request, terminal.progress, usable_cores())
    table, before = _table_of("filter"), configuration.flatten(result.before)
    for name, value in configuration.flatten(result.consider_fit.settings).items():
        if value != before.get(name):
            table.add_row(name, _spell(before.get(name)), _spell(value))
    console.say(table)
    console.say(_trajectories(result.effect))
    others = result.recordings - result.raw_gyros
    fit, nees = result.innovation_fit, result.consider_fit
    console.say(f"recordings: {result.raw_gyros} with a raw gyro, {others} without")
    console.say(
        f"negative log-likelihood of an innovation: {fit.before:.4f} after the factors of "
        f"the axes, {fit.after:.4f} after the fit ({result.recordings} recordings, "
        f"{fit.steps} steps)"
    )
    console.say(
        "squared error of the position over the variance that the filter reports, per axis: "
        f"{nees.before:.2f} -> {nees.after:.2f} with consider covariance"
    )
    for warning in result.warnings:
        console.warn(warning)
    following = f"{call.sibling('evaluate')} --network {console.shown_path(result.folder)}"
    console.say(f"look at it with: {following}")


def _table_of(subject: str) -> Table:
    """An empty table of values before and after the calibration."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(subject, overflow="fold")
    table.add_column("before", justify="right")
    table.add_column("calibrated", justify="right")
    return table


def _trajectories(effect: Effect) -> Table:
    """The errors of the trajectories of the recordings before and after the calibration."""
    from gnio_jax.evaluation.tabulate import column, number  # as late as the calibration

    table = _table_of("trajectories")
    for metric, change in effect.errors.items():
        shown = column(metric)
        table.add_row(shown.title, *(number(mean, shown.digits) for mean in change))
    if any(effect.diverged):
        table.add_row("diverged", *(f"{count} of {effect.recordings}" for count in effect.diverged))
    return table


def _spell(value: Any) -> str:
    """The text of a setting in a cell: one number, several, or none if it is switched off."""
    if value is None:
        return "none"
    return ", ".join(
        f"{number:.4g}" for number in (value if isinstance(value, tuple) else (value,))
    )
