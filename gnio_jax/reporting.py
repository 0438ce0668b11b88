"""How a long computation reports its progress: to a terminal, as plain lines, or not at all."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Protocol, runtime_checkable

Progress = Callable[[float], None]
"""Called with the share of a stage that is done, from 0 to 1."""


def silent(share: float) -> None:
    """A `Progress` that tells nobody."""


@runtime_checkable
class Reporter(Protocol):
    """It receives lines of text and the progress of the current stage."""

    def line(self, text: str) -> None:
        """Show one line of text."""
        ...

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        """Show that `stage` is done to the given share (0 to 1), with its current figures."""
        ...


class Silence:
    """It shows nothing: a library call, or a process of several that is not the first."""

    def line(self, text: str) -> None:
        pass

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass


class Lines:
    """It prints plain lines on stderr and shows no progress bar."""

    def line(self, text: str) -> None:
        print(text, file=sys.stderr)

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass
