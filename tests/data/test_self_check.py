"""The self-check against walks whose figures are known in closed form."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.dataset import RecordingSource
from gnio_jax.data.loading import read_split
from gnio_jax.data.self_check import check_sequence, gyro_windows, self_check
from gnio_jax.errors import InputError
from gnio_jax.types import Waypoints
from tests.support.circle import changed, circle


def keep_plausible(sequences, dataset):
    """What loading keeps of a dataset that is these sequences."""
    recordings = [
        RecordingSource(sequence.name, lambda sequence=sequence: [sequence])
        for sequence in sequences
    ]
    dataset = dataclasses.replace(dataset, recordings=lambda root, split: recordings)
    return list(read_split(dataset, Path("."), "test"))


def asking(**options):
    """A dataset that asks this of the self-check."""
    return dataclasses.replace(data.get("tlio"), **options)


def test_self_check_of_a_consistent_walk_looks_at_valid_samples_only():
    sequence, lost = circle(), slice(700, 760)
    spoilt = changed(changed(sequence, "accel", lost, 90.0), "valid", lost, False)
    for field in ("position", "velocity", "orientation"):
        spoilt = changed(spoilt, field, lost, np.nan)
    for walk, share in ((sequence, 1.0), (spoilt, 0.98)):
        check = self_check(walk)
        assert check.failures == ()
        np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.05)
        assert check.duration == pytest.approx(29.99) and check.rate == pytest.approx(100.0)
        assert check.share_valid == pytest.approx(share)
        assert check.gyro_consistency_degrees < 1e-6
        assert check.median_speed == pytest.approx(1.2, abs=0.1)
        assert check.accel_correlation_horizontal > 0.99


def test_self_check_removes_one_constant_gyro_bias_and_judges_by_the_median_window():
    sequence = circle(seconds=100.0)
    biased = sequence._replace(gyro=sequence.gyro + np.array([0.02, -0.03, 0.05]))
    spoilt = changed(sequence, "gyro", slice(3000, 4000), [1.0, 0.5, 0.0])
    for walk in (biased, spoilt):
        assert self_check(walk).gyro_consistency_degrees < 0.1
    # Half a radian about x in the second from 40 to 41 s, which the windows that begin at 35 and 40
    # s see; one ends between two samples of which one is touched.
    starts, degrees = gyro_windows(changed(sequence, "gyro", slice(4000, 4100), [0.5, 0.0, 0.4]))
    np.testing.assert_allclose(starts, np.arange(0, 86, 5.0))
    touched = np.isin(starts, [35.0, 40.0])
    np.testing.assert_allclose(degrees[touched], np.degrees(0.5), atol=0.5)
    assert degrees[~touched].max() < 0.2
    drifting = sequence._replace(gyro=sequence.gyro + 0.1 * np.sin(0.3 * sequence.time)[:, None])
    assert any("gyro" in failure for failure in self_check(drifting).failures)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda s: s._replace(accel=s.accel * 1.1), "mean of R·accel"),
        (lambda s: s._replace(gyro=s.gyro[:, [2, 0, 1]] * np.sin(s.time)[:, None]), "gyro"),
        (lambda s: s._replace(position=s.position * [-1, 1, 1]), "correlates"),
        (lambda s: s._replace(velocity=s.velocity * 4), "too fast for a pedestrian"),
        (lambda s: s._replace(valid=np.zeros_like(s.valid)), "no sample has a valid reference"),
        (lambda s: s._replace(valid=(np.arange(len(s.time)) % 700) < 100), "no window"),
    ],
    ids=["scale", "gyro", "mirrored", "speed", "nothing-valid", "no-window"],
)
def test_self_check_says_what_is_implausible(spoil, reason):
    spoilt = spoil(circle())._replace(attributes={"accel_clipped": 0.21})
    (failure, *_) = (line for line in self_check(spoilt).failures if reason in line)
    assert ("clips in 21% of the samples" in failure) == (reason == "mean of R·accel")


@pytest.mark.parametrize(("turn", "passes"), [(0.1, False), (2.0, True)])
def test_a_gyro_may_be_off_by_a_percent_of_what_it_turns(turn, passes):
    # A drift that no constant bias explains: 8° in the median window, in which a slow walker turns
    # 57° and a fast one 1146°.
    sequence = circle(seconds=60.0, turn=turn)
    drift = np.radians(0.06) * (sequence.time - 30.0)
    check = self_check(sequence._replace(gyro=sequence.gyro + drift[:, None] * [0.0, 0.0, 1.0]))
    assert 7.0 < check.gyro_consistency_degrees < 9.0
    failures = [failure for failure in check.failures if "in which it turns 57°" in failure]
    assert (check.failures == ()) == passes and len(failures) == (not passes)


def test_self_check_spares_those_who_stand():
    sequence = circle()
    nothing, level = np.zeros_like(sequence.gyro), 0 * sequence.orientation + [1, 0, 0, 0]
    still = sequence._replace(gyro=nothing, position=nothing, velocity=nothing, orientation=level)
    still = still._replace(accel=np.tile([0, 0, 9.81], (len(nothing), 1)))
    assert self_check(still).failures == ()
    rng = np.random.default_rng(2)
    noisy = still._replace(
        accel=still.accel + 0.1 * rng.standard_normal(still.accel.shape),
        position=1e-4 * rng.standard_normal(still.position.shape),
    )
    check = self_check(noisy)
    assert check.failures == () and abs(check.accel_correlation_horizontal) < 0.2
    pinned = sequence._replace(
        position=0 * sequence.position, accel=sequence.accel + np.sin(3 * sequence.time)[:, None]
    )
    assert any("correlates" in failure for failure in self_check(pinned).failures)


def speeding(seconds=4.0, start=5.0, push=1.5):
    """Straight ahead, ever faster, as a car leaves a crossing."""
    sequence, ahead = circle(seconds=seconds, turn=0.01), np.array([1.0, 0.0, 0.0])
    time = sequence.time[:, None]
    return sequence._replace(
        orientation=0 * time + [1.0, 0, 0, 0],
        gyro=0 * time * ahead,
        accel=0 * time + [push, 0.0, 9.81],
        velocity=(start + push * time) * ahead,
        position=(start * time + push * time**2 / 2) * ahead,
    )


def test_who_ends_faster_than_he_began_is_not_tilted():
    check = self_check(speeding(), pedestrian=False)
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=1e-9)
    assert check.failures == ()
    steady = speeding(push=0.0)  # the same force without the gain in speed is a tilt
    tilted = steady._replace(accel=steady.accel + np.array([1.5, 0, 0]))
    check = self_check(tilted, pedestrian=False)
    np.testing.assert_allclose(check.gravity_mean, [1.5, 0, 9.81], atol=1e-9)
    assert "mean of R·accel is (1.50, 0.00, 9.81)" in check.failures[0]
    # A stop and start in the middle that nobody has seen: speeds before and after say nothing of
    # each other.
    sequence = speeding(seconds=12.0, push=0.5)
    second_half = sequence.time[:, None] >= 6.0
    valid = (sequence.time < 5.0) | (sequence.time >= 7.0)
    velocity = np.where(second_half, sequence.velocity - [4.0, 0, 0], sequence.velocity)
    check = self_check(sequence._replace(velocity=velocity, valid=valid), pedestrian=False)
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=1e-9)


@pytest.mark.parametrize(("seconds", "judged"), [(19.9, False), (20.1, True)])
def test_one_window_says_nothing_of_the_gyro_since_a_bias_explains_it(seconds, judged):
    sequence = circle(seconds=seconds)
    wrong = sequence._replace(gyro=sequence.gyro[:, [1, 2, 0]] * np.sin(sequence.time)[:, None])
    check = self_check(wrong)
    assert np.isnan(check.gyro_consistency_degrees) != judged
    assert any("gyro" in failure for failure in check.failures) == judged
    assert not any("no window" in failure for failure in check.failures)
    assert self_check(sequence).failures == ()
    if judged:  # one valid window of a long recording says nothing either
        sequence = circle(seconds=60.0)
        valid = (sequence.time >= 20.0) & (sequence.time < 31.0)
        check = self_check(sequence._replace(valid=valid))
        assert np.isnan(check.gyro_consistency_degrees) and check.failures == ()


def test_what_is_implausible_is_left_out_and_named_unless_the_dataset_does_not_ask():
    good = circle()
    upside = good._replace(name="upside", accel=-good.accel)
    with pytest.warns(UserWarning, match=r"upside: left out .* mean of R·accel") as caught:
        assert [walk.name for walk in keep_plausible([upside, good], asking())] == [good.name]
    assert len(caught) == 1
    nothing = pytest.raises(InputError, match="none of 1 sequences")
    mirrored = good._replace(position=good.position * [-1, 1, 1])
    with nothing, pytest.warns(UserWarning, match="correlates by only"):
        keep_plausible([mirrored], asking())
    bare = good._replace(valid=np.zeros_like(good.valid), position=good.position * np.nan)
    assert check_sequence(bare, asking()).failures == ("no sample has a valid reference",)
    # A converted recording brings along what its own dataset asks.
    chest = mirrored._replace(attributes={"check_correlation": False, "check_pedestrian": True})
    fast = good._replace(velocity=good.velocity * 4)
    for sequence, options in (
        (mirrored, {"correlates": False}),  # of another body
        (fast, {"pedestrian": False}),
        (bare, {"needs_reference": False}),
        (chest, {}),
    ):
        assert len(keep_plausible([sequence], asking(**options))) == 1
    running = chest._replace(velocity=chest.velocity * 4)
    failures = check_sequence(running, asking(pedestrian=False)).failures
    assert any("too fast" in failure for failure in failures)


def test_waypoints_are_asked_for_gravity_and_speed_alone():
    """A walk in a circle, of which a map has the place every five seconds."""
    walked = circle(seconds=40.0)
    rows = np.arange(0, 4000, 500)
    taps = Waypoints(walked.time[rows], walked.position[rows, :2])
    bare = walked._replace(
        valid=np.zeros_like(walked.valid), position=walked.position * np.nan, waypoints=taps
    )
    check = self_check(bare)
    assert check.failures == () and np.isnan(check.share_valid)
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.1)
    legs = 2 * 1.2 / 0.4 * np.sin(0.4 * 5.0 / 2)  # chords of the circle
    assert check.median_speed == pytest.approx(legs / 5.0, rel=1e-6)
    fast = bare._replace(waypoints=Waypoints(taps.time, 4 * taps.position))
    assert "too fast" in self_check(fast).failures[0]
    weak = bare._replace(accel=bare.accel * 0.9)
    assert "off (0, 0, 9.81)" in self_check(weak).failures[0]
