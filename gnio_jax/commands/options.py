"""Options of the commands: the fields of a frozen dataclass, with types, bounds and comments like
those of settings in a file.

argparse splits the words of a command line and lays out the help; `config` reads the values.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import itertools
import shlex
import shutil
import sys
import textwrap
import typing
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import config as configuration
from gnio_jax.config.files import kind_of
from gnio_jax.config.schema import FILE_ONLY, Words
from gnio_jax.errors import InputError, did_you_mean

HELP, HELP_VERBOSE = ("-h", "--help"), ("-H", "--help-verbose")
MANY = 24
"""Number of options above which the help explains only those of no section and the `MAIN` ones of
the class; --help-verbose explains all."""
SYNONYMS = {
    **dict.fromkeys(("lr", "rate-of-learning"), "learning-rate"),
    **dict.fromkeys(("bs", "batch", "batchsize"), "batch-size"),
    **dict.fromkeys(("epoch", "num-epochs", "n-epochs", "max-epochs"), "epochs"),
    **dict.fromkeys(("gpu", "gpus", "num-gpus", "device", "cuda"), "devices"),
    **dict.fromkeys(("channels", "hidden-size"), "width"),
    **dict.fromkeys(("weights", "run", "model", "ckpt", "checkpoint-path"), "network"),
    **dict.fromkeys(("arch", "architecture"), "name"),
    **dict.fromkeys(("output", "out-dir", "output-dir", "save-dir"), "out"),
    **dict.fromkeys(("data", "data-dir", "dataroot", "root"), "data-root"),
    **dict.fromkeys(("wd", "l2"), "weight-decay"),
    **dict.fromkeys(("freq", "imu-freq", "frequency", "hz"), "rate"),
    **dict.fromkeys(("unit", "gyro-units"), "gyro-unit"),
    "accel-units": "accel-unit",
    "continue": "resume",
}
"""Names of options in other programs, and ours without the section."""
WIDTH = 100
"""Largest number of columns of a help text."""


class Group(NamedTuple):
    """A program whose first word is the name of a command."""

    help: str
    """A description, and examples after the line "examples:"."""
    commands: dict[str, str | Group]
    """Name -> "module:function" of this room. Only the module of a command that is called is
    imported, so a mistake does not wait for the others."""


class Call(NamedTuple):
    """The call of a command."""

    prog: str
    """`gnio train`, or `python train.py`."""
    argv: Sequence[str]
    """The words after it."""

    def __str__(self) -> str:
        return shlex.join([*self.prog.split(), *self.argv])

    def sibling(self, command: str) -> str:
        """Another command of the same program: `gnio evaluate` of `gnio train`, and
        `python evaluate.py` of `python train.py`."""
        program, _, word = self.prog.rpartition(" ")
        return f"{program} {command}{'.py' if word.endswith('.py') else ''}"


Command = Callable[[Any, Call], None]
"""A function of a dataclass of options and of the call; its docstring is the help."""


class Option(NamedTuple):
    """An option, or a word that is given without a name."""

    name: str
    """`--optim.epochs`; for a word its placeholder, `FILE`."""
    path: tuple[str, ...]
    """Names of its section and its field: `("optim", "epochs")`."""
    section: type
    """The dataclass of its field."""
    hint: Any
    words: Words
    default: Any
    """`dataclasses.MISSING` if it must be given."""

    @property
    def negation(self) -> str:
        """The option that switches off a flag that is on by default; empty for other options."""
        section, dot, field = self.name.removeprefix("--").rpartition(".")
        return f"--{section}{dot}no-{field}" if self.default is True else ""


def run(program: Group | str | Command, call: Call) -> None:
    """Find the command that the words name, read its options and run it. Without a command the help
    is shown. Raises `InputError` for a command that is unknown, and as `read`."""
    while isinstance(program, Group):
        word = call.argv[0] if call.argv else HELP[0]
        if word in HELP:
            print(_overview(program, call.prog))
            return
        if word not in program.commands:
            choices = f"give one of {', '.join(program.commands)}; --help explains them"
            remedy = did_you_mean(word, program.commands).strip() or choices
            raise InputError("command", f"unknown '{word}'", remedy)
        program, call = program.commands[word], Call(f"{call.prog} {word}", call.argv[1:])
    command = function(program) if isinstance(program, str) else program
    command(read(command, call), call)


def function(command: str) -> Command:
    """The function of a command, "module:function"."""
    module, _, name = command.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)


def options_type(command: Command) -> type:
    """The dataclass of the options that a command takes: the type of its first argument."""
    return next(iter(typing.get_type_hints(command, include_extras=True).values()))


def options_of(kind: type, path: tuple[str, ...] = (), prefix: str = "--") -> Iterator[Option]:
    """Every option of a dataclass of options, including those of its sections with their names as
    prefix."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, word = hints[field.name], field.name.replace("_", "-")
        markers = getattr(hint, "__metadata__", ())
        words = next((marker for marker in markers if isinstance(marker, Words)), Words())
        inner, field_path = kind_of(hint), (*path, field.name)
        if FILE_ONLY in markers:
            continue
        if dataclasses.is_dataclass(inner):
            below = f"{prefix}{word}." if words.named else prefix
            yield from options_of(typing.cast(type, inner), field_path, below)
        else:
            name = prefix + word if words.named else words.metavar or word.upper()
            yield Option(name, field_path, kind, hint, words, field.default)


