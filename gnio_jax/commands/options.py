"""Options of the commands: tyro reads them from dataclasses, and each mistake is one line.

tyro shows a mistake as a box of several lines, so names and values are checked before it sees them.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import itertools
import math
import shlex
import shutil
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from gnio_jax import config as configuration
from gnio_jax.errors import InputError, did_you_mean

HELP, HELP_VERBOSE = ("-h", "--help"), ("-H", "--help-verbose")
COMPLETION = "--tyro-"
"""What tyro's options for the completion of a shell begin with."""
MANY = 24
"""Options of which the help lists names and defaults alone; --help-verbose explains them."""
WIDTH = 100
"""Columns of a help text, where the terminal is not narrower."""


class Group(NamedTuple):
    """A program whose first word is the name of a command."""

    help: str
    """What it is, and behind the line "examples:" some."""
    commands: dict[str, str | Group]
    """Name -> "module:function" of this room. Only the module of a command that is called is
    imported, so a mistake does not wait for the others."""


class Call(NamedTuple):
    """How a command was called."""

    prog: str
    """`gnio train`, or `python train.py`."""
    argv: Sequence[str]
    """The words behind it."""

    def __str__(self) -> str:
        return shlex.join([*self.prog.split(), *self.argv])


Command = Callable[[Any, Call], None]
"""A function of `asked`, a dataclass of options, and of its call; its docstring is its help."""


class Option(NamedTuple):
    """An option, or a word that is given without a name."""

    name: str
    """`--optim.epochs`; of a word what stands for it, `FILE`."""
    hint: Any
    """Type of its value; bool for a flag, which has none."""
    words: int | None
    """How many words make its value; None: all that follow."""
    required: bool


def run(program: Group | str | Command, call: Call) -> None:
    """Find the command that the words name, read its options and run it. Raises `InputError` for a
    command that is unknown or missing, and as `read`."""
    while isinstance(program, Group):
        word = call.argv[0] if call.argv else ""
        if word in HELP:
            print(_overview(program, call.prog))
            return
        if word.startswith(COMPLETION):
            tyro.cli(_union(program), args=call.argv, prog=call.prog, registry=REGISTRY)
        if word not in program.commands:
            known = f"give one of {', '.join(program.commands)}; --help explains them"
            remedy = did_you_mean(word, program.commands).strip() or known
            raise InputError("command", f"unknown '{word}'" if word else "is missing", remedy)
        program, call = program.commands[word], Call(f"{call.prog} {word}", call.argv[1:])
    command = function(program) if isinstance(program, str) else program
    command(read(command, call), call)


def _overview(group: Group, prog: str) -> str:
    """The help of a group: what each command does, in the first line of its own help."""
    about, _, examples = group.help.format(prog=prog).partition("\nexamples:\n")
    lines = []
    for name, command in group.commands.items():
        is_group = isinstance(command, Group)
        text = command.help if is_group else inspect.getdoc(function(command)) or ""
        lines.append(f"  {name:<11}{text.partition(chr(10))[0]}")
    return "\n".join(
        [
            f"{about}\nusage: {prog} COMMAND [OPTIONS]\n",
            *lines,
            f"\nexamples:\n{examples}",
            f"\n{prog} COMMAND --help explains a command, with examples at its end.",
        ]
    )


def _union(group: Group) -> Any:
    """tyro's type of a group, for the completion of a shell: the options of every command."""
    members = []
    for name, command in group.commands.items():
        if isinstance(command, Group):
            inner = tyro.conf.subcommand(name, constructor_factory=partial(_union, command))
            members.append(Annotated[Any, inner])
        else:
            members.append(Annotated[options_type(function(command)), tyro.conf.subcommand(name)])
    return Union[tuple(members)]  # noqa: UP007


def function(command: str) -> Command:
    """The function of a command, "module:function"."""
    module, _, name = command.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), name)


def options_type(command: Command) -> type:
    """The dataclass of the options that a command takes."""
    return typing.get_type_hints(command, include_extras=True)["asked"]


