"""`gnio compare`: runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from gnio_jax.commands import console
from gnio_jax.commands.options import Command
from gnio_jax.config import CompareConfig
from gnio_jax.cores import usable_cores
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable, with_ending

if TYPE_CHECKING:
    from gnio_jax.comparison import Comparison

DESCRIPTION = """Compare runs sequence by sequence: what a change has changed, and how sure that is.

  {prog} runs/plain runs/context --split sessions_test
  {prog} runs/plain runs/context --metrics ate rpe_1s rte_60s --out runs/plain_or_context
  {prog} runs/gnio_s0 runs/gnio_s0/eval/oxiod_test_ekf_loose

The first run is what the others are compared with. Runs are evaluated where they are not yet. Seeds
of a run are averaged, and the name of a run without its seed stands for all of them: runs/plain for
runs/plain_s0, runs/plain_s1, ..., runs/plain_calibrated for runs/plain_s0_calibrated, ... Walks of
one person or session are not independent, so the 95 % interval of a difference draws whole people
or sessions anew. An interval on both sides of zero says that the recordings do not tell the two
apart; with few people or sessions one beside zero does not say that they do. It knows nothing of
other seeds: ± is their standard deviation."""


def show(config: CompareConfig, _prog: str) -> None:
    """Compare, show the table, and write the files that are asked for."""
    if config.out is not None:
        _check_out(config.out)  # or what was evaluated for it would be lost
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import comparison, filtering
    from gnio_jax.comparison import text

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    filtering.cores_as_devices()
    with console.terminal() as terminal:
        found = comparison.compare(config, terminal, usable_cores())
    output = console.stdout()
    output.print(f"{text.title(found)}\n", soft_wrap=True)
    output.print(_table(text.HEADER, text.lines(found)))
    for line in text.explanations(found):
        output.print(line)
    if config.out is not None:
        _write(Path(config.out), found)
        output.print(f"\nresults: {config.out}.md, .csv, .png", soft_wrap=True)


def _table(header: list[str], lines: list[list[str]]) -> Table:
    """The lines below a heading for each metric: names of rows have the width that is left."""
    table = Table(box=box.SIMPLE_HEAD, header_style="bold")
    table.add_column(overflow="fold", min_width=16)
    for name in header[2:]:
        table.add_column(name, justify="right")
    for metric, *cells in lines:
        if metric:
            table.add_row(f"{metric}", style="bold")
        table.add_row(f"  {cells[0]}", *cells[1:])
    return table


def _check_out(out: str) -> None:
    """Raise now where the files could not be written later."""
    path = Path(out)
    if path.name in ("", "..") or path.suffix in ENDINGS or out.endswith(("/", "\\")):
        remedy = "give the name of a file without its ending: runs/both"
        raise InputError("--out", f"'{out}' is no such name", remedy)
    for ending in ENDINGS:
        try:
            check_writable(with_ending(path, ending))
        except OSError as error:
            problem = f"{with_ending(path, ending)} cannot be written ({error.strerror})"
            raise InputError("--out", problem, "give another name") from None


def _write(path: Path, found: Comparison) -> None:
    """Table and picture."""
    from gnio_jax.comparison import picture, text

    figure = picture.draw(found)
    text.write(path, found)
    picture.save(with_ending(path, ".png"), figure)


ENDINGS = (".md", ".csv", ".png")

COMMON = ("RUNS", "--split", "--estimator", "--data-root", "--metrics", "--out")

COMMAND = Command(CompareConfig, show, DESCRIPTION, common=COMMON)
