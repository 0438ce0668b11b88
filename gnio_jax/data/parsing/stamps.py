"""Stamps in files: unit, rate, order, and what clocks of boards and phones do: they count samples,
wrap, start again, jump, stamp a packet when it arrives, and write the time of day. All limits are
ours."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

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
"""Steps longer than this many mean steps between different stamps are holes, and no part of the
rate (ours)."""
SAME_RATE = 0.02
"""Largest difference of the rates by the mean and by the median step (ours)."""
CROWDED = 0.5
"""Samples that follow faster than this share of the mean step come in bursts (ours)."""
DAY = 86400 * 10**9
"""ns."""
PERIODS = sorted(
    [2.0**bits * scale for bits in (8, 16, 24, 32) for scale in (1.0, 1e-3, 1e-6)]
    + [86400 * count for count in PER_SECOND.values()]
)
"""Values at which clocks wrap: whole bits of a counter, and midnight."""
LONGEST_WRAP, LONGEST_PAUSE = 20.0, 100.0
"""Largest step over a wrap, and to rows that still belong to the recording, in usual steps."""
FEW_ROWS, FEW_SHARE = 5, 0.01
"""Number and share of damaged rows that are left out; more are an error."""
MOST_LOST = 0.2
"""Share of rows of another start of the clock from which a recording is refused."""
NEAR, SHUFFLED = 0.4, 0.1
"""Rows of two pieces of a file closer than this share of a step are of two clocks, unless so many
steps go back that the rows are only out of order."""
COUNTED, MOST_COUNTED = 0.8, 2.0
"""Share of steps of 1, and largest mean step, of stamps that count samples of which few are
lost."""
LEAST_GRAIN = 0.05
"""Rounding of stamps that matters, in steps."""
EDGES = (12.0, 800.0)
"""Detected rates beyond these are believed only if gravity turns as the gyro says, Hz."""


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


def distinct(
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


# --- the clock of a log


class Timeline(NamedTuple):
    """The samples of a sensor in the order of their clock."""

    rows: Int[np.ndarray, " n"]
    """Their rows in the file."""
    time: Float[np.ndarray, " n"]
    """s since `start`."""
    start: Fraction
    """The exact first stamp, s, because unix time in a float is good to a quarter of a µs."""
    is_doubtful: bool
    """Whether the unit was detected by a rate beyond `EDGES`."""


def few(count: int) -> float:
    """Largest number of damaged rows among `count` that are left out."""
    return max(float(FEW_ROWS), FEW_SHARE * count)


def timeline(
    stamps: Real[np.ndarray, " n"],
    values: Float[np.ndarray, "n 3"],
    unit: str | None,
    source: object,
    name: str,
    row: Callable[[int], int],
    notes: list[str],
    warnings: list[str],
) -> Timeline:
    """Samples in order and in seconds. `unit` is that of the stamps; None: it is detected. `name`
    is that of the sensor, and `row` gives the row of a sample in the file. Raises `InputError`."""
    stamps, wraps = _unwrapped(stamps)
    if wraps:
        notes.append(f"the clock of {name} wrapped {wraps} times and is continued")
    rows = _without_strays(stamps)
    if strays := len(stamps) - len(rows):
        notes.append(f"{strays} rows of {name} are left out, whose stamps are far from all others")
    mixed = _mixed(stamps[rows], values[rows])
    if lost := int(mixed.sum()):
        place = row(int(rows[np.argmax(mixed)]))
        problem = f"the clock of {name} starts again or was set back near row {place}: {lost} rows"
        if lost > MOST_LOST * len(rows):
            raise InputError(source, f"{problem} overlap others", "cut the recording there")
        target = notes if lost <= few(len(rows)) else warnings
        target.append(f"{problem} of the shorter part are left out")
    rows = rows[~mixed]
    if backward := int((np.diff(stamps[rows]) < 0).sum()):
        notes.append(f"{name} had {backward} steps back in time; its rows were sorted")
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    again = np.concatenate([[False], _is_same(stamps[rows], values[rows])])[: len(rows)]
    if again.any():
        notes.append(f"{again.sum()} rows of {name} repeat a stamp and were dropped")
        rows = rows[~again]
    stamps = stamps[rows]
    if len(stamps) < 2:
        raise InputError(source, f"holds {len(stamps)} samples of field '{name}'", "record longer")
    if stamps[0] == stamps[-1]:
        problem = f"all {len(stamps)} rows of field '{name}' have the same stamp {stamps[0]:.6g}"
        remedy = "a spreadsheet may have cut its digits: take the file as the logger wrote it"
        raise InputError(source, problem, remedy)
    is_detected = unit is None
    unit = unit or _detected_unit(stamps, source, name, notes)
    rate = 1.0 / (usual_step(stamps) * float(seconds_of(unit)))
    if not is_rate(rate):
        problem = f"field 'time' makes {name} run at {rate:.3g} Hz with the unit {unit}"
        raise InputError(source, problem, f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz")
    first = first_stamp(stamps, unit, source)
    time = _even(seconds(stamps, first, unit), name, notes)
    is_doubtful = is_detected and not EDGES[0] < rate < EDGES[1]
    return Timeline(rows, time, Fraction(first) * seconds_of(unit), is_doubtful)


def _is_same(
    stamps: Real[np.ndarray, " n"], values: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " m"]:
    """Which rows have the stamp and the values of the row before, from the second one on."""
    return (np.diff(stamps) == 0) & (values[1:] == values[:-1]).all(axis=1)


def _detected_unit(
    stamps: Real[np.ndarray, " n"], source: object, name: str, notes: list[str]
) -> str:
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if (steps == 1).mean() > COUNTED and steps.mean() < MOST_COUNTED:
        remedy = "give --sample-rate (Hz), or --time-unit if these are stamps"
        raise InputError(source, "field 'time' counts samples: its steps are 1", remedy)
    unit, rate = time_unit(stamps - stamps.min())
    if unit is None:
        problem = f"the unit of field 'time' is ambiguous (in seconds {name} would run at"
        remedy = "state it: s, ms, us, ns, or the seconds of one stamp, by --time-unit"
        raise InputError(source, f"{problem} {rate:.3g} Hz)", remedy)
    rate *= PER_SECOND[unit]
    notes.append(f"time of {name} taken as {unit}, by which it runs at {rate:.4g} Hz")
    return unit


# --- wraps, rows of other times, new starts


def _unwrapped(stamps: Real[np.ndarray, " n"]) -> tuple[Real[np.ndarray, " n"], int]:
    """Stamps that go on where a clock wrapped, and the number of wraps."""
    steps = np.diff(stamps)
    if not (steps < 0).any():
        return stamps, 0
    largest = LONGEST_WRAP * usual_step(np.cumsum(np.maximum(steps, 0)))
    top = float(stamps.max()) - min(float(stamps.min()), 0.0)
    for period in PERIODS:
        after = steps + period
        wraps = (steps < -period / 2) & (after >= 0) & (after <= largest)
        if wraps.any() and period - largest <= top < period:
            turns = np.concatenate([[0], np.cumsum(wraps)])
            is_whole = stamps.dtype.kind in "iu" and period == round(period)
            return stamps + turns * (int(period) if is_whole else period), int(wraps.sum())
    return stamps, 0


def _without_strays(stamps: Real[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Rows of the recording without a `few` whose stamps are far before or after: the first one,
    before the clock was set, or what was buffered before."""
    longest = LONGEST_PAUSE * usual_step(stamps)
    if np.abs(np.diff(stamps)).max(initial=0) <= longest:
        return np.arange(len(stamps))
    order = np.argsort(stamps, kind="stable")
    far = np.diff(stamps[order]).astype(np.float64) > longest
    cluster = np.concatenate([[0], np.cumsum(far)])[: len(stamps)]
    counts = np.bincount(cluster, minlength=1)
    if len(stamps) - counts.max() > few(len(stamps)):
        return np.arange(len(stamps))
    return np.sort(order[cluster == counts.argmax()])


