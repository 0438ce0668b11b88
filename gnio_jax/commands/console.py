"""Command lines: typed options from a frozen dataclass, and user mistakes told in one line.

tyro reads the options and writes the help from the dataclass's field docstrings; its boxed errors
are rephrased as an `InputError`, which `run` prints as one line on stderr before it leaves with
exit status 2.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import errno
import io
import os
import re
import signal
import sys
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import tyro

from gnio_jax import config as configuration
from gnio_jax.types import InputError

Config = TypeVar("Config")

_DISK_ERRORS = {
    errno.EACCES,
    errno.EPERM,
    errno.ENOSPC,
    errno.EROFS,
    errno.EDQUOT,
    errno.ENOTDIR,
    errno.ENAMETOOLONG,
}


def parse(
    kind: type[Config],
    default: Config | None = None,
    description: str = "",
    argv: Sequence[str] | None = None,
    prog: str | None = None,
) -> Config:
    """Read a value of the dataclass `kind` from `argv` (default: the process's own arguments).

    Nested fields are dotted (`--optim.epochs 3`), words are joined by `-` or `_`, a flag's negation
    is `--no-flag`; fields of a type `tyro.conf.Positional[...]` are given without a name. Options
    win over `default`, which wins over the class's own defaults. For a `TrainConfig`, `--config
    FILE` names a YAML file whose fields win over `default` as a whole and lose to the options,
    wherever it stands among them. `--help` prints the options with their meaning and leaves with
    status 0. Raises `InputError` for an option that does not exist (naming the closest that does),
    lacks its value, has one of the wrong type, or is needed and missing.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if kind is configuration.TrainConfig:
        path, arguments = _take(arguments, "--config")
        default = default if path is None else typing.cast(Config, configuration.load(Path(path)))
        description = f"{description}\n\n--config FILE reads the options below from a YAML file; those given here win over it.".strip()
    options = _options(kind)
    if "-h" not in arguments and "--help" not in arguments:
        _check(
            arguments, options, {} if default is not None else _required(kind), _positionals(kind)
        )
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            return tyro.cli(
                kind,
                default=tyro.MISSING_NONPROP if default is None else default,
                description=description,
                args=arguments,
                prog=prog,
            )
    except SystemExit as leaving:
        if not leaving.code:
            raise
        raise _rephrase(captured.getvalue(), arguments, options) from None


def run(main: Callable[[], object]) -> None:
    """Call `main()`; a user's mistake becomes one line on stderr and exit status 2, Ctrl-C status
    130, no traceback either way.

    SIGTERM unwinds the program like an exception, so that nothing half-written stays behind, and
    gives status 143.

    A full disk or a folder that may not be written is told the same way; any other exception is a
    fault of the program and keeps its traceback. A warning is one line on stderr, too.
    """
    signal.signal(signal.SIGTERM, _terminated)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            main()
        sys.stdout.flush()
    except InputError as error:
        _leave(str(error), 2)
    except KeyboardInterrupt:
        _leave("interrupted", 130)
    except (
        BrokenPipeError
    ):  # the reader of our output (head, less) has left: nothing to tell and nobody to tell it to
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except OSError as error:
        if error.errno not in _DISK_ERRORS:
            raise
        _leave(f"{error.filename or 'output'}: {error.strerror}", 2)


@contextlib.contextmanager
def progress() -> Iterator[Callable[[str, float], None]]:
    """Yield a function of (what is being done, share of it done from 0 to 1) that draws a bar on
    stderr, if that is a terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bars:
        task = bars.add_task("loading", total=None)
        stage = "loading"

        def tell(what: str, share: float) -> None:
            nonlocal stage
            if what != stage:
                bars.reset(task)
                stage = what
            bars.update(task, description=what, completed=share, total=1.0)

        yield tell


def _leave(line: str, status: int) -> typing.NoReturn:
    print(" ".join(line.split()), file=sys.stderr)
    raise SystemExit(status) from None


def _terminated(number: int, _frame: object) -> typing.NoReturn:
    raise SystemExit(128 + number)


def _warn(message: Warning | str, *_: object) -> None:
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def _options(kind: Any, prefix: str = "") -> dict[str, Any]:
    """Every option of the dataclass `kind` as tyro spells it, without the dashes:
    {"optim.batch-size": int, ...}."""
    found: dict[str, Any] = {}
    words = _positionals(kind)
    for name, hint in typing.get_type_hints(kind).items():
        if name in words:
            continue
        option = prefix + name.replace("_", "-")
        if dataclasses.is_dataclass(hint):
            found |= _options(hint, option + ".")
        else:
            found[option] = hint
            if hint is bool:
                head, dot, tail = option.rpartition(".")
                found[f"{head}{dot}no-{tail}"] = hint
    return found


def _required(kind: Any) -> dict[str, str]:
    return {
        field.name.replace("_", "-"): field.name.upper()
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }


def _positionals(kind: Any) -> list[str]:
    """Names of the fields that are words without a name, in their order."""
    marker = typing.get_args(tyro.conf.Positional[str])[1]
    return [
        name
        for name, hint in typing.get_type_hints(kind, include_extras=True).items()
        if marker in typing.get_args(hint)[1:]
    ]


def _spelling(argument: str) -> str:
    """`--optim.batch_size=3` -> `optim.batch-size`."""
    return argument.lstrip("-").partition("=")[0].replace("_", "-")


def _take(arguments: list[str], option: str) -> tuple[str | None, list[str]]:
    """Remove `option VALUE` (or `option=VALUE`) from the arguments; the last one given counts."""
    value, rest, position = None, [], 0
    while position < len(arguments):
        name, equals, attached = arguments[position].partition("=")
        if name != option:
            rest.append(arguments[position])
        elif equals:
            value = attached
        else:
            position += 1
            if position == len(arguments):
                raise InputError(option, "needs a value")
            value = arguments[position]
        position += 1
    return value, rest


def _check(
    arguments: list[str], options: dict[str, Any], required: dict[str, str], words: list[str]
) -> None:
    position, words = 0, list(words)
    while position < len(arguments):
        argument = arguments[position]
        name = _spelling(argument)
        if words and not re.match(r"--?[A-Za-z]", argument):
            required.pop(words.pop(0).replace("_", "-"), None)
            position += 1
            continue
        if not re.match(r"--?[A-Za-z]", argument):
            raise InputError(
                f"'{argument}'", "is not an option", "options are --name VALUE; --help lists them"
            )
        if not argument.startswith("--") or name not in options:
            close = difflib.get_close_matches(name, options, n=1, cutoff=0.5) or [
                o for o in options if o.endswith("." + name)
            ]
            raise InputError(
                argument.partition("=")[0],
                "unknown option",
                f"did you mean --{close[0]}?" if close else "--help lists the known ones",
            )
        required.pop(name, None)
        position += 1
        if options[name] is not bool and "=" not in argument:
            if position == len(arguments) or re.match(r"--[A-Za-z]", arguments[position]):
                raise InputError(
                    f"--{name}", f"needs a value, which must be {_spell(options[name])}"
                )
            position += 1
    for name, value in required.items():
        if name.replace("-", "_") in words:
            raise InputError(
                value, "is missing", "give it as a word of its own; --help explains it"
            )
        raise InputError(f"--{name}", "is missing", f"give --{name} {value}; --help explains it")


def _rephrase(box: str, arguments: list[str], options: dict[str, Any]) -> InputError:
    """tyro's boxed error as one line: the option it names, what it must be, what was found."""
    text = " ".join(re.sub(r"[╭╮╰╯│─]+", " ", box).split())
    named = re.search(r"--([A-Za-z][\w.-]*\w)", text)
    if named is None or named[1] not in options:
        return InputError("command line", text)
    name, found = named[1], ""
    for position, argument in enumerate(arguments):
        if argument.startswith("--") and _spelling(argument) == name:
            attached = argument.partition("=")
            found = attached[2] if attached[1] else " ".join(arguments[position + 1 : position + 2])
    return InputError(f"--{name}", f"must be {_spell(options[name])}, found '{found}'")


def _spell(hint: Any) -> str:
    choices = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(map(str, choices))
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return " or ".join(_spell(choice) for choice in choices)
    return {
        float: "a number",
        int: "a whole number",
        str: "text",
        type(None): "None",
        Path: "a path",
    }.get(hint, str(hint))
