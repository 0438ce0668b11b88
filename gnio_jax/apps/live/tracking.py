"""The tracker of a trained network, at the rate of a stream."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from gnio_jax.apps.live.checks import FIRST_SAMPLES, FIRST_SECONDS
from gnio_jax.apps.live.samples import Arrival, Sample
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.filtering import Filter, Tracker, make_filter
from gnio_jax.filtering.start import level_state
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork, load_corrector

VELOCITY = slice(3, 6)
"""Rows of the velocity in a pose's covariance."""


def create_tracker(
    run: TrainedNetwork, imu_rate: float | None = None, rest_seconds: float = 1.0
) -> Tracker:
    """The compiled tracker of a run, with the filter and the start of `gnio track`.

    From the same samples it makes the same trajectory as `gnio track`, to rounding, if the
    recording rests for `rest_seconds` and less than a second longer. From a longer rest a track
    uses all samples for the gyro's bias, but a live tracker does not know the later ones. Live
    samples are interpolated linearly if the rates differ.

    `imu_rate` is the rate of the samples that will come, Hz; None: the network's, until
    `Tracker.expect` changes it. If samples are further apart than 1.5 of its intervals, some are
    missing between them. Raises `ValueError` for a rest that is shorter than two samples.
    """
    network = Network.of(run.model, run.variables)
    return Tracker(
        network.predict(),
        make_filter(run.config.data, run.config.filter),
        rest_seconds=rest_seconds,
        hole=longest_interval(run, imu_rate),
        imu_rate=imu_rate or run.config.data.rate,
        corrector=load_corrector(run.config.filter, run.config.data.rate, run),
    )


def longest_interval(run: TrainedNetwork, imu_rate: float | None = None) -> float:
    """Largest time between samples without missing ones, s; `imu_rate` as in `create_tracker`."""
    native = 1 / run.config.data.rate
    return 1.5 * max(native, 1 / imu_rate if imu_rate else native)


def since_ready(arrivals: Iterator[Arrival], ready: float, ekf: Filter) -> Iterator[Arrival]:
    """The arrivals, without the samples that came before the time `ready` (s, by this machine) if
    they do not begin at rest: the device was in motion before the message to hold it still."""
    early: list[Arrival] = []
    for arrival in arrivals:
        if arrival.clock < ready and arrival.sample is not None:
            early.append(arrival)
            continue
        if early and arrival.clock >= ready:
            yield from _at_rest(early, ekf)
            early.clear()
        yield arrival
    yield from _at_rest(early, ekf)


def _at_rest(early: list[Arrival], ekf: Filter) -> Iterator[Arrival]:
    samples = [arrival.sample for arrival in early if arrival.sample is not None]
    if begins_at_rest([sample for sample in samples if sample.whole], ekf):
        yield from early
    else:
        notice = f"{len(early)} samples came before the device was still and are left out"
        yield Arrival(early[-1].clock, notice=notice)


def begins_at_rest(samples: list[Sample], ekf: Filter) -> bool:
    """Whether the first second of some whole samples is quiet enough for the start of the filter.
    Too few samples may be: the rest may continue."""
    first = [sample for sample in samples if sample.time - samples[0].time < FIRST_SECONDS]
    if len(first) < FIRST_SAMPLES or samples[-1].time - samples[0].time < FIRST_SECONDS:
        return True
    rows = np.array([(sample.time, *sample.gyro, *sample.accel) for sample in first])
    config = dataclasses.replace(ekf.config, dt=float(np.median(np.diff(rows[:, 0]))))
    try:
        state = level_state(dataclasses.replace(ekf, config=config), rows[:, 1:4], rows[:, 4:])
    except ValueError:  # it shows no gravity, which is told later
        return True
    return float(state.core_covariance[VELOCITY.start, VELOCITY.start]) <= ROUGH_START**2
