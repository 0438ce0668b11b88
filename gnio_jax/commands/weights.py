"""`gnio weights`, `gnio publish`, `gnio export`: trained networks, here and for other people."""

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
    network: Annotated[str | None, UNNAMED] = None
    """Name, folder or zip of a published network, whose card is shown; by default all networks are
    listed."""


@dataclass(frozen=True)
class PublishOptions:
    network: Annotated[str, UNNAMED]
    """Network: the folder of a run, a package or a name."""
    out: Path
    """Folder to write, or NAME.zip."""
    data: str
    """Training data: recordings, devices, people, carrying positions."""
    license: str
    """Terms under which the data may be used and the weights passed on."""
    fails: tuple[str, ...] = ()
    """Cases in which it is known to fail, one sentence each."""
    name: str | None = None
    """Name of the network; by default that of OUT."""


@dataclass(frozen=True)
class ExportOptions:
    network: Annotated[str, UNNAMED]
    """Network: the folder of a run, a package or a name."""
    out: Path | None = None
    """Folder to write; by default exports/NAME_onnx, with the name of NETWORK."""


def weights(request: WeightsOptions, _call: options.Call) -> None:
    """List the trained networks that are found here: name, size, training data, key metric.

    Networks are looked for in the installed gnio-jax and in the folders of $GNIO_WEIGHTS. Every
    command with --network takes their names. gnio publish writes a network with a card for other
    people.

    examples:
      {prog}                                     a list of what is found
      {prog} pedestrian                          its card
      gnio evaluate --network pedestrian --dataset oxiod --split unseen
      GNIO_WEIGHTS=~/networks {prog}
    """
    from gnio_jax import networks  # late: mistakes do not wait for JAX
    from gnio_jax.networks.folder import read_text

    if request.network is not None:
        console.say(read_text(networks.find_network(request.network)))
        return
    damaged, headings = [], ("name", "size", "network", "trained on", "licence", "measured")
    grid = console.columns(*headings, box=box.SIMPLE_HEAD)
    for name, path in networks.list_networks().items():
        try:
            grid.add_row(name, *_describe(path))
        except InputError as error:
            damaged.append(str(error))
    if grid.row_count:
        console.say(grid)
    elif not damaged:
        remedy = "gnio publish writes one, and $GNIO_WEIGHTS names folders to look in"
        console.say(f"no networks found; {remedy}")
    for line in damaged:
        console.say(line)


def _describe(path: Path) -> tuple[str, ...]:
    """Size, network, training data, licence and measured error of a network."""
    from gnio_jax.networks.folder import WEIGHTS, has_card, read_card, read_settings

    if path.is_file() or has_card(path):
        card = read_card(path)
        size = card.files[WEIGHTS]["bytes"]
        texts = card.network, card.data, card.license, card.measured or "–"
    else:
        config, size = read_settings(path).config, (path / WEIGHTS).stat().st_size
        data = f"dataset {', '.join(config.datasets)}, split {config.data.train_split}"
        texts = config.model.name, data, "–", "–"
    return f"{size / 1e6:.2f} MB", *texts


def publish(request: PublishOptions, _call: options.Call) -> None:
    """Publish a network for other people: weights, settings, card, checksums.

    It contains no data, and no code that runs when it is loaded. Its card has the figures of the
    network's evaluations, so evaluate before you publish.

    examples:
      {prog} runs/mine --out networks/mine --data "12 h of walks by 9 people, phone in hand" \\
          --license "CC BY 4.0"
      {prog} runs/mine --out mine.zip --data "..." --license "..." --fails "Running." "In a car."
      gnio track walk.zip --network mine.zip
    """
    from gnio_jax.apps import publish as publishing  # late: mistakes do not wait for JAX
    from gnio_jax.networks.folder import WEIGHTS

    name = request.name or request.out.name.removesuffix(".zip")
    texts = (name, request.data, request.license, request.fails)
    card = publishing.publish(request.network, request.out, *texts)
    size = f"{card.files[WEIGHTS]['bytes'] / 1e6:.2f} MB"
    console.say(f"{request.out}: {card.name}, network {card.network}, {size}")
    if not card.measured:
        line = "there is no evaluation, so the card has no figures: gnio evaluate"
        console.say(f"warning: {line} --network {request.network}")
    console.say(f"next: gnio track RECORDING --network {request.out}")


def export(request: ExportOptions, _call: options.Call) -> None:
    """Export a network as ONNX models for programs without Python.

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
    name = Path(request.network).name.removesuffix(".zip")
    out = request.out or Path("exports") / f"{name}_onnx"
    with console.terminal() as terminal:
        terminal.progress("exporting and measuring", 0.0)
        exported = onnx.export_run(request.network, out)
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