def read(command: Command, call: Call, default: Any = None) -> Any:
    """The options of a command from the words of its call.

    Nested fields are dotted (`--optim.epochs 3`), words are joined by `-` or `_`, a flag's negation
    is `--no-flag`; fields of type `tyro.conf.Positional[...]` are given without a name. Options win
    over `default`, which wins over the class's own defaults. Raises `InputError` for an option that
    does not exist (naming the closest that does), lacks its value, has one of the wrong type, or is
    missing. `--help` shows the command's docstring as far as its line "examples:", then the options
    with the comments of their fields, last the examples, and leaves with status 0; of many options
    it lists names and defaults, and `--help-verbose` explains them.
    """
    kind = options_type(command)
    brief = len(list(options_of(kind))) > MANY and not any(
        word in HELP_VERBOSE for word in call.argv
    )
    ask = partial(
        tyro.cli,
        kind,
        default=tyro.MISSING_NONPROP if default is None else default,
        prog=call.prog,
        description="",
        registry=REGISTRY,
        compact_help=brief,
        config=(tyro.conf.PositionalMetavarFromFieldName,),
    )
    if not any(word in HELP + HELP_VERBOSE for word in call.argv):
        check(kind, call.argv)
        return ask(args=call.argv)
    configs = ", ".join(configuration.names())
    text = (inspect.getdoc(command) or "").format(prog=call.prog, configs=configs)
    about, _, examples = text.partition("\nexamples:\n")
    width = min(WIDTH, shutil.get_terminal_size().columns)
    for paragraph in about.strip().split("\n\n"):
        paragraph = " ".join(paragraph.split())
        print(textwrap.fill(paragraph, width, break_on_hyphens=False), end="\n\n")
    try:
        return ask(args=["--help"])
    finally:
        more = f"{call.prog} -H explains the options.\n" if brief else ""
        print(f"{more}\nexamples:\n{examples}")


def check(kind: type, argv: Sequence[str]) -> None:
    """Raise `InputError` for the first mistake in the words of a command line."""
    known = {option.name: option for option in options_of(kind)}
    places = [option for name, option in known.items() if not name.startswith("-")]
    missing = [name for name, option in known.items() if option.required]
    rest = list(argv)
    while rest:
        token = rest.pop(0)
        if _is_value(token):
            if not places:
                remedy = "options are --name VALUE; --help lists them"
                raise InputError(f"'{token}'", "is not an option", remedy)
            option, words = places.pop(0), [token]
        else:
            name, equals, value = token.partition("=")
            option, words = _find(name, known), [value] if equals else []
        while rest and _is_value(rest[0]) and (option.words is None or len(words) < option.words):
            words.append(rest.pop(0))
        if option.hint is not bool:
            configuration.value_from_words(option.hint, words, option.name)
        elif words:
            raise InputError(option.name, f"takes no value, found '{words[0]}'")
        if option.name in missing:
            missing.remove(option.name)
    for name in missing:
        given = f"give {name} {name[2:].upper()}" if name[0] == "-" else "give it as a word"
        raise InputError(name, "is missing", f"{given}; --help explains it")


def _find(name: str, known: dict[str, Option]) -> Option:
    """The option of this name. `-` and `_` are the same."""
    spelled = name.replace("_", "-")
    if spelled not in known:
        inner = {each.rpartition(".")[2]: each for each in known if "." in each}
        hint = did_you_mean(spelled, known, cutoff=0.5) or did_you_mean(
            spelled.lstrip("-"), inner, inner.get
        )
        raise InputError(name, "unknown option", hint.strip() or "--help lists the known ones")
    return known[spelled]


def _is_value(word: str) -> bool:
    """Whether a word is no option: `-` and negative numbers are none."""
    try:
        return not word.startswith("-") or word == "-" or not math.isnan(float(word))
    except ValueError:
        return False


