"""Reporting of the progress of a long computation: to a terminal, as plain lines, or not at all."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Protocol, runtime_checkable

Progress = Callable[[float], None]
"""A function that is called with the finished share of a stage, from 0 to 1."""


def silent(share: float) -> None:
    """A `Progress` that shows nothing."""


@runtime_checkable
class Reporter(Protocol):
    """A receiver of lines of text and of the progress of the current stage."""

    def line(self, text: str) -> None:
        """Show one line of text."""
        ...

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        """Show that `stage` is done to the given share (0 to 1), with its current figures."""
        ...


class Silence:
    """A reporter that shows nothing, for library calls, and for all processes but the first."""

    def line(self, text: str) -> None:
        pass

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass


class Lines:
    """A reporter that prints plain lines on stderr, without a progress bar."""

    def line(self, text: str) -> None:
        print(text, file=sys.stderr)

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass
