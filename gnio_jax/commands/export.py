"""`gnio export`: a trained network and its filter for programs without Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command

DESCRIPTION = """A run as ONNX models, for programs without Python.

  {prog} runs/mine                                (network, start, window and filter step)

The filter is that of gnio track. The models are then driven over a minute of a synthetic walk, and
their deviation from the package is printed. export.json lists what each model takes and gives.
Needs pip install 'gnio-jax[onnx]'. docs/deployment.md and examples/onnx show the loop around the
models."""


@dataclass(frozen=True)
class ExportOptions:
    """What `gnio export` is asked for."""

    run: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run, a package or its name."""
    out: Path | None = None
    """Folder to write; by default exports/ and the name of RUN."""


def export(options: ExportOptions, _prog: str) -> None:
    """Export, and show the files and how far they are from the package."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import deployment

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    name = Path(options.run).name.removesuffix(".zip")
    out = options.out or Path("exports") / name
    with console.terminal() as terminal:
        terminal.progress("exporting and measuring", 0.0)
        found = deployment.export_run(options.run, out)
    output = console.stdout()
    for file, size in found.bytes.items():
        output.print(f"  {out / file}  {size / 1e6:.2f} MB", soft_wrap=True)
    for line in _lines(found.deviation):
        output.print(f"  {line}", soft_wrap=True)


def _lines(found: Any) -> list[str]:
    """Of an `accuracy.Deviation`."""
    return [
        "against gnio-jax, over a synthetic walk:",
        f"  displacement of a window  rms {found.displacement_rms:.2g} m, "
        f"largest {found.displacement_largest:.2g} m",
        f"  position                  largest {found.position_largest:.2g} m",
        f"  ATE                       {found.ate:.3f} m (gnio-jax {found.ate_of_package:.3f} m)",
    ]


COMMAND = Command(ExportOptions, export, DESCRIPTION)
