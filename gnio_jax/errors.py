"""The error a user can mend. It imports nothing, so that options are checked without JAX."""

from __future__ import annotations


class InputError(ValueError):
    """A mistake a user can mend: its text is one line naming the place, the problem and the remedy.

    The command lines print it on stderr and leave with exit status 2.
    """

    def __init__(self, where: object, problem: str, remedy: str = ""):
        parts = [f"{where}: {problem}", remedy]
        super().__init__("; ".join(part for part in parts if part).replace("\n", " "))
        self.parts = (str(where), problem, remedy)

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return type(self), self.parts  # so that it can come from another process
