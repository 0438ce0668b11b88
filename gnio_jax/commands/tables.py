"""`gnio tables`: reproduces the paper's tables."""

from __future__ import annotations

import itertools
import re
import sys

from rich import box
from rich.table import Table
from rich.text import Text

from gnio_jax.commands import console, options
from gnio_jax.config import TablesConfig
from gnio_jax.cores import usable_cores

MOST_COLUMNS = 7
"""Number of columns that a terminal of 80 columns can show."""


def tables(request: TablesConfig, _call: options.Call) -> None:
    """Reproduce a table of the paper: train and evaluate its rows under equal conditions.

    Every row is trained with the same recordings, batches, epochs, learning rate and augmentation,
    each network with its own published loss, clipping and weight decay. Runs are kept below
    OUT/runs and shared by the tables. If an interrupted command is called again, it continues where
    it stopped. A finished one only writes its summary again. Before comparison trains, it times a
    few steps of each network and says how long it will take. Results:
    OUT/<table>_<split>_<estimator>.md, .csv and .png.

    examples:
      {prog} complexity                              parameters, operations, latency
      {prog} published                               what papers print, and what each figure is
      {prog} comparison --base quickstart            the networks side by side
      {prog} comparison --methods all --calibrate    every network, with calibrated filters
      {prog} comparison --base tables/networks_walks --dataset oxiod --split unseen
                                                     learn from several datasets, measure on one
      {prog} components --base gnio_oxiod_small --data-root DIR --split sessions_test
      {prog} gates --base ... --epochs 3             gate and scale functions, their gradients
      {prog} bank-size --base ...                    size of the Motion Bank, entropy of attention
      {prog} trajectories --base ...                 all methods over the reference, one picture
      {prog} standing --base ...                     errors at rest and in slow walking
    """
    from gnio_jax.tables import make, runs  # late: mistakes do not wait for JAX

    console.prepare_filter()
    try:
        with console.terminal() as terminal:
            text = make.make(request, terminal, usable_cores())
    except runs.Interrupted as interruption:
        print("stopped and saved; the same command continues from here", file=sys.stderr)
        sys.exit(128 + interruption.args[0])
    if not console.stdout().is_terminal:
        console.say(text)
        return
    for is_table, group in itertools.groupby(text.splitlines(), lambda line: line[:1] == "|"):
        block = list(group)
        console.say(_table(block) if is_table else "\n".join(block).replace("## ", ""))


def _table(lines: list[str]) -> Table:
    """A table of Markdown for a terminal. One with many columns is turned: the rows become
    columns."""
    split = re.compile(r"(?<!\\)\|").split  # a bar in a cell is escaped
    cells = [[cell.strip().replace("\\|", "|") for cell in split(line)[1:-1]] for line in lines]
    header, _, *rows = cells
    if len(header) > MOST_COLUMNS:
        header, *rows = map(list, zip(header, *rows, strict=True))
    table = Table(box=box.SIMPLE_HEAD)
    for number, name in enumerate(header):
        table.add_column(Text(name), justify="right" if number else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    return table
