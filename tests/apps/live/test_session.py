"""What is kept of a stream, and what is said of it."""

import itertools
import math
import time
import weakref

import numpy as np
import pytest

from gnio_jax.apps.live import session
from gnio_jax.apps.live.checks import Nature
from gnio_jax.apps.live.samples import Arrival
from gnio_jax.apps.live.session import Followed, follow, line
from gnio_jax.apps.live.state import describe
from gnio_jax.errors import InputError
from gnio_jax.evaluation.metrics import path_length
from gnio_jax.filtering import Pose
from tests.support.live_streams import of_lines

UDP = Nature("udp:5555")


class Clocked:
    """A tracker that wants stamps that increase, keeps them, and gives no pose."""

    hindrance = "samples are missing for 0.3 s"

    def __init__(self):
        self.stamps = []

    def push(self, time, gyro, accel):
        if self.stamps and time <= self.stamps[-1]:
            raise ValueError(f"time: must increase, found {time}")
        self.stamps.append(time)


def pose_at(time, position, healthy=True, quiet=False, covariance=None):
    zero = np.zeros(3)
    covariance = np.eye(15) * (1.0 if healthy else -1.0) if covariance is None else covariance
    fields = (time, np.eye(3), zero, np.array(position), zero, zero, covariance, 1.0, 1.0, healthy)
    return Pose(*fields, "" if healthy else "speed", quiet)


def followed(lines, tracker=None):
    result, messages = Followed(), []
    follow(tracker or Clocked(), of_lines(lines), UDP, result, print, messages.append)
    return result, messages


def test_a_stream_of_nonsense_or_of_one_sensor_ends_with_one_line():
    with pytest.raises(
        InputError, match=r"udp:5555: has no sample in its first 100.*is not a sample"
    ):
        followed(["HTTP/1.1 400"] * 500)
    lines = [f"{k / 100},0,0,0.1,,," for k in range(1200)]
    with pytest.raises(InputError, match=r"udp:5555: has no sample with both sensors in its first"):
        followed(lines)
    whole = [f"{k / 100},0,0,0.1,0,0,9.8" for k in range(900, 1200)]
    followed([*lines[:900], *whole])


def test_a_thousand_refused_lines_in_a_row_end_the_stream():
    lines = [f"{time},0,0,0,0,0,9.81" for time in np.arange(50) / 100]
    tracker = Clocked()
    result, _ = followed([*lines[:30], *lines[:20], *lines[30:], *lines * 100], tracker)
    assert tracker.stamps == [k / 100 for k in range(50)] and result.lost
    assert result.in_a_row == 1000 and result.refused == 1020
    assert result.reasons[1].startswith("time: must increase")
    assert result.warnings()[-1].startswith(
        "stopped, 1000 lines in a row refused, the newest: time"
    )


def test_each_second_it_says_what_it_waits_for(monkeypatch):
    """Whether samples come or not; after ten seconds less often."""
    clock = itertools.count(0.0, 0.25)
    monkeypatch.setattr(session.time, "monotonic", lambda: next(clock) / 2)  # twice for a sample
    ticks = [Arrival(0.0, waiting="samples: nothing has come on udp:5555 for 0 s")] * 16
    samples = [f"{k / 50},0,0,0,0,0,9.81" for k in range(100)]
    result, messages = Followed(), []
    arrivals = itertools.chain(ticks, of_lines([*samples, "noise"]))
    follow(Clocked(), arrivals, UDP, result, print, messages.append)
    assert messages[0] == "waiting for samples: nothing has come on udp:5555 for 0 s"
    notice = "waiting for a rest (samples are missing for 0.3 s)"
    assert messages[1:10] == [messages[0], *[notice] * 8] and len(messages) == 11
    _, messages = Followed(), []
    follow(Clocked(), of_lines(["noise", *samples]), UDP, Followed(), print, messages.append)
    assert messages[-1] == f"{notice}; 1 lines are refused, the newest is not a sample"


class Walker:
    """A tracker that makes a pose of each sample: east at 1 m/s, at rest from 3 s on."""

    hindrance = ""

    def push(self, time, gyro, accel):
        return pose_at(time, [min(time, 3.0), 0.0, 0.0], quiet=time >= 3.0)


