"""`gnio calibrate`: what a run does not know of its own errors."""

from __future__ import annotations

import sys
from typing import Any

from rich.table import Table

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Command, sibling
from gnio_jax.config import CalibrateConfig, FilterSettings
from gnio_jax.cores import usable_cores

DESCRIPTION = """Fit the filter's options of a run to its validation split; write a run with them.

  {prog}                                    (the newest run below runs/)
  {prog} --workdir runs/oxiod --fit measurement noise --out runs/oxiod_honest
  {prog} --workdir runs/oxiod --average-headings
  {prog} --workdir runs/oxiod --out-of-fold runs/fold0 runs/fold1

A network learns the errors of the walks that it has fitted, which are smaller than those of others.
First its standard deviations get a factor for each axis, from the errors on the validation split.
Then the filter's noises are those that make its innovations most likely. Last, the sizes of the
errors that the filter reports but does not estimate are fitted to the errors of its positions. The
result is a run that gnio evaluate takes as any other; test splits are refused."""


def calibrate(config: CalibrateConfig, prog: str) -> None:
    """Calibrate, and show what has changed."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import calibration, filtering

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    with console.terminal() as terminal:
        found = calibration.calibrate(config, terminal.progress, usable_cores())
    console.stdout().print(_table(found.before, found.considered.settings))
    print(
        "-log-likelihood of an innovation, from the factors of the axes to the end of the fit: "
        f"{found.fit.before:.4f} -> {found.fit.after:.4f} "
        f"({found.recordings} recordings, {found.fit.steps} steps)"
    )
    print(
        "squared error of the position over what the filter says of it, per axis: "
        f"{found.considered.before:.2f} -> {found.considered.after:.2f} with the errors considered"
    )
    for warning in found.fit.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"look at it with: {sibling(prog, 'evaluate')} --workdir {found.folder}")


def _table(before: FilterSettings, after: FilterSettings) -> Table:
    """The options that have changed."""
    table = Table("filter", "before", "calibrated")
    old = configuration.flat(before)
    for name, value in configuration.flat(after).items():
        if value != old.get(name):
            table.add_row(name, _spelled(old.get(name)), _spelled(value))
    return table


def _spelled(value: Any) -> str:
    """A setting in a cell: a number, several, or none where it was switched off."""
    if value is None:
        return "none"
    return ", ".join(f"{each:.4g}" for each in (value if isinstance(value, tuple) else (value,)))


COMMON = (
    "--workdir",
    "--out",
    "--data-root",
    "--split",
    "--out-of-fold",
    "--fit",
    "--average-headings",
    "--checkpoint",
    "--steps",
)

COMMAND = Command(CalibrateConfig, calibrate, DESCRIPTION, common=COMMON)
