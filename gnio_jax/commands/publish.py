"""`gnio publish`: a package of a run, for those who do not have its data."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command

DESCRIPTION = """A package of a run: weights, configuration, model card, checksums.

  {prog} runs/mine --out packages/mine --data "12 h of walks by 9 people, phone in hand" \\
      --license "CC BY 4.0"
  {prog} runs/mine --out mine.zip --data "..." --license "..." --storage float16 \\
      --fails "Running." "Phones on a car's mount."

The package holds no data, and no code that is run when it is loaded. The figures of the run's
evaluations go with it: evaluate before you publish. gnio track --weights mine.zip uses it."""


@dataclass(frozen=True)
class PublishOptions:
    """What `gnio publish` is asked for."""

    run: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="RUN")]]
    """Folder of the run."""
    out: Path
    """Folder to write, or NAME.zip."""
    data: str
    """What it was trained on: recordings, devices, people, carrying positions."""
    license: str
    """Under which the data may be used and the weights passed on."""
    fails: tuple[str, ...] = field(default=())
    """Where it is known to fail, a sentence each."""
    name: str | None = None
    """Name of the package; by default that of OUT."""
    storage: Literal["float32", "float16"] = "float32"
    """float16 halves the size; the card says what it changes."""
    checkpoint: Literal["best", "latest"] = "best"
    """Which checkpoint of the run."""


def publish(options: PublishOptions, _prog: str) -> None:
    """Write the package and say what is in it."""
    from gnio_jax import pretrained

    name = options.name or options.out.name.removesuffix(".zip")
    said = pretrained.Description(name, options.data, options.license, options.fails)
    about = pretrained.publish(options.run, options.out, said, options.storage, options.checkpoint)
    output = console.stdout()
    size = f"{about.bytes / 1e6:.2f} MB, {about.storage}"
    output.print(f"{options.out}: {about.name}, network {about.network}, {size}", soft_wrap=True)
    if about.metric is None:
        line = "the run holds no evaluation, so the card has no figures: gnio evaluate"
        output.print(f"warning: {line} --workdir {options.run}", soft_wrap=True)
    output.print(f"next: gnio track RECORDING --weights {options.out}", soft_wrap=True)


COMMAND = Command(PublishOptions, publish, DESCRIPTION)
