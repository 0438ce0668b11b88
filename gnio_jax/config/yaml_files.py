"""Strict YAML: every key is a field, every value has the field's type. The experiments that come
with the package are found by name."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from pathlib import Path
from typing import Any, Literal

import yaml

from gnio_jax.config.schema import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import write_text

_SPELLING = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
    type(None): "null",
}


def names() -> list[str]:
    """Names of the experiments that come with the package, such as quickstart, baselines/tlio."""
    return list(_packaged())


def find(config: str | Path) -> Path:
    """The file of `config`: a path, or a name of `names()`.

    Raises `InputError` that suggests the closest name when it is neither.
    """
    path, packaged = Path(config), _packaged()
    if path.is_file():
        return path
    if str(config) in packaged:
        return packaged[str(config)]
    if path.exists():  # a pipe is read, a folder is told to be one
        return path
    by_stem = {Path(name).stem: name for name in packaged}
    close = difflib.get_close_matches(path.stem, by_stem, n=1)
    hint = f"did you mean '{by_stem[close[0]]}'? " if close else ""
    known = f"give a file, or one of the package's own: {', '.join(packaged)}"
    raise InputError(config, "no such config file", hint + known)


def _packaged() -> dict[str, Path]:
    """Files of the package's experiments by name: in an installed package beside the modules, in a
    checkout at its top."""
    package = Path(__file__).parents[1]
    folders = (package / "configs", package.parent / "configs")
    folder = next((folder for folder in folders if folder.is_dir()), folders[0])
    files = sorted(folder.rglob("*.yaml"))
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}


def load(path: str | Path, base: TrainConfig | None = None) -> TrainConfig:
    """Read a `TrainConfig` from a YAML file, or from the experiment of that name. What it leaves
    out is as in `base`, or by default.

    Raises `InputError` on a missing file, an unknown key or a wrong type.
    """
    path = find(path)
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})") from None
    return parse(content, str(path), base)


def parse(content: str, source: str, base: TrainConfig | None = None) -> TrainConfig:
    """`load` of a file's text; `source` names the file in errors."""
    try:
        fields = yaml.safe_load(content)
    except yaml.YAMLError as error:
        raise InputError(source, f"is not YAML ({' '.join(str(error).split())})") from None
    return _section(base or TrainConfig(), {} if fields is None else fields, source, "")


def save(path: str | Path, config: TrainConfig) -> None:
    """Write `config` as YAML that `load` reads back to an equal value."""
    write_text(path, text(config))


def text(config: TrainConfig) -> str:
    """`config` as YAML that `parse` reads back to an equal value."""
    return yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)


def _section(base: Any, content: Any, source: str, prefix: str) -> Any:
    """The dataclass `base` with the fields of a mapping in it."""
    if not isinstance(content, dict):
        place = prefix.rstrip(".") or "the file"
        problem = f"{place} must be a mapping of fields, found {type(content).__name__}"
        raise InputError(source, problem)
    hints = typing.get_type_hints(type(base))
    for key in content:
        if key not in hints:
            close = difflib.get_close_matches(str(key), hints, n=1)
            known = f"known fields: {', '.join(hints)}"
            remedy = f"did you mean '{prefix}{close[0]}'?" if close else known
            raise InputError(source, f"unknown field '{prefix}{key}'", remedy)
    fields = {
        key: _section(getattr(base, key), value, source, f"{prefix}{key}.")
        if dataclasses.is_dataclass(hints[key])
        else _value(hints[key], value, source, prefix + key)
        for key, value in content.items()
    }
    return dataclasses.replace(base, **fields)


def _value(hint: Any, value: Any, source: str, name: str) -> Any:
    """The value of a field, if it has the field's type."""
    # `Literal[...] | None` is a typing.Union, `int | None` is a types.UnionType.
    union = isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union
    options = typing.get_args(hint) if union else (hint,)
    if value is None and type(None) in options:
        return None
    if typing.get_origin(hint) is tuple:
        return _list(typing.get_args(hint)[0], value, source, name)
    for option in options:
        if typing.get_origin(option) is Literal:
            if value in typing.get_args(option):
                return value
        elif option is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif option in (int, str, bool) and type(value) is option:
            return value
    wanted = " or ".join(_spell(option) for option in options)
    problem = f"field '{name}' must be {wanted}, found {value!r}"
    raise InputError(source, problem, _number_hint(value) if float in options else "")


def _list(hint: Any, value: Any, source: str, name: str) -> tuple:
    """The values of a list of any length, each of the type `hint`."""
    if not isinstance(value, list):
        raise InputError(source, f"field '{name}' must be a list, found {value!r}")
    return tuple(_value(hint, each, source, name) for each in value)


def _number_hint(value: Any) -> str:
    """The remedy for YAML's trap: `1e-4`, without a dot, is text."""
    try:
        number = float(value) if isinstance(value, str) else None
    except ValueError:
        number = None
    if number is None:
        return ""
    return f"YAML reads '{value}' as text: write {number!r} with a dot and a sign, such as 1.0e-4"


def _spell(option: Any) -> str:
    if typing.get_origin(option) is Literal:
        return "one of " + ", ".join(typing.get_args(option))
    return _SPELLING[option]
