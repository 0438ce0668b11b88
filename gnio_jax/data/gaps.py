"""Recordings are divided at gaps of their IMU that no filter can integrate across."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.reference import LONGEST_BRIDGE
from gnio_jax.data.validation import WINDOW_SECONDS
from gnio_jax.numerics import spans, stretches
from gnio_jax.types import Sequence

STAMP_ROUNDING = 1e-6
"""s: what float64 leaves of differences of unix stamps, and more."""


def divide_at_gaps(sequence: Sequence, source: object) -> list[Sequence]:
    """The pieces of a recording (on its native stamps) between gaps longer than a window.

    Each piece is a sequence of its own, since a filter integrates whatever lies between its first
    and its last sample. They share `group`, so that splits and intervals take them as one. A piece
    that holds no window with a valid reference is lost; a warning names what was kept and what was
    lost. Where one piece is left it keeps the recording's name, of several each has a number.
    Raises `Refusal` when none is left.
    """
    time, pieces = sequence.time, stretches(np.diff(sequence.time) > WINDOW_SECONDS)
    if len(pieces) == 1:
        return [sequence]
    gaps = [
        time[after.start] - time[before.stop - 1] for before, after in itertools.pairwise(pieces)
    ]
    problem = (
        f"field 'time' has gaps longer than {WINDOW_SECONDS:g} s ({len(gaps)}, "
        f"up to {max(gaps):.1f} s)"
    )
    kept = [
        piece
        for piece in pieces
        if _longest_valid(time[piece], sequence.valid[piece]) >= WINDOW_SECONDS - STAMP_ROUNDING
    ]
    if not kept:
        raise Refusal(
            source,
            f"{problem}, and no piece between them holds a window with a reference",
            "leave it out",
        )
    names = [sequence.name]
    if len(kept) > 1:
        names = [f"{sequence.name}_piece{number}" for number in range(1, len(kept) + 1)]
    summary = _summary(time, pieces, dict(zip(names, kept, strict=True)), sum(gaps))
    warnings.warn(f"{source}: {problem}; {summary}", stacklevel=2)
    return [_cut(sequence, name, piece) for name, piece in zip(names, kept, strict=True)]


def _seconds(time: np.ndarray, pieces: list[slice]) -> float:
    return float(sum(time[piece.stop - 1] - time[piece.start] for piece in pieces))


def _summary(time: np.ndarray, pieces: list[slice], kept: dict[str, slice], in_gaps: float) -> str:
    """What was kept, by name, and what was lost."""
    held = ", ".join(
        f"{name} ({time[piece.start]:.1f} to {time[piece.stop - 1]:.1f} s)"
        for name, piece in kept.items()
    )
    whole = _seconds(time, [slice(0, len(time))])
    saved = _seconds(time, list(kept.values()))
    lost = f"{in_gaps:.1f} s in gaps"
    if len(kept) < len(pieces):
        short = _seconds(time, pieces) - saved
        lost += f", {short:.1f} s in pieces without a whole window"
    return f"kept: {saved:.1f} of {whole:.1f} s, {held}; lost: {lost}"


def _cut(sequence: Sequence, name: str, piece: slice) -> Sequence:
    """The rows of a piece, whose time begins at 0."""
    fields = {
        field: value[piece]
        for field, value in sequence._asdict().items()
        if isinstance(value, np.ndarray)
    }
    begin = float(sequence.time[piece.start])
    attributes = dict(sequence.attributes)
    if "start_time" in attributes:
        attributes["start_time"] += begin
    changed = {"name": name, "time": fields["time"] - begin, "attributes": attributes}
    return sequence._replace(**fields | changed)


def _longest_valid(time: Float[np.ndarray, "n"], valid: Bool[np.ndarray, "n"]) -> float:
    """Seconds of the longest run of valid samples, as `resample` will leave it."""
    joined = valid[1:] & valid[:-1] & (np.diff(time) <= LONGEST_BRIDGE)
    first, last = spans(joined).T  # of the intervals: the last sample is their end
    return float((time[last] - time[first]).max(initial=0.0))
