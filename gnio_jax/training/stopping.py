"""SIGTERM and Ctrl-C ask a run to save and leave."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from gnio_jax.scaling.processes import agreed


class Stop:
    """Whether a signal has asked the run to stop."""

    received: int | None = None
    """What this process has been sent."""
    signum: int | None = None
    """What one of the processes has been sent, as all of them know since they last agreed."""

    def agree(self) -> None:
        """Tell the other processes what this one has been sent, and hear it of them."""
        (signum,) = agreed(self.received or 0)
        self.signum = signum or None


@contextmanager
def stop_signals() -> Iterator[Stop]:
    """Note SIGTERM and Ctrl-C instead of leaving; a second Ctrl-C leaves at once."""
    stop = Stop()

    def note(signum: int, _: object) -> None:
        if stop.received == signal.SIGINT == signum:
            raise KeyboardInterrupt
        stop.received = signum

    before = {signum: signal.signal(signum, note) for signum in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
