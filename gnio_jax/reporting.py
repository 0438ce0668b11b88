"""How a long computation tells what it does. The command lines pass a terminal; a library call
needs nothing."""

from __future__ import annotations

import sys
from typing import Protocol, runtime_checkable


@runtime_checkable
class Reporter(Protocol):
    """Receives lines of text, and the progress of the stage that runs."""

    def line(self, text: str) -> None:
        """One line for a person."""
        ...

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        """What is being done, the share of it that is done (0 to 1), and its figures."""
        ...


class Silence:
    """Says nothing: of several processes one alone speaks."""

    def line(self, text: str) -> None:
        pass

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass


class Lines:
    """Plain lines on stderr, without a progress bar."""

    def line(self, text: str) -> None:
        print(text, file=sys.stderr)

    def progress(self, stage: str, share: float, numbers: str = "") -> None:
        pass
