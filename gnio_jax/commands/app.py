"""`gnio`: the one program, with its subcommands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from gnio_jax.commands import console, options

HELP = """Gated Neural Inertial Odometry: where has a person walked, from the IMU of a phone alone?

usage: {prog} COMMAND [OPTIONS]

  your own recordings
    track        The trajectory of a recording, and how far to trust it.
    live         The trajectory of an IMU while its samples come.
    weights      The trained networks that are found here.
  research
    train        Train a network on a dataset.
    evaluate     Trajectories and errors of a trained network.
    calibrate    Fit the filter of a run to the errors of its network.
    compare      Runs side by side: what a change has changed, and how sure that is.
    tables       The paper's tables, trained and evaluated anew.
  data
    data         The datasets: list, check, convert; recordings: import, export.
    interop      A run of TLIO's trained weights.
  to pass on
    publish      A package of a run, with its model card.
    export       A run as ONNX, for programs without Python.
  help
    doctor       What is installed here and what is found.

examples:
  {prog} track walk.zip                                    the path of your own recording
  {prog} train --config quickstart --workdir runs/demo     a first network, without a download
  {prog} evaluate --workdir runs/demo                      its trajectories, errors and pictures
  {prog} data list                                         the datasets, and where they are had

{prog} COMMAND --help explains a command, with examples at its end."""


DATA_HELP = """Datasets and recordings.

usage: {prog} COMMAND [OPTIONS]

  list       Every dataset that is read: rate, splits, licence, where it is had, what is found here.
  check      Do IMU and reference of a dataset's recordings describe one motion?
  convert    A dataset as the package's HDF5, with its splits, at one rate.
  import     A recording of a phone or robot as the package's HDF5.
  export     A trajectory in the format of another program.

examples:
  {prog} check oxiod
  {prog} import walk.zip --out recordings/walk.h5

{prog} COMMAND --help explains a command, with examples at its end."""

GNIO = options.Group(
    HELP,
    {
        "train": "train:train",
        "evaluate": "evaluate:evaluate",
        "calibrate": "calibrate:calibrate",
        "compare": "compare:compare",
        "tables": "tables:tables",
        "track": "track:track",
        "live": "live:live",
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
    """Run a command, by default that of the process, and leave with its exit status."""
    words = sys.argv[1:] if argv is None else argv
    console.run(lambda: options.run(GNIO, options.Call("gnio", words)))
