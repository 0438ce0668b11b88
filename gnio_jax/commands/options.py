"""Typed options and subcommands: tyro reads them from dataclasses, and each mistake is one line.

tyro shows a mistake as a box of several lines. Its parse-error hook hands out the mistake itself,
which becomes an `InputError` here that names the option and the remedy. The hook is not a public
part of tyro: where a version lacks it, tyro's own box is shown.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import shlex
import sys
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union

import tyro

from gnio_jax.commands import short_help
from gnio_jax.errors import InputError

try:
    from tyro._errors import on_parse_error
except ImportError:
    on_parse_error = None

Options = TypeVar("Options")

_SPELLING = {
    float: "a number",
    int: "a whole number",
    str: "text",
    type(None): "None",
    Path: "a path",
}


class Command(NamedTuple):
    """A program, or a subcommand of one: typed options in, one call."""

    options: type
    """Dataclass of the options; the comments of its fields are their help."""
    run: Callable[[Any, str], None]
    """Takes the options and the name by which the program was called."""
    description: str
    """Help: a first line that says what it does, then examples. `{prog}` is the program's name."""
    defaults: Callable[[Any], Any] | None = None
    """Reads the file that some of the options name: the defaults of all (None: the class's own)."""
    common: tuple[str, ...] = ()
    """Options that --help explains where they are too many for a screen; () for all of them."""


class Group(NamedTuple):
    """A program whose first word is a subcommand."""

    commands: dict[str, Any]
    """`Command` or `Group` by name."""
    description: str