def _mixed(
    stamps: Real[np.ndarray, " n"], values: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Rows of pieces of the file that lie between the samples of a longer piece: the clock started
    again. Blocks and single rows out of order fill holes, and are not meant."""
    steps = np.diff(stamps).astype(np.float64)
    if not (steps < 0).any() or (steps < 0).mean() > SHUFFLED:
        return np.zeros(len(stamps), dtype=bool)
    usual = float(np.median(steps[steps > 0]))
    piece = np.concatenate([[0], np.cumsum((steps < 0) | (steps > 5 * usual))])
    counts = np.bincount(piece)
    length = counts - np.arange(len(counts)) / len(counts)  # of two equal ones the first is longer
    order = np.argsort(stamps, kind="stable")
    left, right = order[:-1], order[1:]
    near = (piece[left] != piece[right]) & (np.diff(stamps[order]) < NEAR * usual)
    near &= ~_is_same(stamps[order], values[order])
    shorter = np.where(length[piece[left]] < length[piece[right]], left, right)[near]
    hits = np.bincount(piece[np.unique(shorter)], minlength=len(counts))
    return ((hits > 0.5 * counts) | (hits > FEW_ROWS))[piece]


# --- bursts and rounded stamps


def _even(time: Float[np.ndarray, " n"], name: str, notes: list[str]) -> Float[np.ndarray, " n"]:
    """Time of samples that are evenly apart where stamps are rounded, shared, or those of the
    arrival of a packet."""
    steps, mean, grain = np.diff(time), usual_step(time), _grain(time)
    usual, shared = float(np.median(steps)), int((steps == 0).sum())
    odd = (np.abs(steps - usual) > 0.5 * grain).mean()  # one lost sample is no rounding
    if grain > LEAST_GRAIN * mean and odd > SAME_RATE:
        step, first = np.polyfit(np.arange(len(time)), time, 1)
        line = step * np.arange(len(time))
        if np.abs(time - first - line).max() <= grain:
            problem = f"stamps of {name} are rounded to {grain:.3g} s and {shared} are the same"
            notes.append(f"{problem}: its samples are spread evenly at {1 / step:.4g} Hz")
            return line
    crowded = steps < CROWDED * mean
    if crowded.mean() <= SAME_RATE:
        crowded = steps == 0
    if crowded.any():
        starts = np.flatnonzero(np.concatenate([[True], ~crowded]))
        sizes = np.diff(np.append(starts, len(time)))
        lengths = np.append(np.diff(time[starts]), np.inf) / sizes
        lengths[-1] = np.median(lengths[:-1]) if len(lengths) > 1 else mean
        lengths = np.where(sizes > 1, np.minimum(lengths, 1.5 * mean), lengths)
        place = np.arange(len(time)) - np.repeat(starts, sizes)
        time = np.repeat(time[starts], sizes) + place * np.repeat(lengths, sizes)
        problem = f"{crowded.sum()} samples of {name} share the stamp of a burst or follow at once"
        problem += f" ({shared} have the same stamp): they are spread evenly up to the next one"
        notes.append(f"{problem}, {1 / usual_step(time):.4g} Hz by all samples")
    elif abs(usual / mean - 1.0) > SAME_RATE:
        problem = f"{name} has {1 / mean:.4g} samples a second, but its usual step is that of"
        notes.append(f"{problem} {1 / usual:.4g} Hz: samples are missing")
    return time


def _grain(time: Float[np.ndarray, " n"]) -> float:
    """Unit to which stamps are rounded, s; 0 if it is less than a microsecond."""
    for digits in range(7):
        whole = np.round(time * 10**digits)
        if np.abs(time * 10**digits - whole).max() < 1e-2:
            return float(np.gcd.reduce(whole.astype(np.int64))) / 10**digits
    return 0.0


# --- the time of day


def parsed_times(cells: pd.Series) -> tuple[Int[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Stamps of times of day, and which cells are one: ns since 1970, or since midnight if there is
    no date, in UTC if there is no zone. Examples are 2024-05-03 09:15:02.250, 09:15:02:250,
    15:02.250 and 5/3/2024 9:15:02 AM. After midnight a time without a date is of the next day."""
    text = (
        cells.astype(str).str.strip(" \"'").str.replace(r"(:\d+)[:,](\d{3,})", r"\1.\2", regex=True)
    )
    is_clock = text.str.fullmatch(r"(\d+:)?\d+:\d+(\.\d+)?")
    if is_clock.mean() > 0.5:
        spans = text.where(is_clock).where(text.str.count(":") > 1, "00:" + text)
        stamps = pd.to_timedelta(spans, errors="coerce")
        valid = stamps.notna().to_numpy()
        filled = stamps.fillna(pd.Timedelta(0)).to_numpy()
        clock = np.array(filled.astype("timedelta64[ns]"), dtype=np.int64)
        times = clock[valid]
        clock[valid] += (
            DAY * np.cumsum(np.r_[False, times[1:] - times[:-1] < -DAY // 2])[: len(times)]
        )
        return clock, valid
    dated = text.where(text.str.contains(r"\d:\d\d"))
    is_dotted = bool(text.str.match(r"\d{1,2}\.\d").any())
    stamps = pd.to_datetime(dated, format="mixed", dayfirst=is_dotted, utc=True, errors="coerce")
    valid = stamps.notna().to_numpy()
    moments = stamps.dt.tz_localize(None).fillna(pd.Timestamp(0)).to_numpy()
    return moments.astype("datetime64[ns]").astype(np.int64), valid
