"""`gnio weights`, `gnio publish`, `gnio export`: trained networks for other people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich import box

from gnio_jax.commands import console, options
from gnio_jax.config.schema import UNNAMED
from gnio_jax.errors import InputError


@dataclass(frozen=True)
class WeightsOptions:
    name: Annotated[str | None, UNNAMED] = None
    """Name, folder or zip of a package; by default all are listed."""
    out: Path | None = None
    """Folder for a run made from the package; by default its model card is shown."""


@dataclass(frozen=True)
class PublishOptions:
    run: Annotated[Path, UNNAMED]
    """Folder of the run; its best checkpoint is used."""
    out: Path
    """Folder to write, or NAME.zip."""
    data: str
    """Training data: recordings, devices, people, carrying positions."""
    license: str
    """Terms under which the data may be used and the weights passed on."""
    fails: tuple[str, ...] = ()
    """Cases in which it is known to fail, one sentence each."""
    name: str | None = None
    """Name of the package; by default that of OUT."""


@dataclass(frozen=True)
class ExportOptions:
    run: Annotated[str, UNNAMED]
    """Folder of the run, a package or its name."""
    out: Path | None = None
    """Folder to write; by default exports/NAME_onnx, with the name of RUN."""


def weights(request: WeightsOptions, _call: options.Call) -> None:
    """List the trained networks that are found here: name, size, training data, key metric.

    Packages are looked for in the installed gnio-jax and in the folders of $GNIO_WEIGHTS. gnio
    track --weights NAME uses one; gnio publish makes one from a run. With --out a package becomes a
    run, which gnio evaluate, gnio calibrate and gnio train --init-from take.

    examples:
      {prog}                                     a list of what is found
      {prog} pedestrian                          its model card
      {prog} pedestrian --out runs/pedestrian    a run of it
      GNIO_WEIGHTS=~/packages {prog}
    """
    if request.name is None and request.out is not None:
        raise InputError(f"--out {request.out}", "is for one package", "name it before --out")
    from gnio_jax.apps import packages  # late: mistakes do not wait for JAX

    if request.name is not None and request.out is not None:
        packages.write_run(request.name, request.out)
        following = f"gnio evaluate --workdir {request.out} --dataset ..."
        console.say(f"run: {request.out}; next: {following}")
        return
    if request.name is not None:
        console.say(packages.card_of(request.name))
        return
    damaged, headings = [], ("name", "size", "network", "trained on", "licence", "measured")
    grid = console.columns(*headings, box=box.SIMPLE_HEAD)
    for name, path in packages.packages().items():
        try:
            manifest = packages.read_manifest(path)
        except InputError as error:
            damaged.append(str(error))
            continue
        size, measured = f"{manifest.weights['bytes'] / 1e6:.2f} MB", manifest.measured or "–"
        grid.add_row(name, size, manifest.network, manifest.data, manifest.license, measured)
    if grid.row_count:
        console.say(grid)
    elif not damaged:
        remedy = "gnio publish makes one of a run, and $GNIO_WEIGHTS names folders to look in"
        console.say(f"no packages found; {remedy}")
    for line in damaged:
        console.say(line)


def publish(request: PublishOptions, _call: options.Call) -> None:
    """Make a package from a run: weights, settings, model card, checksums.

    It contains no data, and no code that runs when it is loaded. It includes the figures of the
    run's evaluations, so evaluate before you publish.

    examples:
      {prog} runs/mine --out packages/mine --data "12 h of walks by 9 people, phone in hand" \\
          --license "CC BY 4.0"
      {prog} runs/mine --out mine.zip --data "..." --license "..." --fails "Running." "In a car."
      gnio track walk.zip --weights mine.zip
    """
    from gnio_jax.apps import packages  # late: mistakes do not wait for JAX

    name = request.name or request.out.name.removesuffix(".zip")
    card_fields = (name, request.data, request.license, request.fails)
    manifest = packages.publish(request.run, request.out, *card_fields)
    size = f"{manifest.weights['bytes'] / 1e6:.2f} MB"
    console.say(f"{request.out}: {manifest.name}, network {manifest.network}, {size}")
    if not manifest.measured:
        line = "the run holds no evaluation, so the card has no figures: gnio evaluate"
        console.say(f"warning: {line} --workdir {request.run}")
    console.say(f"next: gnio track RECORDING --weights {request.out}")


def export(request: ExportOptions, _call: options.Call) -> None:
    """Export a run as ONNX models for programs without Python.

    The models are network, start, window and filter step, and the filter is that of gnio track.
    They are then run over a minute of a simulated walk, and their deviation from the package is
    printed. export.json describes the inputs and outputs of each file; docs/deployment.md and
    examples/onnx show the loop around them. It needs pip install 'gnio-jax[onnx]'.

    examples:
      {prog} runs/mine
      {prog} pedestrian --out exports/pedestrian
    """
    import jax  # late: mistakes do not wait for it

    from gnio_jax.apps import onnx

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    name = Path(request.run).name.removesuffix(".zip")
    out = request.out or Path("exports") / f"{name}_onnx"
    with console.terminal() as terminal:
        terminal.progress("exporting and measuring", 0.0)
        exported = onnx.export_run(request.run, out)
    for file, size in exported.bytes.items():
        console.say(f"  {out / file}  {size / 1e6:.2f} MB")
    deviation = exported.deviation
    rms, largest = (
        f"rms {deviation.displacement_rms:.2g} m",
        f"{deviation.displacement_largest:.2g} m",
    )
    console.say("  against gnio-jax, over a simulated walk:")
    console.say(f"    displacement of a window  {rms}, largest {largest}")
    console.say(f"    position                  largest {deviation.position_largest:.2g} m")
    errors = f"{deviation.ate:.3f} m (gnio-jax {deviation.ate_of_package:.3f} m)"
    console.say(f"    ATE                       {errors}")
