"""Errors that a user can correct. Nothing here imports JAX, so that options are checked quickly."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable, Iterable


class InputError(ValueError):
    """A mistake that a user can correct. Its text is one line: the place, the problem, the remedy.

    The command lines print it on stderr and exit with status 2.
    """

    def __init__(self, where: object, problem: str, remedy: str = ""):
        parts = [f"{where}: {problem}", remedy]
        super().__init__("; ".join(part for part in parts if part).replace("\n", " "))
        self.parts = (str(where), problem, remedy)

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), self.parts  # so that it can come from another process


def did_you_mean(
    word: str, words: Iterable[str], shown: Callable[[str], object] = str, cutoff: float = 0.6
) -> str:
    """The beginning of a remedy that names the closest of the known words, as `shown` writes it;
    empty if none is close."""
    close = difflib.get_close_matches(str(word), list(words), n=1, cutoff=cutoff)
    return f"did you mean '{shown(close[0])}'? " if close else ""


def require_packages(where: object, extra: str, *names: str) -> None:
    """Raise `InputError` if a package of an extra of gnio-jax is not installed."""
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError:
            remedy = f"pip install 'gnio-jax[{extra}]'"
            raise InputError(where, f"needs the package {name}", remedy) from None
