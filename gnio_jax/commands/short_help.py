"""Help that fits a screen: of commands with many options the common ones, a line or two for each.

tyro writes the help of all options; the short help takes its words from there.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import textwrap
from collections.abc import Collection, Iterator
from typing import NamedTuple

import tyro

SHORT, WHOLE = ("-h", "--help"), ("-H", "--help-all")
WIDTH = 100
NAME_WIDTH = 28
"""Of option and value; longer ones have a line of their own."""

UNSAID = ("", "None", "True", "False")
"""Defaults that the text or the option itself tells."""


class Option(NamedTuple):
    """One option as tyro's help has it."""

    name: str
    """`--optim.epochs`, or the word of one that is given without a name."""
    usage: str
    """`--optim.epochs INT`."""
    text: str
    """What it means, and its default."""


def short_help(
    kind: type, description: str, prog: str, common: tuple[str, ...], known: Collection[str]
) -> str | None:
    """Description, common options, and where the others are explained.

    `known` are the names of all options. None where tyro's help cannot be read as it used to be:
    an option is not found in it, or nothing is said of it.
    """
    options = {option.name: option for option in all_options(kind)}
    wanted = {*common, *(name for name in known if not _negates(name, known))}
    if not all(name in options and options[name].text for name in wanted):
        return None
    rest = [name for name in options if name not in common]
    sections = sorted({name[2:].partition(".")[0] for name in rest if "." in name})
    more = f"{prog} --help-all explains all {len(options)} options"
    if sections:
        plural = "s" if len(sections) > 1 else ""
        more += f", also those of the section{plural} {', '.join(sections)}"
    words = [options[name].usage for name in common if not name.startswith("-")]
    lines = [
        f"usage: {' '.join([prog, *words, '[OPTIONS]'])}",
        "",
        description.rstrip(),
        "",
        "options:",
    ]
    for name in common:
        lines += _lines(options[name])
    return "\n".join([*lines, "", *textwrap.wrap(f"{more}.", WIDTH)])


def _negates(name: str, known: Collection[str]) -> bool:
    """Whether an option is --no-flag of another one, with which it shares its place."""
    head, _, last = name.rpartition(".")
    positive = last.replace("no-", "", 1)
    return last != positive and (f"{head}.{positive}" if head else positive) in known


def all_options(kind: type) -> list[Option]:
    """Every option of a dataclass, from the help that tyro writes."""
    found: list[Option] = []
    for line in _help_of_tyro(kind).splitlines():
        inner = line.strip("│").rstrip()
        if re.match(r" (-\S|[A-Z_]+(  |$))", inner) and line.startswith("│"):
            usage, _, text = inner.strip().partition("  ")
            found.append(Option(re.split(r"[ ,]", usage)[0], usage, text.strip()))
        elif inner.startswith(" " * 5) and found and line.startswith("│"):
            last = found[-1]
            found[-1] = last._replace(text=f"{last.text} {inner.strip()}".strip())
    return [option for option in found if option.name not in SHORT]


def _lines(option: Option) -> list[str]:
    """Usage on the left, the first sentence and the default on the right."""
    meaning, _, default = option.text.partition(" (default: ")
    first = re.split(r"(?<=\.)\s(?=[A-Z])", meaning)[0]
    shown = first if default.rstrip(")") in UNSAID else f"{first} (default: {default}"
    indent = " " * (NAME_WIDTH + 4)
    beside = textwrap.wrap(shown, WIDTH, initial_indent=indent, subsequent_indent=indent)
    usage = f"  {_usage(option.usage)}"
    if len(usage) > NAME_WIDTH + 2:
        return [usage, *beside]
    return [usage.ljust(len(indent)) + beside[0].lstrip(), *beside[1:]]


def _usage(usage: str) -> str:
    """Without what need not be said: None among the values."""
    return usage.replace("{None}|", "").replace("{None,", "{")


def _help_of_tyro(kind: type) -> str:
    """In one column of boxes, whose lines are joined later."""
    written = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    with _columns(100), contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
        tyro.cli(kind, args=["--help"], prog="", description="")
    written.seek(0)
    return written.read()


@contextlib.contextmanager
def _columns(width: int) -> Iterator[None]:
    """The terminal's width, as programs ask for it."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(width)
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
