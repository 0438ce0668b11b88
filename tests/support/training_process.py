"""`gnio train` in a process that may send itself a signal in the middle of an epoch.

    python -m tests.support.training_process SIGTERM 15 0 --workdir RUN ...

The words after signal, step and 1 for a checkpoint after every step, else 0, are those of
`gnio train`; `never 0` sends none. The network may be `tiny`.
"""

import os
import signal
import sys

from gnio_jax.commands import app
from gnio_jax.models import registry
from gnio_jax.training import loop
from tests.support.tiny_network import Tiny


def main(name, step, every, *arguments):
    add_steps = loop.add_steps
    loop.DISPATCH_SECONDS = 0  # one step at a time
    if every == "1":
        loop.CHECKPOINT_SECONDS = 0
    registry._MODELS["tiny"] = Tiny

    def interrupted(*inputs):
        at = add_steps(*inputs)
        if name != "never" and at.step >= int(step):
            os.kill(os.getpid(), signal.Signals[name])
        return at

    loop.add_steps = interrupted
    app.main(["train", *arguments])


if __name__ == "__main__":
    main(*sys.argv[1:])
