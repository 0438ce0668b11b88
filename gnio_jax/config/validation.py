"""A walk over the sections of a configuration: bounds of fields, checks of sections."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from gnio_jax.config.bounds import Bound
from gnio_jax.config.schema import TrainConfig
from gnio_jax.errors import InputError


def validate(config: TrainConfig, source: str = "config") -> TrainConfig:
    """Return `config` if its values make sense together.

    Raises `InputError` naming `source` and the first field that does not.
    """
    _check(config, "", source)
    return config


def _check(section: Any, prefix: str, source: str) -> None:
    """Check the fields of a section, the sections below it, and how its fields go together."""
    hints = typing.get_type_hints(type(section), include_extras=True)
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            _check(value, f"{prefix}{field.name}.", source)
        elif value is not None:
            for bound in _bounds(hints[field.name]):
                if not bound.holds(value):
                    problem = f"{bound.problem}, found {value!r}"
                    raise InputError(source, f"field '{prefix}{field.name}' {problem}")
    if hasattr(section, "check"):
        section.check(prefix, source)


def _bounds(hint: Any) -> Iterator[Bound]:
    """The bounds in a type, also in those of a union's members."""
    for argument in typing.get_args(hint):
        if isinstance(argument, Bound):
            yield argument
        else:
            yield from _bounds(argument)
