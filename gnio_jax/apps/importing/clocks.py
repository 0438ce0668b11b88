"""The samples of a sensor on the clock of its logger.

Clocks of boards and phones count samples, wrap, start again, jump, and stamp a packet when it
arrives. What can be recognised is repaired and noted; everything else is refused. All limits are
ours.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Num, Real

from gnio_jax.data.parsing import stamps as parsing
from gnio_jax.data.parsing.stamps import (
    CROWDED,
    FEW_ROWS,
    RATES,
    SAME_RATE,
    most_damaged_rows,
    usual_step,
)
from gnio_jax.data.parsing.tables import Table
from gnio_jax.data.validation import from_one
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows

PERIODS = sorted(
    [2.0**bits * scale for bits in (8, 10, 12, 16, 24, 32) for scale in (1.0, 1e-3, 1e-6)]
    + [turn * count for turn in (1, 60, 3600, 86400) for count in parsing.PER_SECOND.values()]
)
"""Values at which clocks wrap: whole bits of a counter, and a second, minute, hour and day."""
LONGEST_WRAP, LONGEST_PAUSE = 20.0, 100.0
"""Largest step over a wrap, and to rows that still belong to the recording, in usual steps."""
MOST_BLANK, MOST_LOST = 0.4, 0.2
"""Shares of rows: from the first one without a stamp, these are packets; from the second one of
another start of the clock, a recording is refused."""
NEAR, NEAR_ROW, SHUFFLED = 0.6, 0.4, 0.1
"""Rows of two pieces of a file closer than the first share of a step, or a single row closer than
the second one, are of two clocks, unless so many steps go back that rows are only out of order."""
COUNTED, MOST_COUNTED, SHORTEST_TICKS = 0.8, 2.0, 4
"""Share of steps of 1, and largest mean step, of stamps that count samples of which few are lost;
most stamps between samples that may be a counter too."""
LEAST_GRAIN, DRIFT_SAMPLES = 0.05, 1000
"""Rounding of stamps that matters, in steps, and samples over which a clock does not drift."""
EDGES, EPOCHS = (12.0, 800.0), (1.0e9, 2.2e9)
"""Detected rates beyond the first ones, Hz, are believed only if gravity turns as the gyro says;
the others are the times from 2001 to 2039, s since 1970."""


class Sensor(NamedTuple):
    """A sensor's samples as in its file: rows in any order, in the file's units."""

    name: str
    """gyro or accel, for messages."""
    file: Path
    stamps: Num[np.ndarray, " n"]
    values: Float[np.ndarray, "n 3"]
    row: Callable[[int], int] = from_one
    """A function from a sample to its row in the file, for messages."""
    second: str | None = None
    """Unit of the stamps; None: it is detected."""
    unit: str | None = None
    """Unit of the values (`units.scale_of`); None: it is detected."""
    index: Int[np.ndarray, " n"] | None = None
    """Rows of the table that hold the samples, from 0; None: all."""

    def select_rows(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> Sensor:
        """The samples in these rows."""
        numbers, row = np.arange(len(self.stamps))[rows], self.row
        return self._replace(
            stamps=self.stamps[rows],
            values=self.values[rows],
            row=lambda n: row(int(numbers[n])),
            index=numbers if self.index is None else self.index[rows],
        )


class Clocked(NamedTuple):
    """A sensor's samples in the order of their clock."""

    name: str
    file: Path
    time: Float[np.ndarray, " n"]
    """s since `start`."""
    values: Float[np.ndarray, "n 3"]
    start: Fraction
    """The exact first stamp, s, because unix time in a float is good to a quarter of a µs."""
    is_doubtful: bool
    """Whether the unit was detected by a rate beyond `EDGES` or one that a counter may have."""
    second: str
    """Unit of the stamps."""
    row_time: Float[np.ndarray, " m"]
    """Time of each row of the table, s since `start`, by the same repairs; NaN for a row without a
    stamp, or of another start of the clock."""


def sensor_of(
    name: str, table: Table, second: str, unit: str | None, time: str, *axes: str
) -> Sensor:
    """The samples in the columns `time` and `axes` (x, y, z) of a table, with their units."""
    is_whole = time in table.columns and table.columns[time].dtype.kind in "iu"
    # Columns that are shorter than others end with NaN, which is no sample.
    stamps = table.stamps(time) if is_whole else table.take(time, gaps=True)
    values = table.take(*axes, gaps=True)
    return Sensor(name, table.path, stamps, values, table.row, second, unit)


