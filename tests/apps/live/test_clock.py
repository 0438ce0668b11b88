"""Clocks that are set, and stamps that are wrong."""

import numpy as np
import pytest

from gnio_jax.apps.live.clock import on_one_clock
from gnio_jax.errors import InputError
from tests.support.live_streams import STILL, of_lines, samples_of, texts_of


def lines_at(stamps):
    return [f"{stamp!r},{STILL}" for stamp in np.asarray(stamps).tolist()]


def clocked(stamps, clocks=None, is_live=True):
    return list(on_one_clock(of_lines(lines_at(stamps), clocks), "udp:5", is_live))


def times(stage):
    return np.array([sample.time for sample in samples_of(stage)])


STAMPS = np.arange(300) / 100


@pytest.mark.parametrize("by", [-5.0, 300.0, -1.7e9])
@pytest.mark.parametrize("passed", [0.01, 2.0])
def test_a_clock_that_is_set_is_a_gap_of_the_time_that_passed(by, passed):
    """Of two intervals at least; it is said before the samples go on, and none is lost."""
    set_stamps = np.concatenate([STAMPS[:100], STAMPS[100:] + by])
    clocks = np.concatenate([STAMPS[:100], STAMPS[100:] + passed - 0.01])
    stage = clocked(set_stamps, clocks)
    (notice,) = texts_of(stage)
    way = "back" if by < 0 else "forward"
    assert f"was set {way} by" in notice and "it goes on with a gap" in notice
    assert texts_of(stage[: stage.index(next(a for a in stage if a.notice)) + 1]) == [notice]
    stamps = times(stage)
    assert len(stamps) == 300 and texts_of(stage, "refusal") == []
    steps = np.diff(stamps)
    assert steps[99] == pytest.approx(max(passed, 0.02), abs=1e-6)
    np.testing.assert_allclose(np.delete(steps, 99), 0.01, atol=1e-6)


def test_the_same_from_a_file_which_does_not_tell_the_time():
    """What is behind is a clock that was set, what is ahead is a gap."""
    back = clocked(np.concatenate([STAMPS[:100], STAMPS[100:] - 5.0]), is_live=False)
    assert np.diff(times(back)).max() == pytest.approx(0.02)
    ahead = clocked(np.concatenate([STAMPS[:100], STAMPS[100:] + 30.0]), is_live=False)
    np.testing.assert_allclose(times(ahead), np.concatenate([STAMPS[:100], STAMPS[100:] + 30.0]))
    assert texts_of(ahead) == ["samples are missing for 30.0 s before 31.00 s"]
    far = clocked(np.concatenate([STAMPS[:100], STAMPS[100:] + 1.7e9]), is_live=False)
    assert np.diff(times(far)).max() == pytest.approx(60.0, abs=0.1)  # as long as a tracker takes


def test_a_gap_that_is_shortened_is_said():
    """The times of the path are then no longer those of the stamps."""
    stamps = np.concatenate([STAMPS[:100], STAMPS[100:] + 200.0])
    stage = clocked(stamps, stamps)
    (notice,) = texts_of(stage)
    assert notice.startswith("samples are missing for 200.0 s before 201.00 s: it goes on with a ")
    behind = stamps[-1] - times(stage)[-1]
    assert behind == pytest.approx(140.01) and f"{behind:.1f} s behind the stamps" in notice


def test_a_pause_of_the_phone_is_a_gap_and_its_stamps_stay():
    stamps = np.concatenate([STAMPS[:100], STAMPS[100:] + 30.0])
    np.testing.assert_allclose(times(clocked(stamps, stamps)), stamps)


@pytest.mark.parametrize("wrong", [1, 2, 9])
@pytest.mark.parametrize("by", [30.0, -30.0, 0.95 * 60, 1e9])
def test_some_wrong_stamps_cost_their_samples_alone(wrong, by):
    stamps = STAMPS.copy()
    stamps[100 : 100 + wrong] += by
    stage = clocked(stamps, STAMPS)
    np.testing.assert_allclose(times(stage), np.delete(STAMPS, np.s_[100 : 100 + wrong]))
    refusals = texts_of(stage, "refusal")
    assert len(refusals) == wrong and all("time: must increase" in text for text in refusals)
    assert texts_of(stage) == []


@pytest.mark.parametrize("first", [[0.0], [4.3e6], [0.0, 0.0], [9e9, 3.0]])
def test_the_first_stamps_may_be_wrong(first):
    """A sender whose first packet has no stamp yet: neither memory nor samples are lost for it."""
    uptime = 4.2e6 + STAMPS
    stage = clocked(np.concatenate([first, uptime]))
    np.testing.assert_array_equal(times(stage), uptime)
    refusals = texts_of(stage, "refusal")
    assert len(refusals) == len(first) and refusals[0].endswith(", far from the next stamps")


def test_two_senders_at_one_address_do_not_stop_each_other():
    mixed = np.stack([STAMPS, STAMPS + 1000.0], axis=1).reshape(-1)
    mixed = np.concatenate([STAMPS[:50], np.delete(mixed, np.s_[:100])])
    stage = clocked(mixed)
    np.testing.assert_array_equal(times(stage), STAMPS)


def test_samples_a_little_late_are_not_refused_here():
    stamps = STAMPS.copy()
    stamps[[100, 105]] = stamps[[105, 100]]
    np.testing.assert_array_equal(times(clocked(stamps)), stamps)


@pytest.mark.parametrize("count", [1, 5, 9])
def test_a_short_stream_is_passed_on(count):
    np.testing.assert_array_equal(times(clocked(STAMPS[:count])), STAMPS[:count])


@pytest.mark.parametrize("step", [10.0, 5.0, 20_000.0])
def test_stamps_in_another_unit_are_said(step):
    with pytest.raises(
        InputError, match=rf"udp:5: .* {step:g} s apart.*seconds, not in ms, and of one"
    ):
        clocked(np.arange(100) * step)
