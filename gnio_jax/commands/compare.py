"""`gnio compare`: comparison of runs."""

from __future__ import annotations

from pathlib import Path

from rich import box
from rich.table import Table

from gnio_jax.commands import console, options
from gnio_jax.config import CompareConfig
from gnio_jax.cores import usable_cores
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable, with_ending

ENDINGS = (".md", ".csv", ".png")


def compare(request: CompareConfig, _call: options.Call) -> None:
    """Compare networks sequence by sequence: their differences, with intervals.

    The others are compared with the first one. Networks that have no evaluation yet are evaluated
    first. Seeds of a run are averaged, and the name of a run without its seed stands for all of
    them: runs/plain for runs/plain_s0, runs/plain_s1, ..., runs/plain_calibrated for
    runs/plain_s0_calibrated, ...

    Walks of one person or session are not independent, so the 95 % interval of a difference is
    Student's t over people or sessions. If it contains zero, the recordings do not show which of
    the two is better. It does not include the variation between seeds; ± is their standard
    deviation.

    examples:
      {prog} runs/plain runs/context --split sessions_test
      {prog} runs/plain runs/context --metrics ate rpe_1s rte_60s --out runs/plain_or_context
      {prog} pedestrian runs/mine --dataset oxiod --split unseen
      {prog} runs/gnio_s0 runs/gnio_s0/eval/oxiod_test_ekf_loose
    """
    if request.out is not None:
        _check_out(request.out)  # otherwise the evaluations for it would be lost
    from gnio_jax.apps import compare as comparison  # late: mistakes do not wait for JAX

    console.prepare_filter()
    with console.terminal() as terminal:
        result = comparison.compare(request, terminal, usable_cores())
    console.say(f"{comparison.title(result)}\n")
    table = Table(box=box.SIMPLE_HEAD, header_style="bold")
    table.add_column(overflow="fold", min_width=16)  # names get the remaining width
    for name in comparison.HEADER[2:]:
        table.add_column(name, justify="right")
    for metric, *cells in comparison.lines(result):
        if metric:
            table.add_row(metric, style="bold")
        table.add_row(f"  {cells[0]}", *cells[1:])
    console.say(table)
    for line in comparison.explanations(result):
        console.say(line)
    if request.out is not None:
        comparison.write(Path(request.out), result)
        console.say(f"\nresults: {request.out}.md, .csv, .png")


def _check_out(out: str) -> None:
    """Raise an error now if the files could not be written later."""
    path = Path(out)
    if path.name in ("", "..") or path.suffix in ENDINGS or out.endswith(("/", "\\")):
        remedy = "give the name of a file without its ending: runs/both"
        raise InputError("--out", f"'{out}' is not such a name", remedy)
    for ending in ENDINGS:
        try:
            check_writable(with_ending(path, ending))
        except OSError as error:
            problem = f"{with_ending(path, ending)} cannot be written ({error.strerror})"
            raise InputError("--out", problem, "give another name") from None
