"""Stamps as files give them: their unit, their rate, and rows that are out of order."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Real

from gnio_jax.errors import InputError

RATES = (10.0, 2000.0)
"""Hz; between these lies every IMU one walks with."""
PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units of stamps."""


class TimeUnit(NamedTuple):
    """What the steps of stamps say of their unit."""

    unit: str | None
    """The one by which they are an IMU's; None if there is none."""
    rate: float
    """Hz, if they were seconds."""


def time_unit(stamps: Real[np.ndarray, " n"]) -> TimeUnit:
    """The unit by which the stamps run at `RATES`; the ranges of the units do not overlap."""
    steps = np.diff(np.sort(stamps))
    steps = steps[steps > 0]
    step = float(np.median(steps)) if steps.size else np.inf
    # A rate at the very edge is inside, whatever the last digit of its stamps.
    lowest, highest = RATES[0] * (1 - 1e-6), RATES[1] * (1 + 1e-6)
    units = [unit for unit, count in PER_SECOND.items() if lowest <= count / step <= highest]
    return TimeUnit(units[0] if units else None, 1.0 / step)


def check_seconds(time: Float[np.ndarray, " n"], source: object) -> None:
    """Raise `InputError` where stamps in seconds would not be an IMU's."""
    unit, rate = time_unit(time)
    if unit == "s":
        return
    hint = f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz"
    if unit is not None:
        hint = f"it looks like {unit}: divide it by {PER_SECOND[unit]:g}"
    raise InputError(
        source, f"field 'time' is not in seconds (as such its rate would be {rate:.3g} Hz)", hint
    )


def rounded_rate(time: Float[np.ndarray, " n"]) -> float:
    """Hz, to four digits: stamps are never as exact as the clock they come from."""
    return float(f"{1.0 / float(np.median(np.diff(time))):.4g}")


def in_order(
    time: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    source: object,
    repeats: Literal["first", "refuse"] = "refuse",
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m w"], dict[str, float]]:
    """Rows sorted by their stamps (s), repeated ones dropped, and the counts `rows_sorted` and
    `rows_repeated` where they are not zero.

    A row that repeats stamp and values is the same row twice. Of rows that share a stamp but not
    their values the first is kept, or all are refused by an `InputError`, as `repeats` says.
    """
    backward = int((np.diff(time) < 0).sum())
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    same_stamp = np.concatenate([[False], np.diff(time) == 0])
    other_values = np.concatenate([[False], (np.diff(values, axis=0) != 0).any(axis=1)])
    conflicts = same_stamp & other_values
    if repeats == "refuse" and conflicts.any():
        row = int(np.argmax(conflicts))
        raise InputError(
            source,
            f"field 'time' gives {conflicts.sum()} rows the stamp of another row with other "
            f"values, first at {time[row]:.6f} s",
            "give each sample a stamp of its own",
        )
    counts = {"rows_sorted": float(backward), "rows_repeated": float(same_stamp.sum())}
    kept = ~same_stamp
    return time[kept], values[kept], {name: count for name, count in counts.items() if count}