def read_clock(sensor: Sensor, unit: str | None, notes: list[str], warnings: list[str]) -> Clocked:
    """The samples in order and in seconds. `unit` is that of the stamps; None: it is detected.
    Raises `InputError`."""
    name, file, remarks = sensor.name, sensor.file, list[str]()
    table_stamps, index = sensor.stamps, np.arange(len(sensor.stamps))
    sensor = sensor._replace(index=index)
    blank = np.isnan(sensor.values).all(axis=1)
    if blank.any() and not blank.all():
        # Loggers that write all sensors into one table leave the columns of the others empty.
        problem = f"{blank.sum()} of {len(blank)} rows have no value of {name}"
        remarks.append(f"{problem} and are left out for it")
        sensor = sensor.select_rows(~blank)
    blank = np.isnan(sensor.stamps)
    if blank.mean() > MOST_BLANK and not blank[0]:  # only a packet's first row has a stamp
        last = np.maximum.accumulate(np.where(blank, 0, np.arange(len(blank))))
        sensor = sensor._replace(stamps=sensor.stamps[last])
        remarks.append(f"{blank.sum()} rows of {name} without a stamp share the last one")
    valid = finite_rows(sensor.values) & np.isfinite(sensor.stamps)
    if lost := int((~valid).sum()):
        row = sensor.row(int(np.argmin(valid)))
        problem = f"a stamp or a value of field '{name}' is NaN or Inf in {lost} rows, first in row"
        if lost > most_damaged_rows(len(valid)):
            raise InputError(file, f"{problem} {row}", "repair or cut the recording there")
        remarks.append(f"{problem} {row}: they are left out")
        sensor = sensor.select_rows(valid)
    stamps, wraps = unwrap(sensor.stamps)
    if wraps:
        remarks.append(f"the clock of {name} wrapped {wraps} times and is continued")
    in_file, shift = sensor, stamps - sensor.stamps
    sensor = sensor._replace(stamps=stamps)
    strays = _strays(sensor.stamps)
    if lost := int(strays.sum()):
        remarks.append(f"{lost} rows of {name} are left out, whose stamps are far from all others")
        sensor = sensor.select_rows(~strays)
    mixed = find_mixed(sensor)
    if lost := int(mixed.sum()):
        row = sensor.row(int(np.argmax(mixed)))
        problem = f"the clock of {name} starts again or was set back near row {row}: {lost} rows"
        if lost > MOST_LOST * len(mixed):
            raise InputError(file, f"{problem} overlap others", "cut the recording there")
        problem = f"{file.name}: {problem} of the shorter part are left out"
        (notes if lost <= most_damaged_rows(len(mixed)) else warnings).append(problem)
        sensor = sensor.select_rows(~mixed)
    is_lost = ~np.isin(in_file.index, sensor.index)
    if backward := int((np.diff(sensor.stamps) < 0).sum()):
        remarks.append(f"{name} had {backward} steps back in time; its rows were sorted")
        sensor = sensor.select_rows(np.argsort(sensor.stamps, kind="stable"))
    repeated = np.concatenate([[False], _is_same(sensor)])[: len(sensor.stamps)]
    if repeated.any():
        remarks.append(f"{repeated.sum()} rows of {name} repeat a stamp and were dropped")
        sensor = sensor.select_rows(~repeated)
    stamps = sensor.stamps
    if len(stamps) < 2:
        raise InputError(file, f"holds {len(stamps)} samples of field '{name}'", "record longer")
    if stamps[0] == stamps[-1]:
        problem = f"all {len(stamps)} rows of field '{name}' have the same stamp {stamps[0]:.6g}"
        remedy = "a spreadsheet may have cut its digits: take the file as the logger wrote it"
        raise InputError(file, problem, remedy)
    stated = unit or sensor.second
    second, is_doubtful = (stated, False) if stated else _detected_unit(sensor, remarks)
    rate = 1.0 / (usual_step(stamps) * float(parsing.seconds_of(second)))
    if not parsing.is_rate(rate):
        problem = f"field 'time' makes {name} run at {rate:.3g} Hz with the unit {second}"
        raise InputError(file, problem, f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz")
    first = parsing.first_stamp(stamps, second, file)
    time = _space_evenly(parsing.seconds(stamps, first, second), name, remarks)
    start = Fraction(first) * parsing.seconds_of(second)
    notes += [f"{file.name}: {remark}" for remark in remarks]
    nearest = _nearest_sample(table_stamps, in_file)
    row_time = parsing.seconds(table_stamps + shift[nearest], first, second)
    row_time[is_lost[nearest]] = np.nan
    row_time[sensor.index] = time
    return Clocked(name, file, time, sensor.values, start, is_doubtful, second, row_time)


def _nearest_sample(stamps: Num[np.ndarray, " m"], sensor: Sensor) -> Int[np.ndarray, " m"]:
    """The sample in each row of a table with these `stamps`. For a row without one it is the sample
    before or after it, whichever has the nearer stamp, so that it is of the same start of the
    clock."""
    assert sensor.index is not None
    after = np.searchsorted(sensor.index, np.arange(len(stamps)))
    after = np.minimum(after, len(sensor.stamps) - 1)
    before = np.maximum(after - 1, 0)
    misfits = (np.abs(stamps - sensor.stamps[rows]) for rows in (before, after))
    return np.where(np.less(*misfits), before, after)


def _is_same(sensor: Sensor) -> Bool[np.ndarray, " m"]:
    """Which rows have the stamp and the values of the row before, from the second one on."""
    return (np.diff(sensor.stamps) == 0) & (np.diff(sensor.values, axis=0) == 0).all(axis=1)


def _detected_unit(sensor: Sensor, notes: list[str]) -> tuple[str, bool]:
    """The unit of sorted stamps, and whether it is in doubt. Raises `InputError` for a counter."""
    stamps, name = sensor.stamps, sensor.name
    unit, rate = parsing.time_unit(stamps - stamps[0])
    steps = (gaps := np.diff(stamps))[gaps > 0]
    is_date = unit and EPOCHS[0] < stamps[0] / parsing.PER_SECOND[unit] < EPOCHS[1]
    ticks = float(np.median(steps))
    is_counter = bool((steps == ticks).mean() > COUNTED) and ticks in range(1, SHORTEST_TICKS + 1)
    if is_counter and ticks == 1 and steps.mean() < MOST_COUNTED and not is_date:
        remedy = "give --sample-rate (Hz), or --time-unit if these are stamps"
        raise InputError(sensor.file, "field 'time' counts samples: its steps are 1", remedy)
    if unit is None:
        problem = f"the unit of field 'time' is ambiguous (in seconds {name} would run at"
        remedy = "state it: s, ms, us, ns, or the seconds of one stamp, by --time-unit"
        raise InputError(sensor.file, f"{problem} {rate:.3g} Hz)", remedy)
    rate *= parsing.PER_SECOND[unit]
    notes.append(f"time of {name} taken as {unit}, by which it runs at {rate:.4g} Hz")
    return unit, bool(not EDGES[0] < rate < EDGES[1] or (is_counter and not is_date))


# --- wraps, rows of other times, new starts


def unwrap(stamps: Real[np.ndarray, " n"]) -> tuple[Real[np.ndarray, " n"], int]:
    """Stamps that go on where a clock wrapped, and the number of wraps."""
    steps = np.diff(stamps)
    if not (steps < 0).any():
        return stamps, 0
    usual = usual_step(np.cumsum(np.maximum(steps, 0)))
    top, misfits = float(stamps.max()) - min(float(stamps.min()), 0.0), dict[float, float]()
    for period in PERIODS:
        after = steps[steps < -period / 2] + period
        after = after[(after >= 0) & (after <= LONGEST_WRAP * usual)]
        if len(after) and period - LONGEST_WRAP * usual <= top < period:
            misfits[period] = abs(float(np.median(after)) - usual)
    if not misfits:
        return stamps, 0
    period = min(misfits, key=lambda period: misfits[period])
    wraps = (steps < -period / 2) & (steps >= -period) & (steps + period <= LONGEST_WRAP * usual)
    turns = np.concatenate([[0], np.cumsum(wraps)])
    is_whole = stamps.dtype.kind in "iu" and period == round(period)
    return stamps + turns * (int(period) if is_whole else period), int(wraps.sum())


def _strays(stamps: Real[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """A few rows (`most_damaged_rows`) whose stamps are far before or after all others: the first
    one, before the clock was set, or what was buffered before."""
    longest = LONGEST_PAUSE * usual_step(stamps)
    strays = np.zeros(len(stamps), dtype=bool)
    if np.abs(np.diff(stamps)).max(initial=0) > longest:
        order = np.argsort(stamps, kind="stable")
        far = np.diff(stamps[order]).astype(np.float64) > longest
        cluster = np.concatenate([[0], np.cumsum(far)])
        strays[order] = cluster != np.bincount(cluster).argmax()
    return strays if strays.sum() <= most_damaged_rows(len(stamps)) else np.zeros_like(strays)


def find_mixed(sensor: Sensor) -> Bool[np.ndarray, " n"]:
    """Rows of pieces of the file that lie between the samples of a longer piece: the clock started
    again. Blocks and single rows out of order fill holes, and are not meant."""
    steps = np.diff(sensor.stamps).astype(np.float64)
    if not (steps < 0).any() or (steps < 0).mean() > SHUFFLED:
        return np.zeros(len(sensor.stamps), dtype=bool)
    usual = float(np.median(steps[steps > 0]))
    piece = np.concatenate([[0], np.cumsum((steps < 0) | (steps > 5 * usual))])
    counts = np.bincount(piece)
    length = counts - np.arange(len(counts)) / len(counts)  # of two equal ones the first is longer
    order = np.argsort(sensor.stamps, kind="stable")
    former, latter = order[:-1], order[1:]
    is_former = length[piece[former]] < length[piece[latter]]
    shorter = np.where(is_former, former, latter)
    limit = np.where(counts[piece[shorter]] > 1, NEAR, NEAR_ROW) * usual
    near = (piece[former] != piece[latter]) & (np.diff(sensor.stamps[order]) < limit)
    near &= ~_is_same(sensor.select_rows(order))
    hits = np.bincount(piece[np.unique(shorter[near])], minlength=len(counts))
    return ((hits > 0.5 * counts) | (hits > FEW_ROWS))[piece]


# --- bursts and rounded stamps


def _space_evenly(
    time: Float[np.ndarray, " n"], name: str, notes: list[str]
) -> Float[np.ndarray, " n"]:
    """Time of samples that are evenly apart where stamps are rounded, shared, or those of the
    arrival of a packet."""
    steps, mean, grain = np.diff(time), usual_step(time), _grain(time)
    usual, shared = float(np.median(steps)), int((steps == 0).sum())
    odd = (np.abs(steps - usual) > 0.5 * grain).mean()
    # Steps of one and two grains are those of lost samples, and of no clock that is rounded.
    is_rounded = odd > SAME_RATE and (shared or steps.min() > 1.5 * grain)
    if is_rounded and grain > LEAST_GRAIN * mean:
        index = np.arange(len(time))
        step = np.polyfit(index, time, 1)[0]
        line = step * index
        blocks = np.array_split(index, max(len(time) // DRIFT_SAMPLES, 1))
        drift = [(time[block] - line[block]).mean() for block in blocks]
        line += np.interp(index, [block.mean() for block in blocks], drift)
        if np.abs(time - line).max() <= grain:
            problem = f"stamps of {name} are rounded to {grain:.3g} s"
            problem += f" and {shared} are the same" if shared else ""
            notes.append(f"{problem}: its samples are spread evenly at {1 / step:.4g} Hz")
            return line - line[0]
    crowded = steps < CROWDED * mean
    if crowded.mean() <= SAME_RATE:
        crowded = steps == 0
    if crowded.any():
        starts = np.flatnonzero(np.concatenate([[True], ~crowded]))
        sizes = np.diff(np.append(starts, len(time)))
        lengths = np.append(np.diff(time[starts]), np.inf) / sizes
        lengths[-1] = np.median(lengths[:-1]) if len(lengths) > 1 else mean
        lengths = np.where(sizes > 1, np.minimum(lengths, 1.5 * mean), lengths)
        index = np.arange(len(time)) - np.repeat(starts, sizes)
        time = np.repeat(time[starts], sizes) + index * np.repeat(lengths, sizes)
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