def test_it_says_where_nothing_comes_in_the_middle_of_a_walk(monkeypatch):
    lines = [f"{k / 10},0,0,0,0,0,9.81" for k in range(10)]
    clock = itertools.count()
    monkeypatch.setattr(session.time, "monotonic", lambda: next(clock))
    ticks = [Arrival(0.0)] * 10
    arrivals = itertools.chain(of_lines(lines), ticks, of_lines(lines), ticks)
    messages = []
    follow(Walker(), arrivals, UDP, Followed(), lambda _: None, messages.append)
    moved = (
        "warning: start: it moved while it should lie still, so velocity and tilt are inaccurate"
    )
    assert messages == [moved, *["nothing has come on udp:5555 for 5 s"] * 2]


def test_the_length_of_the_walk_is_that_of_a_track():
    """Horizontal, through points 1 s apart, and up to the newest pose, of which no zero is
    negative. Of the others the path alone is kept, or a day would fill the memory with
    covariances."""
    result = Followed()
    for k in range(26):  # to and fro within each second, and up
        pose = pose_at(k / 10, [k / 10, 0.3 * (k % 10 == 4) - 1e-3, k / 10])
        first = weakref.ref(pose.covariance) if k == 0 else first
        result.add(pose)
        path = result.trajectory
        if k:
            expected = path_length(path.position[:, :2], 0.1)
            assert result.distance == pytest.approx(expected, abs=1e-9)
    assert "walked 2.5 m" in line(result) and "y    +0.00" in line(result)
    del pose
    assert first() is None and len(result.trajectory.time) == 26


def test_a_line_and_the_page_cost_the_same_after_ten_hours():
    """A line of the first minute against one of the tenth hour, the fastest of many."""

    def cost(result):
        def once():
            begin = time.perf_counter()
            line(result)
            describe(result, UDP, "run", True, len(result.points))
            return time.perf_counter() - begin

        return min(once() for _ in range(50))

    short, long = Followed(), Followed()
    for result, seconds in ((short, 60), (long, 36_000)):
        moments = np.arange(0, seconds, 0.1)
        rows = np.zeros((len(moments), 8))
        rows[:, 0], rows[:, 1], rows[:, 4] = moments, moments, 1.0
        result.path.extend(rows.reshape(-1).tolist())
        result.points = [(x, 0.0) for x in moments.tolist()]
        result.add(pose_at(float(seconds), [float(seconds), 0.0, 0.0]))
    assert cost(long) < 5 * cost(short)


def test_points_are_drawn_where_the_path_has_moved():
    result = Followed()
    for k in range(100):
        result.add(pose_at(k / 10, [0.01 * (k % 3), 0.0, 0.0]))
    assert len(result.points) == 1
    for k in range(100):
        result.add(pose_at(10 + k / 10, [k / 10, 0.0, 0.0]))
    assert 30 < len(result.points) <= 51
    assert max(math.dist(*pair) for pair in itertools.pairwise(result.points)) < 0.31


@pytest.mark.parametrize("holds", [True, False])
def test_the_page_says_rest_as_the_filter_means_it(holds):
    result = Followed(rest_seconds=0.5)
    shown = describe(result, UDP, "run", holds, 0)
    assert shown["state"] == "waiting" and shown["points"] == []
    for k in range(50):
        result.add(Walker().push(k / 10, None, None))
        state = describe(result, UDP, "run", holds, 0)["state"]
        assert state == ("at rest" if k >= 35 else "moving")
    shown = describe(result, UDP, "run", holds, 10)
    assert shown["holds_rest"] == holds and shown["walked"] == 3.0 and shown["seconds"] == 4.9
    assert shown["points"] == [list(point) for point in np.round(result.points[10:], 2)]
    assert shown["next"] == len(result.points) and shown["covariance"] == [1.0, 0.0, 1.0]


def test_a_filter_that_has_diverged_is_shown_as_such():
    """Also from its first pose on, and with a state that is not a number."""
    result = Followed()
    covariance = np.full((15, 15), np.nan)
    result.add(pose_at(1.0, [np.nan] * 3, healthy=False, covariance=covariance))
    assert "THE FILTER DIVERGED (speed)" in line(result) and "walked 0.0 m" in line(result)
    shown = describe(result, UDP, "run", True, 0)
    assert shown["state"] == "diverged" and shown["reason"] == "speed"
    assert len(result.trajectory.time) == 0