def execute(program: Command | Group, argv: Sequence[str] | None = None, prog: str = "") -> None:
    """Read the options from `argv` (default: the process's own arguments) and run the command.

    Raises `InputError` as `parse`, and for a subcommand that is unknown or missing.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    prog = prog or Path(sys.argv[0]).name
    words = _subcommands(program, argv)
    found: Any = program
    for word in words:
        found = found.commands[word]
    argv = _show_short_help(found, argv, " ".join([prog, *words]))
    known = option_names(found.options) if isinstance(found, Command) else list(found.commands)
    with _one_line_errors(argv[len(words) :], known, isinstance(found, Group)):
        options = _read(program, argv, prog, words)
        start = found.defaults and found.defaults(options)
        if start is not None:
            options = _read(program, argv, prog, words, start)
    found.run(options, " ".join([prog, *words]))


def _show_short_help(program: Command | Group, argv: list[str], prog: str) -> list[str]:
    """Print the help that fits a screen, where that is asked for, and leave; --help-all becomes
    what tyro knows as --help."""
    if isinstance(program, Command) and program.common:
        if any(word in short_help.SHORT for word in argv):
            description = program.description.format(prog=prog)
            known = option_names(program.options)
            text = short_help.short_help(program.options, description, prog, program.common, known)
            if text is not None:
                print(text)
                raise SystemExit(0)
    return ["--help" if word in short_help.WHOLE else word for word in argv]


def parse(
    kind: type[Options],
    default: Options | None = None,
    description: str = "",
    argv: Sequence[str] | None = None,
    prog: str | None = None,
) -> Options:
    """Read a value of the dataclass `kind` from `argv` (default: the process's own arguments).

    Nested fields are dotted (`--optim.epochs 3`), words are joined by `-` or `_`, a flag's negation
    is `--no-flag`; fields of type `tyro.conf.Positional[...]` are given without a name. Options
    win over `default`, which wins over the class's own defaults. `--help` prints the options with
    their meaning and leaves with status 0. Raises `InputError` for an option that does not exist
    (naming the closest that does), lacks its value, has one of the wrong type, or is missing.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    start = tyro.MISSING_NONPROP if default is None else default
    with _one_line_errors(argv, option_names(kind), subcommands=False):
        return tyro.cli(kind, default=start, description=description, args=argv, prog=prog)


def _subcommands(program: Command | Group, argv: list[str]) -> list[str]:
    """The words of `argv` that are subcommands, from the first one on."""
    words = []
    for word in argv:
        if isinstance(program, Command) or word not in program.commands:
            break
        words.append(word)
        program = program.commands[word]
    return words


def _read(
    program: Command | Group, argv: list[str], prog: str, words: list[str], default: Any = None
) -> Any:
    """The options of a program as tyro reads them."""
    description = program.description.format(prog=prog)
    if isinstance(program, Group):
        kind = _union(program, prog, words, default)
        return tyro.cli(kind, description=description, args=argv, prog=prog)
    start = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(program.options, default=start, description=description, args=argv, prog=prog)


def _union(group: Group, prog: str, words: list[str], default: Any) -> Any:
    """tyro's type of a group: a union of its subcommands' options.

    The subcommand in `words` has its whole description and `default`, the others have their first
    line, for the list in the group's own help.
    """
    members = []
    for name, command in group.commands.items():
        chosen = words[:1] == [name]
        description = command.description.format(prog=f"{prog} {name}")
        description = description if chosen else description.partition("\n")[0]
        if isinstance(command, Group):
            inner = _union(command, f"{prog} {name}", words[1:] if chosen else [], default)
            settings = tyro.conf.subcommand(
                name, description=description, constructor_factory=lambda inner=inner: inner
            )
            members.append(Annotated[Any, settings])
        else:
            start = default if chosen and default is not None else tyro.MISSING_NONPROP
            settings = tyro.conf.subcommand(name, default=start, description=description)
            members.append(Annotated[command.options, settings])
    return Union[tuple(members)]  # noqa: UP007


def sibling(prog: str, command: str) -> str:
    """How `train` or `evaluate` is called by a person who called `prog`."""
    return f"gnio {command}" if prog.split()[0] == "gnio" else f"python {command}.py"


def called(prog: str) -> str:
    """How the process was called, as one could type it; `prog` is the command's name."""
    words, given = prog.split(), sys.argv[1:]
    own = words[1:] if words[0] == "gnio" else []
    return shlex.join([*words, *(given[len(own) :] if given[: len(own)] == own else given)])


def option_names(kind: Any, prefix: str = "") -> list[str]:
    """Every option of the dataclass `kind` as tyro spells it: ["--optim.batch-size", ...]."""
    names = []
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        if _is_positional(hint):
            continue
        word = name.replace("_", "-")
        if dataclasses.is_dataclass(hint):
            names += option_names(hint, f"{prefix}{word}.")
        else:
            names.append(f"--{prefix}{word}")
            if hint is bool:
                names.append(f"--{prefix}no-{word}")
    return names


def _is_positional(hint: Any) -> bool:
    marker = typing.get_args(tyro.conf.Positional[str])[1]
    return marker in typing.get_args(hint)[1:]


@contextlib.contextmanager
def _one_line_errors(argv: list[str], known: list[str], subcommands: bool) -> Iterator[None]:
    """Raise tyro's parse errors as `InputError`; `known` are the options, or the subcommands."""

    def hook(event: Any) -> None:
        error = _explain(event, argv, known, subcommands)
        if error is not None:
            raise error

    with contextlib.nullcontext() if on_parse_error is None else on_parse_error(hook):
        yield


def _explain(event: Any, argv: list[str], known: list[str], subcommands: bool) -> InputError | None:
    """The `InputError` of a parse-error event; None for events of a kind that is not known here."""
    if subcommands:
        return _wrong_subcommand(argv, known)
    for token in argv:
        option = _spelling(token)
        if option.startswith("--") and option not in known:
            return _unknown_option(token, known)
    match type(event).__name__:
        case "UnrecognizedArgs":
            return _unknown_option(event.tokens[0], known)
        case "MissingArgs":
            return _missing_option(event.missing_arguments[0].arg)
        case "BadValue":
            problem = f"needs a value, which must be {_spell(event.argument.field.type)}"
            return InputError(_label(event.argument), problem)
        case "InvalidChoice":
            return _wrong_value(event.argument, event.value)
        case "InstantiationFailure" if event.argument is not None:
            return _wrong_value(event.argument, _value_given(event.argument, argv))
        case "InstantiationFailure":
            return InputError("command line", event.message)
    return None


def _wrong_subcommand(argv: list[str], known: list[str]) -> InputError:
    given = next((word for word in argv if word not in known), None)
    remedy = f"give one of {', '.join(known)}; --help explains them"
    if given is None:
        return InputError("command", "is missing", remedy)
    close = difflib.get_close_matches(given, known, n=1)
    hint = f"did you mean '{close[0]}'?" if close else remedy
    return InputError("command", f"unknown '{given}'", hint)


def _unknown_option(token: str, known: list[str]) -> InputError:
    if not token.startswith("-"):
        remedy = "options are --name VALUE; --help lists them"
        return InputError(f"'{token}'", "is not an option", remedy)
    option = _spelling(token)
    close = difflib.get_close_matches(option, known, n=1, cutoff=0.5)
    close = close or [name for name in known if name.endswith("." + option.lstrip("-"))]
    remedy = f"did you mean {close[0]}?" if close else "--help lists the known ones"
    return InputError(token.partition("=")[0], "unknown option", remedy)


def _missing_option(argument: Any) -> InputError:
    label = _label(argument)
    if argument.is_positional():
        remedy = "give it as a word of its own; --help explains it"
        return InputError(label, "is missing", remedy)
    value = argument.field.intern_name.upper()
    return InputError(label, "is missing", f"give {label} {value}; --help explains it")


def _wrong_value(argument: Any, value: str) -> InputError:
    problem = f"must be {_spell(argument.field.type)}, found '{value}'"
    return InputError(_label(argument), problem)


def _label(argument: Any) -> str:
    """What help calls an option: `--optim.epochs`, or the word in its place."""
    return argument.lowered.metavar if argument.is_positional() else argument.display_name()


def _value_given(argument: Any, argv: list[str]) -> str:
    """The last value that was given for an option."""
    value = ""
    for token, following in zip(argv, [*argv[1:], ""], strict=True):
        if _spelling(token) == argument.display_name():
            value = token.partition("=")[2] if "=" in token else following
    return value


def _spelling(token: str) -> str:
    """`--optim.batch_size=3` -> `--optim.batch-size`."""
    return token.partition("=")[0].replace("_", "-")


def _spell(hint: Any) -> str:
    """A type in words."""
    members = typing.get_args(hint)
    if typing.get_origin(hint) is Annotated:
        return _spell(members[0])
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(map(str, members))
    if typing.get_origin(hint) is tuple:
        return f"words out of {_spell(members[0]).removeprefix('one of ')}"
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is Union:
        return " or ".join(_spell(member) for member in members)
    return _SPELLING.get(hint, str(hint))
