"""The measurements by name: those that a file may list in `filter.measurements`.

A measurement of your own is a NamedTuple of numbers with a `name` and a method `update` (see
`update.Measurement`). `register` makes it known. docs/measurements.md has an example.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_type_hints

from jax.core import Tracer

from gnio_jax import plugins
from gnio_jax.config.files import check_value
from gnio_jax.config.schema import Location
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.filtering.nonholonomic import NonHolonomic
from gnio_jax.filtering.update import Measurement
from gnio_jax.filtering.zero_velocity import ZeroVelocity

_MEASUREMENTS: dict[str, type] = {kind.name: kind for kind in (ZeroVelocity, NonHolonomic)}
_PUBLISHED = frozenset({*_MEASUREMENTS, "displacement"})
"""Names of the measurements of this package; a registered one must have another name."""


def names() -> list[str]:
    """Names of the known measurements, with those of plugins."""
    plugins.load()
    return sorted(_MEASUREMENTS)


def register(measurement: type) -> None:
    """Make a class of your own known under its `name`, and so to `filter.measurements` in files and
    on command lines.

    It is a NamedTuple of numbers, with bounds if their type is one of `config.schema` (`Positive`,
    `NonNegative`, `Finite`), and perhaps with defaults. A second registration replaces the first.
    Raises `InputError` for another class, for one without a name or a method `update`, and for the
    name of a measurement of this package.
    """
    name = getattr(measurement, "name", None)
    parts = isinstance(name, str), hasattr(measurement, "_fields"), hasattr(measurement, "update")
    if not all(parts):
        problem = "is not a NamedTuple with a `name` and a method `update(state, step)`"
        raise InputError(getattr(measurement, "__name__", repr(measurement)), problem)
    if name in _PUBLISHED:
        problem = "is a measurement of gnio-jax"
        raise InputError(f"measurement '{name}'", problem, "choose another name")
    _MEASUREMENTS[name] = measurement


def create_measurements(
    numbers: Mapping[str, Mapping[str, Any] | None], location: Location
) -> tuple[Measurement, ...]:
    """The measurements of these names with their numbers, in their order. Numbers may be traced.

    Raises `InputError` at `location` for an unknown name, and for a number that is unknown, missing
    or out of its bounds.
    """
    return tuple(
        _create(name, fields, location.child(name))
        for name, fields in numbers.items()
        if fields is not None
    )


def _create(name: str, numbers: Mapping[str, Any], location: Location) -> Measurement:
    if name not in _MEASUREMENTS:
        plugins.load()
    if name not in _MEASUREMENTS:
        remedy = f"{did_you_mean(name, names())}known measurements: {', '.join(names())}"
        location.refuse("is not known", f"{remedy}; a plugin may register others")
    kind = _MEASUREMENTS[name]
    hints = get_type_hints(kind, include_extras=True)
    values = dict(numbers)
    for field, value in numbers.items():
        if field not in hints:
            location.child(field).refuse("is unknown", f"known numbers: {', '.join(hints)}")
        if not isinstance(value, Tracer):
            values[field] = check_value(hints[field], value, location.child(field))
    for field in kind._fields:
        if field not in numbers and field not in kind._field_defaults:
            location.child(field).refuse("is missing", f"write {field}: NUMBER")
    for field, other in getattr(kind, "needs", {}).items():
        if field in numbers and other not in numbers:
            location.child(field).refuse("has no effect alone", f"write {other}: NUMBER, too")
    return kind(**values)
