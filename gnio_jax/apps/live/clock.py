"""One clock for a stream whose stamps may jump: a clock that is set back, or some wrong stamps.

A stamp that continues the clock is accepted at once. Others wait until `AGREEING` in a row agree
with each other; then the clock was set, or samples are missing. If the old clock continues before
that, they were wrong. All limits are ours.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gnio_jax.apps.live.samples import Arrival
from gnio_jax.errors import InputError
from gnio_jax.filtering.resampler import LONGEST_GAP, LONGEST_TRUSTED

LATEST = 0.1
"""A stamp that is behind the newest one by more is of another clock, or came too late, s."""
AGREEING = 10
"""Number of stamps in a row, none further than `LONGEST_TRUSTED` from the one before, that are
believed."""
LONGEST_INTERVAL = 0.5
"""Largest time between samples by their stamps, s: a slower stream has stamps in ms."""


def on_one_clock(arrivals: Iterator[Arrival], name: str, is_live: bool) -> Iterator[Arrival]:
    """The arrivals of source `name`, with stamps on the clock of the first samples.

    Where the clock was set back, the time that passed follows from the arrivals, and is at least
    that of one missing sample. Where stamps jump ahead, samples are missing, unless the source
    `is_live` and less time has passed by the clock of this machine: then the clock was set forward.
    A gap counts as `LONGEST_GAP` at most. Raises `InputError` if no stamps agree in the beginning.
    """
    clock, run, strays = Clock(), list[Arrival](), list[float]()
    for arrival in arrivals:
        sample = arrival.sample
        if sample is None:
            yield arrival
            continue
        if clock.continues(sample.time):
            yield from _refuse(run, clock)
            run.clear()
            yield clock.take(arrival)
            continue
        if run and not _is_near(sample.time, run[-1]):
            yield from _refuse(run, clock)
            run.clear()
        run.append(arrival)
        if len(run) < AGREEING:
            yield Arrival(arrival.clock, waiting="its stamps: they do not continue each other")
            if not clock.is_running:
                strays.append(sample.time)
                _check_unit(strays, name)
            continue
        if clock.is_running:
            yield Arrival(arrival.clock, notice=clock.set_by(run, is_live))
        else:
            clock.start(run[0])
        yield from map(clock.take, run)
        run.clear()
    if clock.is_running:
        yield from _refuse(run, clock)
    elif run:  # a short stream
        clock.start(run[0])
        yield from map(clock.take, run)


class Clock:
    """The clock of the first samples, continued."""

    def __init__(self) -> None:
        self.is_running = False
        self.newest = 0.0
        """The newest stamp on this clock, s."""
        self._offset = 0.0
        """Added to the stamps, s."""
        self._heard = 0.0
        """Time at which the newest sample came, s by this machine."""

    def start(self, first: Arrival) -> None:
        """Begin with the stamp of this sample."""
        assert first.sample is not None
        self.is_running, self.newest = True, first.sample.time

    def continues(self, stamp: float) -> bool:
        """Whether a stamp is of this clock, by its distance from the newest one."""
        ahead = stamp + self._offset - self.newest
        return self.is_running and -LATEST <= ahead <= LONGEST_TRUSTED

    def take(self, arrival: Arrival) -> Arrival:
        """The arrival with its stamp on this clock."""
        assert arrival.sample is not None
        stamp = arrival.sample.time + self._offset
        self.newest, self._heard = max(self.newest, stamp), arrival.clock
        return arrival._replace(sample=arrival.sample._replace(time=stamp))

    def describe_refusal(self, arrival: Arrival) -> str:
        """Why a sample whose stamp does not continue this clock is refused."""
        assert arrival.sample is not None
        if not self.is_running:
            return f"time: must increase, found {arrival.sample.time!r}, far from the next stamps"
        ahead = arrival.sample.time + self._offset - self.newest
        words = f"{ahead:.3g} s ahead of" if ahead > 0 else f"{-ahead:.3g} s behind"
        return f"time: must increase, found {arrival.sample.time!r}, {words} the newest sample"

    def set_by(self, run: list[Arrival], is_live: bool) -> str:
        """Continue with the stamps of a run of samples, and say what happened."""
        stamps = np.array([arrival.sample.time for arrival in run if arrival.sample is not None])
        jump = float(stamps[0]) + self._offset - self.newest
        passed = run[-1].clock - self._heard - float(stamps.max() - stamps[0])
        lost = max(passed, 2 * float(np.median(np.diff(stamps).clip(0))))
        is_hole = jump > 0 and not (is_live and lost < jump - LONGEST_TRUSTED)
        gap = min(jump if is_hole else lost, LONGEST_GAP)
        self._offset += gap - jump
        if is_hole:
            problem = f"samples are missing for {jump:.1f} s before {stamps[0]:.2f} s"
            behind = f"times from there on are {jump - gap:.1f} s behind the stamps"
            remark = f": it goes on with a gap of {gap:g} s, and {behind}"
            return problem + (remark if gap < jump else "")
        words = f"was set {'forward' if jump > 0 else 'back'} by {abs(jump - gap):.3g} s"
        return f"the clock of the samples {words}: it goes on with a gap of {gap:.2g} s"


def _is_near(stamp: float, before: Arrival) -> bool:
    assert before.sample is not None
    return -LATEST <= stamp - before.sample.time <= LONGEST_TRUSTED


def _refuse(run: list[Arrival], clock: Clock) -> Iterator[Arrival]:
    for arrival in run:
        yield Arrival(arrival.clock, refusal=clock.describe_refusal(arrival))


def _check_unit(stamps: list[float], name: str) -> None:
    """Raise `InputError` for many stamps that are too far from each other."""
    if len(stamps) > 2 * AGREEING:
        interval = float(np.median(np.abs(np.diff(stamps))))
        problem = f"its samples come {interval:g} s apart by their stamps"
        if interval > LONGEST_INTERVAL:
            raise InputError(name, problem, "they must be in seconds, not in ms, and of one sender")
        del stamps[:AGREEING]
