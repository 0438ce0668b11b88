"""The lines of a serial console as a table: boards often print names beside their numbers, and the
console puts the time before each line. Limits are ours."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

STAMP = re.compile(rb"^\[?(\d\d?:\d\d:\d\d)[.,:](\d+)\]? *-?> *", re.MULTILINE)
"""The time before a line, as Arduino's console writes it: `09:15:02.250 -> `."""
PAIR = re.compile(rb"(?<!\w)([A-Za-z_]\w*) *[:=] *([+-]?\d[\d.eE+-]*)")
"""A number with its name, as Arduino's plotter reads it: `gx:0.12`. Names begin where words begin,
so that a long word costs no more than its length."""
LONE = re.compile(rb"(?<![\w^])\d")
"""The beginning of a number without a name. That of m/s^2 is none."""
CONSOLE_TIME = "console_time"
"""Name of the column of the console's times. A clock that the board prints comes before it."""
FEWEST_PAIRS, SHARE = 3, 0.9
"""Smallest number of names in a line, and share of the lines that are of one form."""


class ConsoleForm(NamedTuple):
    """The form of the lines."""

    separator: bytes
    """Separator of the numbers."""
    is_stamped: bool
    """Whether the console's time is before each line."""
    names: tuple[str, ...] = ()
    """Names of the board's numbers; none if the lines have none."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns; none if the lines have none."""
        return (CONSOLE_TIME,) * self.is_stamped + self.names if self.names else ()

    def rows(self, content: bytes) -> bytes:
        """A content in which each line of this form is a row. Others remain."""
        if not self.names:
            return STAMP.sub(rb"\1.\2" + self.separator, content)
        return b"\n".join(self._row(line) for line in content.split(b"\n"))

    def _row(self, line: bytes) -> bytes:
        stamp, pairs = STAMP.match(line), _named_numbers(STAMP.sub(b"", line))
        names = tuple(name.decode() for name, _ in pairs)
        if names != self.names:
            return line
        stamps = [stamp.expand(rb"\1.\2")] if stamp else []
        return self.separator.join([*stamps, *(number for _, number in pairs)])


def _named_numbers(line: bytes) -> list[tuple[bytes, bytes]]:
    """(name, number) of each number in a line; none if a number has no name, because that one would
    be lost."""
    return [] if LONE.search(PAIR.sub(b"", line)) else PAIR.findall(line)


def console_of(head: bytes, separator_of: Callable[[bytes], str]) -> ConsoleForm | None:
    """The form of the lines of a console by its first bytes; None if it is a table.

    `separator_of` gives the separator of a table by its first bytes.
    """
    lines = [line for line in head.splitlines() if line.strip()]
    is_stamped = sum(bool(STAMP.match(line)) for line in lines) > SHARE * len(lines)
    texts = [STAMP.sub(b"", line) for line in lines] if is_stamped else lines
    forms = Counter(tuple(name.decode() for name, _ in _named_numbers(line)) for line in texts)
    names, count = max(forms.items(), key=lambda form: form[1], default=((), 0))
    is_named = len(set(names)) == len(names) >= FEWEST_PAIRS
    if is_named and count > SHARE * len(lines) - 1:  # the last line may be cut
        return ConsoleForm(b",", is_stamped, names)
    return ConsoleForm(separator_of(b"\n".join(texts)).encode(), True) if is_stamped else None
