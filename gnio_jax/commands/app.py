"""`gnio`: the one program, with its subcommands."""

from __future__ import annotations

from collections.abc import Sequence

from gnio_jax.commands import (
    calibrate,
    compare,
    console,
    data,
    doctor,
    evaluate,
    export,
    interop,
    live,
    options,
    publish,
    tables,
    track,
    train,
    weights,
)

GNIO = options.Group(
    {
        "train": train.COMMAND,
        "evaluate": evaluate.COMMAND,
        "calibrate": calibrate.COMMAND,
        "compare": compare.COMMAND,
        "data": data.COMMANDS,
        "track": track.COMMAND,
        "live": live.COMMAND,
        "publish": publish.COMMAND,
        "export": export.COMMAND,
        "weights": weights.COMMAND,
        "tables": tables.COMMAND,
        "interop": interop.COMMAND,
        "doctor": doctor.COMMAND,
    },
    """Gated Neural Inertial Odometry: where has a person walked, from the IMU of a phone alone?

  {prog} train --config quickstart --workdir runs/demo     (a first network, without a download)
  {prog} track walk.zip                                    (the path of your own recording)
  {prog} evaluate --workdir runs/demo                      (its trajectories, errors and pictures)
  {prog} data list                                         (the datasets, and where they are had)
  {prog} doctor                                            (what is installed here and found)

{prog} COMMAND --help explains each command with examples.""",
)


def main(argv: Sequence[str] | None = None) -> None:
    """Run one subcommand and leave with its exit status."""
    console.run(lambda: options.execute(GNIO, argv, "gnio"))
