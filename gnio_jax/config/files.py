"""Settings in files and on the command line: strict YAML, the checks of values, and the places of
runs and of the experiments that come with the package."""

from __future__ import annotations

import dataclasses
import re
import reprlib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import yaml
from yaml.composer import ComposerError
from yaml.constructor import ConstructorError

from gnio_jax.config.schema import (
    Bound,
    Entries,
    Location,
    TrainConfig,
)
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.files import write_text

Section = TypeVar("Section")

_SPELLING = {
    Any: "a number",
    float: "a number",
    int: "a whole number",
    str: "text",
    Path: "text",
    bool: "true or false",
    type(None): "null",
}

# The experiments and the runs
# ------------------------------------------------------------------------------------------------


def experiment_names() -> list[str]:
    """Names of the experiments that come with the package, such as quickstart, baselines/tlio."""
    return list(_package_files())


def find_experiment(config: str | Path) -> Path:
    """The file of `config`: a path, the folder of a run, or a name of `experiment_names()`.

    Raises `InputError` that suggests the closest name if it is none of these.
    """
    path, packaged = Path(config), _package_files()
    if path.is_file():
        return path
    if str(config) in packaged:
        return packaged[str(config)]
    if path.exists():  # a pipe is read; a folder without a run is refused later
        return path / "config.yaml" if (path / "config.yaml").is_file() else path
    by_stem = {Path(name).stem: name for name in packaged}
    choices = f"give a file, or one of the package's own: {', '.join(packaged)}"
    hint = did_you_mean(path.stem, by_stem, by_stem.get)
    raise InputError(config, "no such config file", hint + choices)


def _package_files() -> dict[str, Path]:
    """Files of the package's experiments by name: beside the modules of an installed package, or at
    the top of a checkout."""
    package = Path(__file__).parents[1]
    folders = (package / "configs", package.parent / "configs")
    folder = next((folder for folder in folders if folder.is_dir()), folders[0])
    files = sorted(folder.rglob("*.yaml"))
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}


def default_workdir(config: TrainConfig) -> Path:
    """The folder of a run: its `workdir`, else runs/<dataset>_<model>."""
    return Path(config.workdir or f"runs/{'_'.join(config.datasets)}_{config.model.name}")


def with_seeds(config: TrainConfig, seeds: Sequence[int]) -> list[TrainConfig]:
    """The experiment with each of these seeds: ordinary runs, in the work folders WORKDIR_s0,
    WORKDIR_s1, ... Raises `InputError` if there is no seed, or if one is named twice."""
    if not seeds:
        raise InputError("--seeds", "names no seed", "give some, e.g. 0 1 2")
    twice = [seed for seed in seeds if seeds.count(seed) > 1]
    if twice:
        raise InputError("--seeds", f"names {twice[0]} twice", "each seed is one run")
    folder = default_workdir(config)
    return [dataclasses.replace(config, seed=seed, workdir=f"{folder}_s{seed}") for seed in seeds]


def without_paths(config: TrainConfig) -> TrainConfig:
    """The experiment without the paths of its folders and of the runs that it begins with: a
    resumed run may have other paths, and a package has none."""
    windows = dataclasses.replace(config.data, poses_by=None)
    nowhere: dict[str, Any] = {"workdir": None, "data_root": None, "init_from": None}
    return dataclasses.replace(config, data=windows, **nowhere)


# Reading
# ------------------------------------------------------------------------------------------------


def read(path: str | Path) -> str:
    """The text of a file of settings. A pipe can be read only once. Raises `InputError`."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})") from None


def load(path: str | Path, base: TrainConfig | None = None) -> TrainConfig:
    """Read a `TrainConfig` from a YAML file, or from the experiment of that name. Settings that it
    leaves out are those of `base`, or the defaults.

    Raises `InputError` on a missing or empty file, an unknown key or a wrong type.
    """
    path = find_experiment(path)
    return parse(read(path), str(path), base)


def parse(content: str, source: str, base: TrainConfig | None = None) -> TrainConfig:
    """`load` of a file's text; `source` names the file in errors."""
    fields = parse_yaml(content, source)
    if fields is None:
        raise InputError(source, "is empty", "write settings into it, e.g. seed: 0")
    return _read_section(base or TrainConfig(), fields, Location(source))


def assign(config: Section, assignments: Sequence[str]) -> Section:
    """`config` with settings of the form section.field=value, such as
    "filter.noise.gyro_density=1e-3", each checked as in a file. The last one of a field wins.

    Raises `InputError` that names the assignment.
    """
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not (equals and name):
            remedy = "write section.field=value, e.g. optim.epochs=3"
            raise InputError(f"'{assignment}'", "is not a setting", remedy)
        content = parse_yaml(text, assignment)
        for part in reversed(name.strip().split(".")):
            content = {part: content}
        config = _read_section(config, content, Location(assignment))
    return config


