"""How long network and filter take for an interval of a recording."""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from gnio_jax.cores import one_core
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.evaluation.estimate import estimate
from gnio_jax.evaluation.prepare import prepare
from gnio_jax.filtering import make_filter
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork, load_corrector

WALK = 30.0
"""Length of the recording, s."""
LEAST, SECONDS = 5, 3.0
"""Smallest number of runs that are timed, and the time for which runs are begun, s."""


def interval_seconds(trained: TrainedNetwork) -> float:
    """Time of network and filter for a clone interval, s: the median over several runs over a
    simulated walk, each divided by its number of intervals. On a CPU they run on one core, where
    the system can do this (`one_core`).

    The program is that of `estimate` for a single recording, compiled before. It has the
    measurements of the network's settings, but not the consider covariance, which is computed after
    the filter. In the first second a network on windows is not called.
    """
    windows, settings = trained.config.data, trained.config.filter
    ekf = dataclasses.replace(make_filter(windows, settings), considered=None)
    corrector = load_corrector(settings, windows.rate, trained)
    walk = pedestrian(seed=0, person=0, seconds=WALK)
    (recording,), _ = prepare([walk], windows, ekf, corrector=corrector)
    network = Network.of(trained.model, trained.variables)
    estimate([recording], network, windows, ekf)
    times: list[float] = []
    with one_core():
        while len(times) < LEAST or sum(times) < SECONDS:
            start = time.perf_counter()
            estimate([recording], network, windows, ekf)
            times.append(time.perf_counter() - start)
    return float(np.median(times)) / recording.strides
