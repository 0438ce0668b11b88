"""A recording is divided at the gaps of its IMU, and nothing that holds a window is lost in
silence."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.config import DataConfig
from gnio_jax.data import windows
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.gaps import divide_at_gaps
from gnio_jax.types import Sequence


def walk(time, valid=None):
    n = len(time)
    place = np.outer(time, [1.0, 0.5, 0.0])
    return Sequence(
        name="walk",
        time=time,
        gyro=np.zeros((n, 3)),
        accel=np.tile([0, 0, 9.81], (n, 1)),
        orientation=np.tile([1.0, 0, 0, 0], (n, 1)),
        position=place,
        velocity=np.tile([1.0, 0.5, 0.0], (n, 1)),
        valid=np.ones(n, dtype=bool) if valid is None else valid,
        attributes={"group": "someone", "start_time": 100.0},
    )


def stamps(*spans):
    return np.concatenate(
        [np.arange(round(100 * first), round(100 * last) + 1) / 100 for first, last in spans]
    )


def test_every_piece_with_a_window_is_kept_and_named():
    time = stamps((0, 5), (7, 7.5), (9, 10), (12, 20), (30, 34))
    valid = (time < 30) | (time % 0.5 > 0.01)  # no whole window of the last piece has a reference
    with pytest.warns(UserWarning) as caught:
        pieces = divide_at_gaps(walk(time, valid), "walk.csv")
    (warning,) = caught
    assert str(warning.message) == (
        "walk.csv: field 'time' has gaps longer than 1 s (4, up to 10.0 s); "
        "kept: 14.0 of 34.0 s, walk_piece1 (0.0 to 5.0 s), walk_piece2 (9.0 to 10.0 s), "
        "walk_piece3 (12.0 to 20.0 s); "
        "lost: 15.5 s in gaps, 4.5 s in pieces without a whole window"
    )
    assert [piece.name for piece in pieces] == ["walk_piece1", "walk_piece2", "walk_piece3"]
    for piece, first, last in zip(pieces, (0, 9, 12), (5, 10, 20), strict=True):
        np.testing.assert_allclose(
            piece.time, np.arange(round(100 * (last - first)) + 1) / 100, atol=1e-9
        )
        np.testing.assert_allclose(piece.position[:, 0], first + piece.time, atol=1e-9)
        assert piece.attributes == {"group": "someone", "start_time": pytest.approx(100.0 + first)}
    # Each holds at least the one window it was kept for, and no estimate runs through a hole.
    config = DataConfig(rate=100.0)
    assert all(
        len(windows.window_source([piece], config, stride=10).start) >= 1 for piece in pieces
    )
    prepared, short = evaluation.prepare(pieces, config)
    assert [each.sequence.name for each in prepared] == ["walk_piece1", "walk_piece3"]
    assert list(short) == ["walk_piece2"]
    assert all(np.diff(each.sequence.time).max() < 0.011 for each in prepared)


@pytest.mark.filterwarnings("error")
def test_a_recording_without_a_long_gap_stays_as_it_is():
    sequence = walk(stamps((0, 5), (5.9, 9)))
    (same,) = divide_at_gaps(sequence, "walk.csv")
    assert same is sequence


def test_a_recording_of_which_nothing_is_left_is_refused():
    with (
        warnings.catch_warnings(),
        pytest.raises(Refusal, match=r"^walk\.csv: .*\(2, up to 1\.7 s\), and no piece"),
    ):
        warnings.simplefilter("error")
        divide_at_gaps(walk(stamps((0, 0.9), (2.5, 3.3), (5, 5.5))), "walk.csv")


def test_a_piece_whose_valid_runs_are_cut_by_short_gaps_holds_no_window():
    """What `resample` will not bridge, 0.9 s here, parts a window as a long gap does."""
    with pytest.warns(
        UserWarning,
        match=r"kept: 4\.0 of 9\.0 s, walk \(5\.0 to 9\.0 s\); "
        r"lost: 2\.9 s in gaps, 2\.1 s in pieces",
    ):
        (piece,) = divide_at_gaps(walk(stamps((0, 0.6), (1.5, 2.1), (5, 9))), "walk.csv")
    assert piece.name == "walk" and len(piece.time) == 401