def parse_words(hint: Any, words: Sequence[str], name: str) -> Any:
    """The value of a field of the type `hint` from the words after the option `name` on a command
    line: one word, or as many as a tuple has values. Texts are the words themselves, numbers are
    read as in YAML, and null is None.

    Raises `InputError` that names the option.
    """
    kinds, kind = kinds_of(hint), kind_of(hint)
    if list(words) == ["null"] and type(None) in kinds:
        return None
    several = typing.get_origin(kind) is tuple
    item = kind_of(typing.get_args(kind)[0]) if several else kind
    is_text = item in (str, Path) or any(
        isinstance(choice, str) for choice in typing.get_args(item)
    )
    content = [word if is_text else parse_yaml(word, name) for word in words]
    one = len(content) == 1 and item in kinds
    return check_value(hint, content[0] if one else content, Location(name))


def _read_section(base: Any, content: Any, location: Location) -> Any:
    """The section `base` with the fields of a mapping."""
    if not isinstance(content, dict):
        problem = f"{location.field or 'the file'} must be a mapping of fields"
        raise InputError(location.source, f"{problem}, found {_show(content)}")
    hints = typing.get_type_hints(type(base), include_extras=True)
    for key in content:
        if key not in hints:
            hint = did_you_mean(str(key), hints, lambda name: location.child(name).field)
            name = location.child(_show(key).strip("'")).field
            choices = f"known fields: {', '.join(hints)}"
            raise InputError(location.source, f"unknown field '{name}'", hint.strip() or choices)
    fields = {
        key: check_value(hints[key], value, location.child(key), getattr(base, key))
        for key, value in content.items()
    }
    if isinstance(base, tuple):
        return base._replace(**fields)  # type: ignore
    return dataclasses.replace(base, **fields)


def check_value(hint: Any, content: Any, location: Location, base: Any = None) -> Any:
    """The value of a field of the type `hint`, if it has this type and is within its bounds. A
    section takes fields that are not in `content` from `base`. Raises `InputError`."""
    kinds, is_list = kinds_of(hint), isinstance(content, list | tuple)
    if content is None and type(None) in kinds:
        return None
    fitting = (kind for kind in kinds if (typing.get_origin(kind) is tuple) == is_list)
    kind = type(content) if type(content) in kinds else next(fitting, kinds[0])
    origin, members = typing.get_origin(kind), typing.get_args(kind)
    if is_section(kind):
        return _read_section(kind() if base is None else base, content, location)
    if origin is Mapping:
        return _read_mapping(members[1], content, location, base or {})
    if origin is tuple and isinstance(content, list | tuple):
        if ... not in members and len(content) != len(members):
            location.refuse(f"must be a list of {len(members)} values, found {_show(content)}")
        value = tuple(check_value(members[0], item, location) for item in content)
    elif kind in (float, Any) and type(content) in (int, float):
        try:
            value = float(content)
        except OverflowError:
            location.refuse("is larger than any number of floating point")
    elif kind is Path and isinstance(content, str):
        value = Path(content)
    elif type(content) is kind or any(content == m and type(content) is type(m) for m in members):
        value = content
    else:
        remedy = did_you_mean(str(content), map(str, members)) if origin is Literal else ""
        problem = f"must be {' or '.join(map(_spell, kinds))}, found {_show(content)}"
        location.refuse(problem, remedy.strip())
    _check_bounds(hint, value, location)
    return value


def _read_mapping(hint: Any, content: Any, location: Location, base: Mapping) -> Entries:
    """The mapping `base` with the entries of another one, whose values have the type `hint`. An
    entry that is null is removed."""
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        location.refuse(f"must be a mapping of names, found {_show(content)}")
    entries = dict(base)
    for key, value in content.items():
        entries[key] = check_value(hint, value, location.child(key), entries.get(key))
        if entries[key] is None:
            del entries[key]
    return Entries(entries)


def _check_bounds(hint: Any, value: Any, location: Location) -> None:
    for bound in bounds(hint):
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not bound.holds(number):
                location.refuse(f"{bound.problem}, found {_show(value)}")


def _show(value: Any) -> str:
    """A value as text for a message, shortened if it is long or deeply nested."""
    if isinstance(value, tuple | Path):
        value = list(value) if isinstance(value, tuple) else str(value)
    return "null" if value is None else reprlib.repr(value)


def _spell(kind: Any) -> str:
    """A type in words."""
    origin, members = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return "a list"
    return f"one of {', '.join(map(str, members))}" if origin is Literal else _SPELLING[kind]


# Types of fields
# ------------------------------------------------------------------------------------------------


def kinds_of(hint: Any) -> list[Any]:
    """The types that the value of a field may have, without their annotations."""
    if typing.get_origin(hint) is Annotated:
        return kinds_of(typing.get_args(hint)[0])
    # `Literal[...] | None` is a typing.Union, `int | None` is a types.UnionType.
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return [kind for member in typing.get_args(hint) for kind in kinds_of(member)]
    return [hint]


