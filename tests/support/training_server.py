"""Starts modules of `tests.support` as processes, each by a fork of this one: what they import,
half of what a short run costs, is imported once.

Reads a line of JSON for each process from stdin: {"module": NAME, "arguments": [...], "files":
PREFIX}. What the process prints is in PREFIX.out and PREFIX.err; its exit status appears in
PREFIX.status when it has ended.
"""

import gc
import json
import os
import signal
import sys
from pathlib import Path

from gnio_jax import filtering  # noqa: F401
from gnio_jax.apps import packages  # noqa: F401
from gnio_jax.files import write_text
from gnio_jax.training import loop  # noqa: F401
from tests.support import sequences_process, training_process

MODULES = {"training": training_process, "sequences": sequences_process}


def main():
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that watch
    # A process that looks through what it shares with this one copies it: a second of each.
    gc.set_threshold(100_000, 50, 100)
    gc.collect()
    gc.freeze()
    for line in sys.stdin:
        asked = json.loads(line)
        if os.fork() == 0:
            return watch(asked)
    return None


def watch(asked):
    """Begin the process, wait for its end, and note its status."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    process = os.fork()
    if process == 0:
        return begin(asked)
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    write_text(Path(f"{asked['files']}.status"), str(status))
    os._exit(0)


def begin(asked):
    for descriptor, name in ((0, os.devnull), (1, f"{asked['files']}.out")):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT), descriptor)
    os.dup2(os.open(f"{asked['files']}.err", os.O_RDWR | os.O_CREAT), 2)
    return MODULES[asked["module"]].main(*asked["arguments"])


if __name__ == "__main__":
    main()
