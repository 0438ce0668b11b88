"""How far a trajectory goes, walking and standing still."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from gnio_jax.evaluation.metrics.trajectory import Positions, Undefined
from gnio_jax.numerics import finite_rows, spans

STANDING_SPEED = 0.05
"""Mean speed over one second below which the reference stands still, m/s."""
STANDING_SECONDS = 2.0
"""Shortest stretch that counts as standing still, s."""


def path_length(position: Positions, step: float, seconds: float = 1.0) -> float:
    """Length of the polygon through the rows `seconds` apart (and the last row), m.

    A side that touches an untrusted row is left out. Summing row by row would count the noise of
    positions as walking: 5 mm at 10 Hz is 3 m a minute.
    """
    if len(position) < 2:
        raise Undefined("a single row")
    rows_apart = max(1, round(seconds / step))
    rows = np.unique(np.append(np.arange(0, len(position), rows_apart), len(position) - 1))
    return float(np.nansum(np.linalg.norm(np.diff(position[rows], axis=0), axis=1)))


def path_length_ratio(estimate: Positions, reference: Positions, step: float) -> float:
    """Estimated over true `path_length` (through points 1 s apart), over the stretches that are
    trusted: 1 is right, 0 never moved."""
    length = path_length(reference, step)
    if length < 1.0:
        raise Undefined(f"the reference path is {length:.2f} m long, under 1 m")
    trusted = np.where(finite_rows(reference)[:, None], estimate, np.nan)
    return path_length(trusted, step) / length


def standing(reference: Positions, step: float) -> Bool[np.ndarray, "n"]:
    """Rows of the stretches of at least 2 s in which every displacement over 1 s is below 0.05 m.

    One second, because that is what the network is asked for, and because it forgives the noise of
    the reference and the swaying of a person who stands.
    """
    apart = max(1, round(1.0 / step))
    still = np.zeros(len(reference), bool)
    if len(reference) <= apart:
        return still
    with np.errstate(invalid="ignore"):
        moved = np.linalg.norm(reference[apart:] - reference[:-apart], axis=1)
        slow = moved < STANDING_SPEED * apart * step
    for start, stop in spans(slow):
        if (stop - 1 - start + apart) * step >= STANDING_SECONDS - 1e-9:
            still[start : stop + apart] = True
    return still & finite_rows(reference)


def stationary_drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Metres the estimate walks per minute in which the reference stands (`standing`).

    The path is through points 1 s apart. It is what a gate on the displacement is for (GNIO).
    Undefined where the reference never stands for 2 s.
    """
    walked, seconds = 0.0, 0.0
    for start, stop in spans(standing(reference, step)):
        if stop - start > 1:
            walked += path_length(estimate[start:stop], step)
            seconds += (stop - 1 - start) * step
    if not seconds:
        raise Undefined(f"the reference never stands still for {STANDING_SECONDS:g} s")
    return float(walked / (seconds / 60))
