"""Stamps in files: their unit, their rate, and rows that are out of order."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Real

from gnio_jax.errors import InputError

RATES = (10.0, 2000.0)
"""Smallest and largest rate of an IMU for walking, Hz."""
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units of stamps."""
MOST_DAYS = 30.0
"""Largest duration of a recording, days; longer ones have wrong stamps. Up to this, float64 holds
ns exactly."""
MOST_REPEATED = 0.01
"""Largest share of rows that have the stamp of another row with other values: coarsely rounded
stamps sometimes coincide (ours)."""
MOST_APART = 10
"""Number of neighbours in time that are not neighbours in the file, per step back in time, above
which samples of two clocks are mixed (ours). A block of rows in the wrong place has three."""


def time_unit(stamps: Real[np.ndarray, " n"]) -> tuple[str | None, float]:
    """The unit with which the rate of the stamps is within `RATES`, or None, and the rate in Hz if
    they were seconds. The ranges of the units do not overlap."""
    steps = np.diff(np.sort(stamps))
    steps = steps[steps > 0]
    step = float(np.median(steps)) if steps.size else np.inf
    units = [unit for unit, count in PER_SECOND.items() if is_rate(count / step)]
    return units[0] if units else None, 1.0 / step


def is_rate(rate: float) -> bool:
    """Whether this is a rate of an IMU, Hz. A rate at the limit is allowed, independently of the
    rounding of stamps."""
    return RATES[0] * 0.99 <= rate <= RATES[1] * 1.01


def check_seconds(time: Float[np.ndarray, " n"], source: object) -> None:
    """Raise `InputError` if stamps in seconds cannot be those of an IMU."""
    unit, rate = time_unit(time)
    if unit == "s":
        return
    remedy = "check the unit of the stamps"
    if unit is not None:
        remedy = f"they look like {unit}: divide them by {PER_SECOND[unit]:g}"
    problem = f"field 'time' runs at {rate:.4g} Hz, expected {RATES[0]:g} to {RATES[1]:g} Hz"
    raise InputError(source, problem, remedy)


def rounded_rate(time: Float[np.ndarray, " n"]) -> float:
    """Rate, Hz, to four digits, because stamps are less exact than their clock."""
    return float(f"{1.0 / float(np.median(np.diff(time))):.4g}")


def first_stamp(
    stamps: Real[np.ndarray, " n"], unit: str, source: object, field: str = "time"
) -> float | int:
    """The earliest of the stamps (in `unit`), which is time 0 of a recording.

    Raises `InputError` if they span more than `MOST_DAYS`: a damaged stamp would cost all others
    their digits.
    """
    first, last = stamps.min(), stamps.max()
    days = (float(last) - float(first)) / PER_SECOND[unit] / 86400
    if not days <= MOST_DAYS:
        problem = f"field '{field}' goes over {days:.3g} days"
        remedy = f"cut the rows of other times, or check the unit of the stamps ({unit})"
        raise InputError(source, problem, remedy)
    return first.item()


def seconds(
    stamps: Real[np.ndarray, " n"], start: float | int, unit: str = "ns"
) -> Float[np.ndarray, " n"]:
    """Time since the stamp `start`, s. Integers are subtracted as integers, because unix time in ns
    has more digits than a float."""
    return np.asarray((stamps - start) / PER_SECOND[unit], dtype=np.float64)


def distinct(
    stamps: Real[np.ndarray, " n"], source: object, field: str = "time"
) -> Int[np.ndarray, " m"]:
    """The first row of each stamp, in their order, for a logger that writes some rows late and some
    twice. Raises `InputError` if fewer than half of the rows have a stamp of their own."""
    rows = np.unique(stamps, return_index=True)[1]
    if len(rows) < 0.5 * len(stamps):
        problem = f"holds only {len(rows)} different stamps in {len(stamps)} rows"
        raise InputError(source, f"field '{field}' {problem}", "copy it again")
    return rows


def in_order(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, "n w"], source: object
) -> tuple[Int[np.ndarray, " m"], dict[str, float]]:
    """Rows sorted by their stamps (s), with the first of those that share a stamp, and the counts
    `rows_sorted` and `rows_repeated` if they are not zero.

    Raises `InputError` if the clock was set back, because the samples before and after this would
    be mixed, and if more than `MOST_REPEATED` of the rows have the stamp of another row with other
    values.
    """
    steps = np.diff(time)
    if (steps > 0).all():
        return np.arange(len(time)), {}
    order = np.argsort(time, kind="stable")
    backward = int((steps < 0).sum())
    if (np.abs(np.diff(order)) > 1).sum() > MOST_APART * max(backward, 1):
        row = int(np.argmin(steps))
        problem = f"field 'time' jumps back by {-steps[row]:.2f} s after {time[row]:.6f} s"
        problem += ", and what follows overlaps what was before"
        remedy = "its clock was changed during the recording: cut the recording there"
        raise InputError(source, problem, remedy)
    again = np.concatenate([[False], np.diff(time[order]) == 0])
    other = np.concatenate([[False], (np.diff(values[order], axis=0) != 0).any(axis=1)]) & again
    if other.sum() > max(MOST_REPEATED * len(time), 1):
        problem = f"gives {other.sum()} of {len(time)} rows the same stamp as another row with"
        problem += f" different values, first at {time[order][other][0]:.6f} s"
        problem = f"field 'time' {problem}"
        raise InputError(source, problem, "give stamps fine enough to tell the samples apart")
    counts = {"rows_sorted": float(backward), "rows_repeated": float(again.sum())}
    return order[~again], {name: count for name, count in counts.items() if count}