def kind_of(hint: Any) -> Any:
    """The type of a field's value if it has one. For a field with one or several values, the type
    of several."""
    kinds = [kind for kind in kinds_of(hint) if kind is not type(None)]
    return next((kind for kind in kinds if typing.get_origin(kind) is tuple), kinds[0])


def is_section(kind: Any) -> bool:
    """Whether fields of this type are sections: dataclasses, or the tuples of the filter."""
    return dataclasses.is_dataclass(kind) or hasattr(kind, "_fields")


def bounds(hint: Any) -> Iterator[Bound]:
    """The bounds in a type, including those of a union's members."""
    for argument in typing.get_args(hint):
        if isinstance(argument, Bound):
            yield argument
        else:
            yield from bounds(argument)


def iterate_settings(section: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Name, such as noise.gyro_density, type and value of each setting of a section."""
    for field, hint in typing.get_type_hints(type(section), include_extras=True).items():
        name, value = prefix + field, getattr(section, field)
        if is_section(type(value)):
            yield from iterate_settings(value, f"{name}.")
        elif isinstance(value, Mapping):
            yield from _iterate_entries(value, kind_of(hint), f"{name}.")
        else:
            yield name, hint, value


def _iterate_entries(entries: Mapping, hint: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """`iterate_settings` of a mapping whose type is `hint`."""
    inner = typing.get_args(hint)[1]
    for key, value in entries.items():
        if isinstance(value, Mapping):
            yield from _iterate_entries(value, kind_of(inner), f"{prefix}{key}.")
        else:
            yield prefix + key, inner, value


def flatten(section: Any) -> dict[str, Any]:
    """The settings of a section by names such as noise.gyro_density."""
    return {name: value for name, _, value in iterate_settings(section)}


def validate(config: TrainConfig, source: str = "config") -> TrainConfig:
    """Return `config` if its values make sense together.

    Raises `InputError` naming `source` and the first field that makes no sense.
    """
    location = Location(source)
    for name, hint, value in iterate_settings(config):
        _check_bounds(hint, value, location.child(name))
    config.data.check(location.child("data"))
    config.augment.check(location.child("augment"))
    config.check(location)
    return config


# Writing
# ------------------------------------------------------------------------------------------------


def save(path: str | Path, config: TrainConfig) -> None:
    """Write `config` as YAML that `load` reads back to an equal value."""
    write_text(path, to_yaml(config))


def to_yaml(value: Any) -> str:
    """Settings, or a mapping of plain values, as YAML that `parse` or `parse_yaml` reads back to an
    equal value."""
    plain = to_plain(value)
    return yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)


def to_plain(value: Any) -> Any:
    """Settings as the dictionaries, lists and numbers that YAML and JSON know."""
    if is_section(type(value)):
        return {name: to_plain(getattr(value, name)) for name in typing.get_type_hints(type(value))}
    if isinstance(value, Mapping):
        return {name: to_plain(entry) for name, entry in value.items()}
    return list(value) if isinstance(value, tuple) else value


# YAML
# ------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """The core schema of YAML 1.2: 1e-3 is a number, and the older 010, 1:30, 0b1, yes and
    2020-01-01 are text, and so is infinity. Repeated keys and aliases are refused."""

    yaml_implicit_resolvers: ClassVar[dict] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases: settings need none, and nested ones grow without bound."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise ComposerError(None, None, "aliases are not for settings", mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        """A mapping without repeated keys."""
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.value in keys:
                problem = f"the key {_show(key.value)} is repeated, or it is not a word"
                raise ConstructorError(None, None, problem, key.start_mark)
            keys.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """A dumper whose output `_Loader` reads: text that would be read as a number is quoted."""

    yaml_implicit_resolvers: ClassVar[dict] = {}


_WHOLE = "(0|[1-9][0-9]*)"
for _tag, _form in {
    "null": "null|Null|NULL|~|",
    "bool": "true|True|TRUE|false|False|FALSE",
    "int": f"[-+]?{_WHOLE}",
    "float": rf"[-+]?({_WHOLE}?\.[0-9]+|{_WHOLE}\.?)([eE][-+]?[0-9]+)?",
}.items():  # plain words that are not text; the first pattern that fits counts
    for _kind in (_Loader, _Dumper):
        _kind.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^({_form})$"), None)


def parse_yaml(content: str, source: str) -> Any:
    """The value of a YAML text. Raises `InputError`."""
    try:
        return yaml.load(content, Loader=_Loader)
    except RecursionError:
        problem = "it is nested too deeply"
    except (yaml.YAMLError, ValueError) as error:  # ValueError: too many digits, wrong tags
        problem = " ".join(str(error).split())
    except (AttributeError, LookupError, TypeError):  # from PyYAML, if a tag has other content
        problem = "a tag does not fit its value"
    raise InputError(source, f"is not YAML ({problem})")
