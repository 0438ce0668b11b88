"""Stamps as files give them: their unit, their rate, and rows that are out of order."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Real

from gnio_jax.errors import InputError

RATES = (10.0, 2000.0)
"""Hz; between these lies every IMU one walks with."""
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units of stamps."""
MOST_DAYS = 30.0
"""Longer recordings are mistaken stamps; float64 holds the ns of as many days to the last digit."""
MOST_REPEATED = 0.01
"""Share of the rows that may give the stamp of another row other values: stamps rounded to a coarse
unit fall together now and then (ours)."""
MOST_APART = 10
"""Neighbours in time that are none in the file, for each step back in time, above which samples of
two clocks lie among each other (ours). A block of rows in the wrong place has three."""


def time_unit(stamps: Real[np.ndarray, " n"]) -> tuple[str | None, float]:
    """(unit by which the stamps run at `RATES` or None, Hz if they were seconds); the ranges of the
    units do not overlap."""
    steps = np.diff(np.sort(stamps))
    steps = steps[steps > 0]
    step = float(np.median(steps)) if steps.size else np.inf
    units = [unit for unit, count in PER_SECOND.items() if is_rate(count / step)]
    return units[0] if units else None, 1.0 / step


def is_rate(rate: float) -> bool:
    """Whether an IMU runs at so many Hz. A rate at the edge is inside, whatever the last digits of
    its stamps."""
    return RATES[0] * 0.99 <= rate <= RATES[1] * 1.01


def check_seconds(time: Float[np.ndarray, " n"], source: object) -> None:
    """Raise `InputError` where stamps in seconds would not be an IMU's."""
    unit, rate = time_unit(time)
    if unit == "s":
        return
    remedy = "check the unit of the stamps"
    if unit is not None:
        remedy = f"they look like {unit}: divide them by {PER_SECOND[unit]:g}"
    problem = f"field 'time' runs at {rate:.4g} Hz, expected {RATES[0]:g} to {RATES[1]:g} Hz"
    raise InputError(source, problem, remedy)


def rounded_rate(time: Float[np.ndarray, " n"]) -> float:
    """Hz, to four digits: stamps are never as exact as the clock they come from."""
    return float(f"{1.0 / float(np.median(np.diff(time))):.4g}")


def first_stamp(
    stamps: Real[np.ndarray, " n"], unit: str, source: object, field: str = "time"
) -> float | int:
    """The earliest of the stamps (in `unit`), from which a recording counts its time.

    Raises `InputError` where they span more than `MOST_DAYS`: a damaged stamp would take the digits
    of all others.
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
    """s since the stamp `start`. Integers are subtracted as such: unix time in ns has more digits
    than a float."""
    return np.asarray((stamps - start) / PER_SECOND[unit], dtype=np.float64)


def distinct(
    stamps: Real[np.ndarray, " n"], source: object, field: str = "time"
) -> Int[np.ndarray, " m"]:
    """The first row of each stamp, in their order, of a logger that writes some rows late and some
    twice. Raises `InputError` where fewer than half of the rows have a stamp of their own."""
    rows = np.unique(stamps, return_index=True)[1]
    if len(rows) < 0.5 * len(stamps):
        problem = f"holds only {len(rows)} different stamps in {len(stamps)} rows"
        raise InputError(source, f"field '{field}' {problem}", "copy it again")
    return rows


def in_order(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, "n w"], source: object
) -> tuple[Int[np.ndarray, " m"], dict[str, float]]:
    """(rows sorted by their stamps (s), of those that share a stamp the first; the counts
    `rows_sorted` and `rows_repeated` where they are not zero).

    Raises `InputError` where the clock was set back, since the samples before and after it would
    lie among each other, and where more than `MOST_REPEATED` of the rows give the stamp of another
    row other values.
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
