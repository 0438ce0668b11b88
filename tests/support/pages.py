"""The pages that people read, and the code in them.

A Python block runs in the tests unless the line before it says why not:

    <!-- not run in the tests: needs a recording -->
"""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
FENCE = re.compile(
    r"(?:<!-- not run in the tests: (?P<reason>[^>]+?) -->\n)?"
    r"^```(?P<language>\w*)[^\n]*\n(?P<code>.*?)^```",
    re.S | re.M,
)
INLINE = re.compile(r"`(gnio [a-z][^`]*)`")
SHELL = ("", "bash", "sh", "console")
LEFT_OUT = re.compile(r"\[--[^\]]*\]|\.\.\.|…")
"""Of a command line in a text: what may be given, and what stands for the rest."""


class Block(NamedTuple):
    page: str
    line: int
    language: str
    code: str
    reason: str
    """Why it is not run in the tests; empty if it is."""


class CommandLine(NamedTuple):
    page: str
    words: tuple[str, ...]
    quoted: bool
    """In the middle of a sentence, where it may be cut short."""


def pages():
    """The pages of the site, and what the repository shows first."""
    first = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md"]
    return [*first, *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page):
    """The fenced blocks of one page."""
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        line = text.count("\n", 0, match.start("code")) + 1
        name = page.relative_to(ROOT).as_posix()
        yield Block(name, line, match["language"], match["code"], match["reason"] or "")


def python_blocks():
    return [block for page in pages() for block in blocks(page) if block.language == "python"]


def shell_lines():
    """Every line of a shell block, continued ones as one, without prompt and comment."""
    for page in pages():
        for block in blocks(page):
            if block.language in SHELL:
                for line in block.code.replace("\\\n", " ").splitlines():
                    yield block.page, line.strip().removeprefix("$ ")


def command_lines():
    """Each `gnio …` of the pages once, in blocks and in sentences."""
    occurrences = {}
    for page, line in shell_lines():
        start = re.search(r"(^|[|] |srun )gnio ", line)
        if start:
            occurrences[_words(line[start.start() :].removeprefix("| "))] = (page, False)
    for page in pages():
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for match in INLINE.finditer(text):
            occurrences.setdefault(_words(match[1]), (page.relative_to(ROOT).as_posix(), True))
    return [CommandLine(page, words, quoted) for words, (page, quoted) in occurrences.items()]


def _words(line):
    """Words after `gnio`; variables of the shell that hold options are left out."""
    words = shlex.split(LEFT_OUT.sub(" ", line), comments=True)
    words = words[words.index("gnio") + 1 :]
    return tuple(word for word in words if not re.fullmatch(r"\$\w+", word))