# Reading
# ------------------------------------------------------------------------------------------------


def read(command: Command, call: Call, default: Any = None) -> Any:
    """The options of a command from the words of its call.

    Options that are not given are those of `default`, or the defaults of the class. `-` and `_` in
    names are the same. Raises `InputError` for an option that does not exist (naming the closest
    one), that has no value or one of the wrong type or beyond its bounds, or that is missing.
    `--help` prints the help and exits with status 0: the command's docstring up to its line
    "examples:", the options with the comments of their fields, and last the examples. If there are
    many options, it explains the main ones, and `--help-verbose` all.
    """
    kind = options_type(command)
    options = {".".join(option.path): option for option in options_of(kind)}
    verbose = any(word in HELP_VERBOSE for word in call.argv)
    explained = verbose or any(word in HELP for word in call.argv)
    hidden: set[str] = set()
    if len(options) > MANY and not verbose:
        hidden = {dest for dest in options if "." in dest and dest not in kind.MAIN}
    parser = _parser(command, call.prog, options, explained, hidden)
    if explained:
        print(parser.format_help(), end="")
        raise SystemExit(0)
    names = {name for option in options.values() for name in (option.name, option.negation)}
    try:
        words = [_normalise_word(word, names) for word in call.argv]
        parsed, strays = parser.parse_known_intermixed_args(words)
    except argparse.ArgumentError as error:
        raise InputError(error.argument_name, error.message, "--help explains it") from None
    if strays:
        remedy = "options are --name VALUE; --help lists them"
        raise InputError(f"'{strays[0]}'", "is not an option", remedy)
    values = {} if default is None else dict(vars(default))
    for dest, value in vars(parsed).items():
        option = options[dest]
        if not isinstance(value, bool):
            words = [value] if isinstance(value, str) else value
            value = configuration.parse_words(option.hint, words, option.name)
        name, *inner = option.path
        if inner:
            section = values.get(name, option.section())
            value = dataclasses.replace(section, **{inner[0]: value})
        values[name] = value
    for option in options.values():
        if option.default is dataclasses.MISSING and option.path[0] not in values:
            way = f"{option.name} VALUE" if option.words.named else "it as a word"
            raise InputError(option.name, "is missing", f"give {way}; --help explains it")
    return kind(**values)


def _normalise_word(word: str, names: set[str]) -> str:
    """The word of a command line; the name of an option with `-` for `_`."""
    name, equals, value = word.partition("=")
    is_name = name.startswith("-") and name.strip("-.0123456789eE") and " " not in name
    if not is_name:
        return word
    spelled = name.replace("_", "-")
    if spelled not in names:
        inner = {option_name.lstrip("-").rpartition(".")[2]: option_name for option_name in names}
        word = spelled.lstrip("-")
        if (meant := inner.get(SYNONYMS.get(word, word))) is not None:
            hint = f"did you mean '{meant}'?"
        else:
            hint = did_you_mean(spelled, names, cutoff=0.5) or did_you_mean(word, inner, inner.get)
        raise InputError(name, "unknown option", hint.strip() or "--help lists the known ones")
    return f"{spelled}{equals}{value}"


def _parser(
    command: Command, prog: str, options: dict[str, Option], explained: bool, hidden: set[str]
) -> argparse.ArgumentParser:
    """The parser that splits the words of these options and writes their help, if it is to be
    `explained`, without the `hidden` options."""
    words_of_help = {"configs": ", ".join(configuration.experiment_names())}
    words_of_help |= getattr(options_type(command), "WORDS_OF_HELP", {})
    text = (inspect.getdoc(command) or "").format(prog=prog, **words_of_help)
    description, _, examples = text.partition("\nexamples:\n")
    width = min(WIDTH, shutil.get_terminal_size().columns)
    words = (option for option in options.values() if not option.words.named)
    usage = (
        option.name if option.default is dataclasses.MISSING else f"[{option.name}]"
        for option in words
    )

    def paragraphs(text: str) -> str:
        return "\n\n".join(
            paragraph  # a list
            if paragraph.startswith("  ")
            else textwrap.fill(" ".join(paragraph.split()), width - 2, break_on_hyphens=False)
            for paragraph in text.strip().split("\n\n")
        )

    names = dict.fromkeys(dest.partition(".")[0] for dest in options if dest in hidden)
    more = f"{prog} -H explains {len(hidden)} more options of {', '.join(names)}."
    more = f"{paragraphs(more)}\n\n" if hidden else ""
    parser = argparse.ArgumentParser(
        prog=prog,
        usage=" ".join([prog, *usage, "[OPTIONS]"]),
        description=paragraphs(description),
        epilog=more + f"examples:\n{examples}",
        formatter_class=partial(
            argparse.RawDescriptionHelpFormatter,
            width=width,
            max_help_position=28,
        ),
        argument_default=argparse.SUPPRESS,
        allow_abbrev=False,
        exit_on_error=False,
    )
    if hidden:
        parser.add_argument(*HELP_VERBOSE, action="help", help="explain all options and exit")
    sections: dict[str, Any] = {}
    for dest, option in options.items():
        name, *inner = option.path
        if inner and name not in sections:
            description = None if hidden else paragraphs(option.section.__doc__ or "")
            sections[name] = parser.add_argument_group(f"{name} options", description)
        _add(sections[name] if inner else parser, option, dest, explained, dest in hidden)
    return parser


