"""Stamps in files: unit, rate, order, and times of day. All limits are ours."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int, Real

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
LONGEST_STEP = 60.0
"""Steps longer than so many mean steps between different stamps are holes, not part of a rate."""
SAME_RATE = 0.02
"""Largest difference of the rates by the mean and by the median step (ours)."""
CROWDED = 0.5
"""Samples that follow faster than this share of the mean step come in bursts (ours)."""
DAY = 86400 * 10**9
"""ns."""
FEW_ROWS, FEW_SHARE, MOST_SHARE = 10, 0.01, 0.1
"""Number of damaged rows that are left out, or the first share of all; at most the second one."""


def seconds_of(unit: str) -> Fraction:
    """Seconds of one `unit`, one of `PER_SECOND` or a number of seconds. Raises `InputError`."""
    if unit in PER_SECOND:
        return Fraction(1, int(PER_SECOND[unit]))
    try:
        size = Fraction(unit)
    except (ValueError, ZeroDivisionError):
        size = Fraction(0)
    if size <= 0:
        remedy = f"known: {', '.join(PER_SECOND)}, or the seconds of one stamp, as 1e-4"
        raise InputError("time_unit", f"unknown value '{unit}'", remedy)
    return size


def usual_step(stamps: Real[np.ndarray, " n"]) -> float:
    """Mean step of stamps, sorted, without holes, in their unit; inf if they do not differ. Bursts
    and stamps that several samples share do not change it, as they would the median."""
    steps = np.diff(stamps).astype(np.float64)
    if steps.min(initial=0.0) < 0:
        steps = np.diff(np.sort(stamps)).astype(np.float64)
    while (moving := steps[steps > 0]).size and steps.max() > LONGEST_STEP * moving.mean():
        steps = steps[steps <= LONGEST_STEP * moving.mean()]
    mean = float(steps.mean()) if steps.size else 0.0
    return mean if mean > 0 else np.inf


def time_unit(stamps: Real[np.ndarray, " n"]) -> tuple[str | None, float]:
    """The unit with which the rate of the stamps is within `RATES`, or None, and the rate in Hz if
    they were seconds. The ranges of the units do not overlap."""
    step = usual_step(stamps)
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
    """Rate of increasing stamps, Hz, to four digits, because stamps are less exact than their
    clock: by the median step, or by the mean step if samples come in bursts."""
    steps = np.diff(time)
    step, mean = float(np.median(steps)), usual_step(time)
    if abs(mean / step - 1.0) > SAME_RATE and (steps < CROWDED * mean).mean() > SAME_RATE:
        step = mean
    return float(f"{1.0 / step:.4g}")


def first_stamp(
    stamps: Real[np.ndarray, " n"], unit: str, source: object, field: str = "time"
) -> float | int:
    """The earliest of the stamps (in `unit`), which is time 0 of a recording.

    Raises `InputError` if they span more than `MOST_DAYS`: a damaged stamp would cost all others
    their digits.
    """
    first, last = stamps.min(), stamps.max()
    days = (float(last) - float(first)) * float(seconds_of(unit)) / 86400
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
    return np.asarray((stamps - start) / float(1 / seconds_of(unit)), dtype=np.float64)


def first_rows(
    stamps: Real[np.ndarray, " n"], source: object, field: str = "time"
) -> Int[np.ndarray, " m"]:
    """The first row of each stamp, in their order, for a logger that writes some rows late and some
    twice. Raises `InputError` if fewer than half of the rows have a stamp of their own."""
    rows = np.unique(stamps, return_index=True)[1]
    if len(rows) < 0.5 * len(stamps):
        problem = f"field '{field}' holds only {len(rows)} different stamps in {len(stamps)} rows"
        raise InputError(source, problem, "take the file as the logger wrote it")
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


# --- damaged rows, the time of day


def most_damaged_rows(count: int) -> float:
    """Largest number of damaged rows among `count` that are left out."""
    return float(max(min(FEW_ROWS, MOST_SHARE * count), FEW_SHARE * count))


def parse_dates(cells: pd.Series) -> tuple[pd.Series, str]:
    """The moments of dates, with a time of day or without (NaT: none), and what is assumed about
    them. A date is in UTC if it states no zone. The day comes before the month if the date has
    points, or a first number above 12; otherwise the month comes first. Examples are 2024-05-03,
    20240503, 3.5.2024, 13/5/2024 and 5/3/2024."""
    text = cells.astype(str).str.strip(" \"'")
    text = text.str.replace(r"^(\d{4})(\d\d)(\d\d)(\.0)?$", r"\1-\2-\3", regex=True)
    parts = text.str.extract(r"^(\d{1,2})([./-])\d{1,2}\2")
    by_day = bool((parts[1] == ".").any() or (parts[0].astype(np.float64) > 12).any())
    moments = pd.to_datetime(text, format="mixed", dayfirst=by_day, utc=True, errors="coerce")
    has_zone = text.str.contains(r":\d\d(?:\.\d+)? *(?:Z|[+-]\d\d:?\d\d)$").any()
    order = "with the day before the month" if by_day else "with the month before the day"
    words = ["in UTC"] * (not has_zone) + [order] * bool(parts[0].notna().any())
    remark = f"dates are taken to be {', '.join(words)}" if words else ""
    return moments.dt.tz_localize(None), remark


def parse_times(
    cells: pd.Series,
) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"], str]:
    """Stamps of times of day, which cells are one, and what is assumed about dates: ns since 1970
    (`parse_dates`), or since midnight if there is no date. Examples are 2024-05-03 09:15:02.250,
    20240503_091502.250, 09:15:02:250, 15:02.250 and 5/3/2024 9:15:02 AM. A time without a date that
    is earlier by half a day than the one before is of the next day, and minutes without an hour are
    of the next hour."""
    text = cells.astype(str).str.strip(" \"'[]")
    date = r"^(\d{4})-?(\d\d)-?(\d\d)[ _T-](\d\d)[:-]?(\d\d)[:-]?(\d\d)"
    text = text.str.replace(date, r"\1-\2-\3 \4:\5:\6", regex=True)
    text = text.str.replace(r"(:\d+)[:, -]((?:\d{3})+)(?!\d)", r"\1.\2", regex=True)
    clock = text.str.extract(r"^((?:\d+:)?\d+:\d+(?:\.\d+)?) ?([AaPp][Mm])?$")
    if clock[0].notna().mean() > 0.5:
        has_hours = bool((clock[0].str.count(":") > 1).any())
        spans = pd.to_timedelta(clock[0] if has_hours else "00:" + clock[0], errors="coerce")
        valid = spans.notna().to_numpy()
        stamps = spans.fillna(pd.Timedelta(0)).to_numpy().astype("timedelta64[ns]").astype(np.int64)
        half = clock[1].str.lower().map({"am": 0, "pm": 1}).to_numpy(np.float64)
        stamps = np.where(np.isnan(half), stamps, stamps % (DAY // 2) + (half == 1) * (DAY // 2))
        turn = DAY if has_hours else DAY // 24
        stamps[valid] += turn * np.cumsum(np.diff(stamps[valid], prepend=0) < -turn // 2)
        return stamps, valid, ""
    dated = text.where(text.str.contains(r"\d:\d\d"))
    dates, remark = parse_dates(dated)
    moments = dates.fillna(pd.Timestamp(0)).to_numpy()
    return moments.astype("datetime64[ns]").astype(np.int64), dates.notna().to_numpy(), remark