def options_of(kind: type, prefix: str = "") -> Iterator[Option]:
    """Every option of a dataclass as tyro spells it; a flag that can be negated is two of them."""
    for field, hint, markers in _fields(kind):
        word = field.name.replace("_", "-")
        name, required = f"--{prefix}{word}", _default(field) is tyro.MISSING_NONPROP
        if tyro.conf.Suppress in markers:
            continue
        if Path in (hint, *typing.get_args(hint)):
            hint = str
        if dataclasses.is_dataclass(hint):
            inner = prefix if tyro.conf.OmitArgPrefixes in markers else f"{prefix}{word}."
            yield from options_of(typing.cast(type, hint), inner)
        elif tyro.conf.Positional in markers:
            named = (each.metavar for each in markers if getattr(each, "metavar", None))
            yield Option(next(named, word.upper()), hint, _words(hint), required)
        elif tyro.conf.UseAppendAction in markers:
            yield Option(name, typing.get_args(hint)[0], 1, required)
        else:
            yield Option(name, hint, _words(hint), required)
            if hint is bool and tyro.conf.FlagCreatePairsOff not in markers:
                yield Option(f"--{prefix}no-{word}", hint, 0, required)


def _fields(kind: type) -> Iterator[tuple[dataclasses.Field, Any, tuple[Any, ...]]]:
    """Each field of a dataclass, its type, and tyro's markers of it."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, markers = hints[field.name], ()
        if typing.get_origin(hint) is Annotated:
            hint, *markers = typing.get_args(hint)
        if configuration.FILE_ONLY in markers:
            markers = (tyro.conf.Suppress, tyro.conf.Fixed)
        yield field, hint, tuple(markers)


def _words(hint: Any) -> int | None:
    """How many words make a value of this type."""
    for member in (hint, *typing.get_args(hint)):
        if typing.get_origin(member) is tuple:
            items = typing.get_args(member)
            return None if Ellipsis in items else len(items)
    return 0 if hint is bool else 1


def _default(field: dataclasses.Field, values: Any = None) -> Any:
    """The value of a field in `values`, or else its default."""
    if dataclasses.is_dataclass(values):
        return getattr(values, field.name)
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return tyro.MISSING_NONPROP if field.default is dataclasses.MISSING else field.default


REGISTRY = ConstructorRegistry()
"""How tyro reads values and dataclasses: as it does itself, but for null and for the help."""


@REGISTRY.struct_rule
def _as_it_reads_well(found: StructTypeInfo) -> StructConstructorSpec | None:
    """A comment is one paragraph, and defaults are shown that say something."""
    if not dataclasses.is_dataclass(found.type) or found.type.__module__.startswith("tyro."):
        return None
    comments, shown = _comments(found.type), tyro.conf.arg(help_behavior_hint=_shown)
    fields = [
        StructFieldSpec(
            field.name,
            Annotated[hint, shown, *markers],  # type: ignore
            _default(field, found.default),
            comments.get(field.name, ""),
        )
        for field, hint, markers in _fields(found.type)
    ]
    return StructConstructorSpec(found.type, tuple(fields))


@REGISTRY.primitive_rule
def _value_or_null(found: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """A value that may be missing is null on the command line as in a file; the help shows the
    type of the value alone."""
    kinds = typing.get_args(found.type)
    if found.type_origin not in (types.UnionType, typing.Union) or type(None) not in kinds:
        return None
    value = Union[tuple(kind for kind in kinds if kind is not type(None))]  # noqa: UP007
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(value, found.markers))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        return None
    return dataclasses.replace(
        spec,
        instance_from_str=lambda words: (
            spec.instance_from_str(words) if words != ["null"] else None
        ),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
        choices=None,  # or null would be none of them
    )


def _shown(default: str) -> str:
    """A default in the help, as far as the option or its text does not tell it."""
    return {"None": "", "": "", "False": "", "True": "(on by default)"}.get(
        default, f"(default: {default})"
    )


@cache
def _comments(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass and of its bases."""
    found = {}
    for base in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        for field, after in itertools.pairwise(typing.cast(ast.ClassDef, definition).body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[ast.unparse(field.target)] = " ".join(ast.literal_eval(after.value).split())
    return found
