"""`gnio`: the one program, with its subcommands."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from gnio_jax.commands import console, options

HELP = """Gated Neural Inertial Odometry: where has a person walked, from the IMU of a phone alone?

examples:
  {prog} track walk.zip                                    the path of your own recording
  {prog} train --config quickstart --workdir runs/demo     a first network, without a download
  {prog} evaluate --network runs/demo                      its trajectories, errors and pictures
  {prog} data list                                         the datasets, and where to get them"""
DATA_HELP = """Datasets and recordings.

examples:
  {prog} check oxiod                                  do IMU and reference describe one motion?
  {prog} import walk.zip --out recordings/walk.h5     a recording of your own"""

GNIO = options.Group(
    HELP,
    {
        "track": "track:track",
        "live": "live:live",
        "train": "train:train",
        "evaluate": "evaluate:evaluate",
        "score": "evaluate:score",
        "calibrate": "calibrate:calibrate",
        "compare": "compare:compare",
        "tables": "tables:tables",
        "data": options.Group(
            DATA_HELP,
            {
                "list": "data:show_list",
                "check": "data:check",
                "convert": "data:convert",
                "import": "recordings:import_file",
                "export": "recordings:export_file",
            },
        ),
        "weights": "weights:weights",
        "publish": "weights:publish",
        "export": "weights:export",
        "interop": "interop:interop",
        "doctor": "doctor:doctor",
    },
)


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command, by default that of the process, and exit with its status."""
    words = list(sys.argv[1:] if argv is None else argv)
    console.run(lambda: _run(words))


def _run(words: list[str]) -> None:
    if words == ["--completion"]:
        print(options.completion(GNIO, "gnio"))
    elif words in (["--version"], ["version"]):
        print(f"gnio-jax {version('gnio-jax')}")
    else:
        options.run(GNIO, options.Call(_program(), words))


def _program() -> str:
    """How this program was started: a script that registers a network of its own knows that
    network, which `gnio` does not."""
    script = Path(sys.argv[0])
    is_script = script.suffix == ".py" and script.name != "__main__.py"
    return f"python {script}" if is_script else "gnio"
