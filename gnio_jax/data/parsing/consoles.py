"""The lines of a serial console as a table: boards often print names beside their numbers, and the
console puts the time before each line. Limits are ours."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

STAMP = re.compile(rb"^\[?(\d\d?:\d\d:\d\d)[.,:](\d+)\]? *-?> *", re.MULTILINE)
"""The time before a line, as Arduino's console writes it: `09:15:02.250 -> `."""
PAIR = re.compile(rb"([A-Za-z_]\w*) *[:=] *([+-]?\d[\d.eE+-]*)")
"""A number with its name, as Arduino's plotter reads it: `gx:0.12`."""
FEWEST_PAIRS, SHARE = 3, 0.9
"""Smallest number of names in a line, and share of the lines that are of one form."""


class ConsoleForm(NamedTuple):
    """The form of the lines."""

    separator: bytes
    """Separator of the numbers."""
    names: tuple[str, ...] = ()
    """Names of the columns; none if the lines have none."""

    def rows(self, content: bytes) -> bytes:
        """A content in which each line of this form is a row. Others remain."""
        content = STAMP.sub(rb"\1.\2" + self.separator, content)
        if not self.names:
            return content
        lines = content.split(b"\n")
        return b"\n".join(self._numbers(line) for line in lines)

    def _numbers(self, line: bytes) -> bytes:
        pairs = PAIR.findall(line)
        is_stamped = len(self.names) > len(pairs)
        if [name.decode() for name, _ in pairs] != [*self.names[is_stamped:]]:
            return line
        stamp = [line.split(self.separator, 1)[0]] * is_stamped
        return self.separator.join([*stamp, *(number for _, number in pairs)])


def console_of(head: bytes, separator_of: Callable[[bytes], str]) -> ConsoleForm | None:
    """The form of the lines of a console by its first bytes; None if it is a table.

    `separator_of` gives the separator of a table by its first bytes.
    """
    lines = [line for line in head.splitlines() if line.strip()]
    is_stamped = sum(bool(STAMP.match(line)) for line in lines) > SHARE * len(lines)
    texts = [STAMP.sub(b"", line) for line in lines] if is_stamped else lines
    forms = Counter(tuple(name.decode() for name, _ in PAIR.findall(line)) for line in texts)
    names, count = max(forms.items(), key=lambda form: form[1], default=((), 0))
    is_named = len(set(names)) == len(names) >= FEWEST_PAIRS
    if is_named and count > SHARE * len(lines) - 1:  # the last line may be cut
        return ConsoleForm(b",", ("time",) * is_stamped + names)
    return ConsoleForm(separator_of(b"\n".join(texts)).encode()) if is_stamped else None
