"""`gnio train` in a process that may send itself a signal in the middle of an epoch.

    python -m tests.support.training_process SIGTERM 15 --workdir RUN ...

The words after signal and step are those of `gnio train`; `never 0` sends none. The network may be
`tiny`.
"""

import os
import signal
import sys

from gnio_jax.commands import app
from gnio_jax.models import registry
from gnio_jax.training import loop
from tests.support.tiny_network import Tiny


def main(name, step, *arguments):
    run_steps = loop._run_steps
    loop.DISPATCH_SECONDS = 0  # one step at a time
    registry._MODELS["tiny"] = Tiny

    def interrupted(*given):
        group = run_steps(*given)
        if name != "never" and group.step >= int(step):
            os.kill(os.getpid(), signal.Signals[name])
        return group

    loop._run_steps = interrupted
    app.main(["train", *arguments])


if __name__ == "__main__":
    main(*sys.argv[1:])
