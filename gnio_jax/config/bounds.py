"""Bounds that a field's type carries: `rate: Positive = 200.0`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple


class Bound(NamedTuple):
    """What a value must fulfil. A field that is None has no value and fulfils every bound."""

    holds: Callable[[Any], bool]
    problem: str
    """How the message goes on after the field's name."""


Positive = Annotated[float, Bound(lambda value: value > 0, "must be positive")]
NonNegative = Annotated[float, Bound(lambda value: value >= 0, "must not be negative")]
FiniteNonNegative = Annotated[
    float, Bound(lambda value: 0 <= value < math.inf, "must be finite and not negative")
]
Fraction = Annotated[float, Bound(lambda value: 0 < value < 1, "must be between 0 and 1")]
Probability = Annotated[
    float, Bound(lambda value: 0 <= value < 1, "must be at least 0 and below 1")
]
Count = Annotated[int, Bound(lambda value: value >= 1, "must be at least 1")]
NonNegativeCount = Annotated[int, Bound(lambda value: value >= 0, "must not be negative")]
TwoOrThree = Annotated[int, Bound(lambda value: value in (2, 3), "must be 2 or 3")]