def _add(group: Any, option: Option, dest: str, explained: bool, hidden: bool) -> None:
    """Add an option to the group of its section."""
    kind = kind_of(option.hint)
    items = typing.get_args(kind) if typing.get_origin(kind) is tuple else ()
    item = kind_of(items[0]) if items else kind
    text = comment(option) if explained and not hidden else ""
    if option.negation:
        text += f" (on by default; {option.negation} switches it off)"
        group.add_argument(option.negation, action="store_false", dest=dest, help=argparse.SUPPRESS)
    elif option.default is dataclasses.MISSING:
        text += " (required)"
    elif not any(option.default is nothing for nothing in (None, False, ())):
        default_words = option.default if isinstance(option.default, tuple) else (option.default,)
        text += f" (default: {' '.join(map(str, default_words))})"
    text = argparse.SUPPRESS if hidden else text.strip().replace("%", "%%")
    if kind is bool:
        group.add_argument(option.name, action="store_true", dest=dest, help=text)
        return
    choices = ",".join(map(str, typing.get_args(item)))
    placeholder = (
        f"{{{choices}}}"
        if choices
        else {int: "INT", float: "FLOAT", Path: "PATH"}.get(item, "TEXT")
    )
    settings = {
        "help": text,
        "metavar": option.words.metavar or placeholder,
    }
    if not option.words.named:
        group.add_argument(dest, nargs="*" if items else "?", **settings | {"metavar": option.name})
    elif option.words.repeated:
        group.add_argument(option.name, dest=dest, action="append", **settings)
    else:
        nargs = None if not items else "+" if ... in items else len(items)
        group.add_argument(option.name, dest=dest, nargs=nargs, **settings)


# Help
# ------------------------------------------------------------------------------------------------


def comment(option: Option) -> str:
    """The string below the field of an option, as one paragraph."""
    classes = (
        _comments(ancestor.__module__).get(ancestor.__name__, {})
        for ancestor in option.section.__mro__
    )
    return next(comments[option.path[-1]] for comments in classes if option.path[-1] in comments)


@cache
def _comments(module: str) -> dict[str, dict[str, str]]:
    """The string below each field, for each class of a module."""
    if module == "builtins":
        return {}
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {
        statement.name: {
            ast.unparse(field.target): " ".join(ast.literal_eval(after.value).split())
            for field, after in itertools.pairwise(statement.body)
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr)
        }
        for statement in tree.body
        if isinstance(statement, ast.ClassDef)
    }


def _overview(group: Group, prog: str) -> str:
    """The help of a group, with the first line of the help of each command."""
    description, _, examples = group.help.format(prog=prog).partition("\nexamples:\n")
    lines = []
    for name, command in group.commands.items():
        is_group = isinstance(command, Group)
        text = command.help if is_group else inspect.getdoc(function(command)) or ""
        indents = {"initial_indent": f"  {name:<11}", "subsequent_indent": " " * 13}
        lines.append(textwrap.fill(text.partition("\n")[0], WIDTH, **indents))
    return "\n".join(
        [
            f"{description}\nusage: {prog} COMMAND [OPTIONS]\n",
            *lines,
            f"\nexamples:\n{examples}",
            f"\n{prog} COMMAND --help explains a command, with examples at its end.",
        ]
    )


def completion(group: Group, prog: str) -> str:
    """A script with which bash completes the commands and options of a program, and values as
    files."""

    def cases(group: Group, words: str) -> Iterator[str]:
        for name, command in group.commands.items():
            if isinstance(command, Group):
                yield from cases(command, f"{words}{name} ")
                names = " ".join(command.commands)
            else:
                options = options_of(options_type(function(command)))
                spellings = (
                    spelling for option in options for spelling in (option.name, option.negation)
                )
                names = " ".join(spelling for spelling in spellings if spelling.startswith("--"))
            yield f'        "{words}{name} "*) names="{names}" ;;'

    commands = " ".join(group.commands)
    return "\n".join(
        [
            f"_{prog}() {{",
            "    local names",
            '    case "${COMP_WORDS[1]} ${COMP_WORDS[2]} " in',
            *cases(group, ""),
            f'        *) names="{commands}" ;;',
            "    esac",
            '    COMPREPLY=($(compgen -W "$names" -- "${COMP_WORDS[COMP_CWORD]}"))',
            "}",
            f"complete -o default -F _{prog} {prog}",
        ]
    )
