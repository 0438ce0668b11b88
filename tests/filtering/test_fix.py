"""Fixes of position as they are laid onto intervals, refused, and measured component by
component."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.filtering.fix import threshold_of
from tests.support.compiling import quick
from tests.support.random_walk import random_walk
from tests.support.whole_covariance import covariance as whole_covariance

INTERVALS, LENGTH, NAN = 40, 0.1, np.nan
CONFIG = filtering.FilterConfig(0.02, 5, 4)


def test_each_lies_in_the_interval_whose_end_is_nearest():
    """Of 0.1 s; one before the middle of the first interval lies in that, and one in the samples
    after the last whole interval lies in the last."""
    time, rows = [5.02, 5.44, 5.46, 9.09, 6.2], [0, 3, 4, 39, 11]
    position = np.arange(10.0).reshape(5, 2)
    covariance = np.arange(1, 6)[:, None, None] * np.array([[2.0, 0.5], [0.5, 1.0]])
    fix = filtering.fixes_on_intervals(time, position, covariance, INTERVALS, CONFIG, 5.0, 0.3)
    assert np.flatnonzero(np.isfinite(fix.position).all(1)).tolist() == sorted(rows)
    np.testing.assert_array_equal(fix.position[rows], position)
    np.testing.assert_array_equal(fix.covariance[rows], covariance)
    ends = 5.0 + LENGTH * (np.array(rows) + 1)
    np.testing.assert_allclose(fix.before_end[rows], ends - time, atol=1e-12)
    np.testing.assert_array_equal(fix.time_std[rows], 0.3)
    assert np.isfinite(fix.before_end).all() and np.isfinite(fix.time_std).all()


SHAPE = np.array([[0.4, 0.1, 0.0], [0.1, 0.3, 0.0], [0.0, 0.0, 0.2]])


def test_two_in_an_interval_become_one():
    """The same as one after the other for a filter at a constant velocity, where their covariances
    are of one shape: the information is the sum, and so is what it says of p − a v. The errors of
    their times are independent."""
    time, scale = [0.98, 1.03], np.array([1.0, 3.0])
    position = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 5.0]])
    covariance, time_std = scale[:, None, None] * SHAPE, [0.2, 0.4]
    fix = filtering.fixes_on_intervals(
        time, position, covariance, INTERVALS, CONFIG, time_std=time_std
    )
    assert np.isfinite(fix.position).all(1).sum() == 1
    np.testing.assert_allclose(fix.covariance[9], SHAPE / (1 + 1 / 3))
    np.testing.assert_allclose(fix.position[9], [1.25, 2.0, 3.5])
    np.testing.assert_allclose(fix.before_end[9], 0.75 * 0.02 - 0.25 * 0.03)
    np.testing.assert_allclose(fix.time_std[9], np.sqrt(0.15**2 + 0.1**2))
    np.testing.assert_array_equal(np.delete(fix.time_std, 9), 0.0)


def test_a_missing_component_leaves_the_others():
    """Of one alone, and of one beside a whole fix in its interval: the mean of each component is
    that of the fixes that have it. What the covariance says of a missing component is not read."""
    time = [0.5, 0.98, 1.02, 2.0]
    position = np.array([[NAN, 1.0, 2.0], [1.0, 4.0, 3.0], [2.0, 8.0, NAN], [NAN, NAN, NAN]])
    covariance = np.tile(SHAPE, (4, 1, 1))
    covariance[0, 0], covariance[2, 2] = NAN, [9.0, -9.0, -9.0]
    covariance[3] = NAN
    fix = filtering.fixes_on_intervals(time, position, covariance, INTERVALS, CONFIG)
    assert np.flatnonzero(np.isfinite(fix.position).any(axis=1)).tolist() == [4, 9]
    np.testing.assert_array_equal(fix.position[4], [NAN, 1.0, 2.0])
    np.testing.assert_array_equal(fix.covariance[4][1:, 1:], SHAPE[1:, 1:])
    # Weights of the mean variances 0.9 / 3 and 0.7 / 2; the mean by a matrix that adds them up.
    weights = np.array([3 / 0.9, 2 / 0.7])
    weights = weights / weights.sum()
    mean = np.block([np.diag([weights[0], weights[0], 1.0]), weights[1] * np.eye(3, 2)])
    joint_covariance = np.zeros((5, 5))
    joint_covariance[:3, :3], joint_covariance[3:, 3:] = SHAPE, SHAPE[:2, :2]
    np.testing.assert_allclose(fix.position[9], mean @ [1.0, 4.0, 3.0, 2.0, 8.0])
    np.testing.assert_allclose(fix.covariance[9], mean @ joint_covariance @ mean.T, atol=1e-15)
    np.testing.assert_allclose(fix.before_end[9], weights @ [0.02, -0.02])


OUTSIDE, SHAPES = "are outside of the recording, one at ", "time, position and covariance must be"
NOT_POSITIVE = "a covariance is not finite, symmetric and positive definite"


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(time=[0.5, 99.0]), f"1 of 2 {OUTSIDE}99 s; it lasts"),
        (dict(time=[0.5, 4.1]), f"1 of 2 {OUTSIDE}4.1 s"),
        (dict(time=[-0.1, 1.0]), f"1 of 2 {OUTSIDE}-0.1 s"),
        (dict(time=[0.5, NAN]), f"1 of 2 {OUTSIDE}nan s"),
        (dict(time=[0.5]), SHAPES),
        (dict(position=np.zeros((2, 3))), SHAPES),
        (dict(time_std=[0.1, -0.1]), "time_std must be at least 0"),
        (dict(time_std=[0.1, 0.1, 0.1]), "time_std must be one or"),
        (dict(threshold=NAN), "threshold must be above 0, found nan"),
        (dict(covariance=np.zeros((2, 2, 2))), NOT_POSITIVE),
        (dict(covariance=np.array([np.eye(2), [[1.0, 0.5], [0.0, 1.0]]])), NOT_POSITIVE),
        (dict(covariance=np.array([np.eye(2), [[1.0, 2.0], [2.0, 1.0]]])), NOT_POSITIVE),
        (dict(covariance=np.array([np.eye(2), [[1.0, NAN], [NAN, 1.0]]])), NOT_POSITIVE),
    ],
)
def test_what_is_no_fix_is_refused_in_one_line(change, text):
    eyes = np.tile(np.eye(2), (2, 1, 1))
    good = {"time": [0.5, 1.0], "position": np.zeros((2, 2)), "covariance": eyes}
    with pytest.raises(InputError, match=f"^fixes: {text}") as caught:
        filtering.fixes_on_intervals(**(good | change), intervals=INTERVALS, config=CONFIG)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("axes", [2, 3])
def test_the_test_of_fewer_components_has_the_same_probability(axes):
    for probability in (0.5, 0.99, 0.9999):
        threshold = jnp.asarray(chi2.ppf(probability, axes))
        for count in range(1, axes + 1):
            quantile = threshold_of(jnp.arange(axes) < count, threshold)
            np.testing.assert_allclose(quantile, chi2.ppf(probability, count), rtol=1e-7)
    assert threshold_of(jnp.arange(axes) < 1, jnp.asarray(np.inf)) == np.inf


# In the filter
# ------------------------------------------------------------------------------------------------

N, CLONES, ROWS, DT = 5, 2, 12, 0.02
# Its update is the textbook's, whose mean moves by addition.
TEXTBOOK = filtering.FilterConfig(DT, N, CLONES, history="core", window_rotation="tlio")
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=1.0)
START, GYRO, ACCEL, DISPLACEMENT, SPREAD = random_walk(5, n=N, clones=CLONES, intervals=ROWS, dt=DT)
STD = filtering.InitialStd(position=0.5, velocity=0.3)


@functools.partial(quick, static_argnames="config")
def run(state, gyro, accel, displacement, covariance, config, fix):
    arguments = state, gyro, accel, displacement, covariance
    return filtering.run_filter(filtering.Filter(config, NOISE), *arguments, measurements=(fix,))


def drawn_fix(rows, seed=3):
    """Fixes near the start of the walk, each with another covariance."""
    rng = np.random.default_rng(seed)
    root = 0.2 * (np.eye(3) + 0.3 * rng.normal(size=(rows, 3, 3)))
    return filtering.Fix(
        START[2] + 0.3 * rng.normal(size=(rows, 3)),
        root @ np.swapaxes(root, 1, 2),
        rng.uniform(-0.05, 0.05, rows),
        np.full(rows, 0.1),
        np.full(rows, chi2.ppf(0.99, 3)),
    )


def test_a_part_of_a_fix_is_the_textbooks_update():
    """By the whole covariance, for every set of components. One component that is 3 standard
    deviations off is refused, although with three components it would pass."""
    state = filtering.initial_state(filtering.Filter(TEXTBOOK, start=STD), *START)
    fixes, covariance = drawn_fix(ROWS), jax.jit(whole_covariance)
    parts = [[0], [1], [2], [0, 1], [0, 2], [1, 2], [0, 1, 2], [], [2], [2], [0, 2], [1]]
    for k, part in enumerate(parts):
        fix = filtering.Fix(*(np.array(column[k : k + 1]) for column in fixes))
        samples, row = slice(N * k, N * (k + 1)), slice(k, k + 1)
        signals = GYRO[samples], ACCEL[samples], DISPLACEMENT[row], SPREAD[row]
        absent = fix._replace(position=np.full((1, 3), NAN))
        without, _ = run(state, *signals, TEXTBOOK, absent)
        before = np.asarray(covariance(without))
        jacobian = np.zeros((len(part), len(before)))
        jacobian[range(len(part)), [6 + axis for axis in part]] = 1.0
        jacobian[range(len(part)), [3 + axis for axis in part]] = -fix.before_end[0]
        shift = fix.time_std[0] * np.asarray(without.velocity)
        spread = (fix.covariance[0] + np.outer(shift, shift))[np.ix_(part, part)]
        spread = spread + jacobian @ before @ jacobian.T
        expected = without.position - fix.before_end[0] * without.velocity
        fix.position[0] += expected - START[2]
        if k in (8, 9):
            fix.position[0] = expected + (2.5, 3.0)[k - 8] * np.sqrt(spread[0, 0])
        fix.position[0, [axis for axis in range(3) if axis not in part]] = NAN
        fix.covariance[0, [axis for axis in range(3) if axis not in part]] = NAN
        residual = (fix.position[0] - expected)[np.array(part, int)]
        nis = residual @ np.linalg.solve(spread, residual) if part else 0.0
        state, history = run(state, *signals, TEXTBOOK, fix)
        outcome = history.outcomes["fix"]
        accepted = bool(part) and nis < chi2.ppf(0.99, max(len(part), 1))
        assert outcome.present[0] == bool(part) and outcome.accepted[0] == accepted
        assert accepted != (k in (7, 9))
        gain = before @ jacobian.T @ np.linalg.inv(spread) * accepted
        np.testing.assert_allclose(
            covariance(state), before - gain @ jacobian @ before, rtol=1e-7, atol=1e-11
        )
        change = gain @ residual
        np.testing.assert_allclose(state.velocity, without.velocity + change[3:6], atol=1e-11)
        np.testing.assert_allclose(state.position, without.position + change[6:9], atol=1e-11)
        np.testing.assert_allclose(outcome.nis[0], nis, rtol=1e-7)
        volume = np.sqrt(np.linalg.det(spread)) if part else 1.0
        np.testing.assert_allclose(outcome.volume[0], volume, rtol=1e-7)


SPOILT = {
    "covariance": [-np.eye(3), np.eye(3) + 0.1 * np.eye(3, k=1), np.diag([1.0, 1.0, NAN])],
    "before_end": [NAN],
    "time_std": [-0.1, np.inf, NAN],
    "threshold": [NAN, -1.0, 0.0],
}
"""Values that no fix has, by its fields."""


def spoilt_fix():
    """A fix of each kind that cannot be, then one without its height and two whole ones; and the
    fields of the former."""
    fix, fields = drawn_fix(ROWS + 1), []
    for field, values in SPOILT.items():
        for value in values:
            getattr(fix, field)[len(fields)] = value
            fields.append(field)
    fix.position[len(fields), 2] = NAN
    return filtering.Fix(*(column[:ROWS] for column in fix)), fields


class Second(filtering.Fix):
    """Fixes of another source: two measurements of a run have two names."""

    name = "second"


def test_a_fix_that_cannot_be_is_refused_by_name():
    state, (fix, fields) = (
        filtering.initial_state(filtering.Filter(TEXTBOOK, start=STD), *START),
        spoilt_fix(),
    )
    good = drawn_fix(ROWS)
    ekf = filtering.Filter(TEXTBOOK, NOISE)
    arguments = ekf, state, GYRO, ACCEL, DISPLACEMENT, SPREAD
    for row, field in enumerate(fields):
        column = np.array(getattr(good, field))
        column[row] = getattr(fix, field)[row]
        spoilt = good._replace(**{field: column})
        text = rf"^measurements\[1\]\.{field}: 1 of {ROWS} rows are not .*, the first is row {row}$"
        for estimate in (filtering.run_filter, filtering.smooth):
            with pytest.raises(ValueError, match=text):
                estimate(*arguments, measurements=(good, Second(*spoilt)))
    for field, shape in (("position", (ROWS, 4)), ("covariance", (ROWS, 2, 2))):
        spoilt = good._replace(**{field: np.ones(shape)})
        with pytest.raises(ValueError, match=rf"^measurements\[0\]\.{field}: the shape must be "):
            filtering.run_filter(*arguments, measurements=(spoilt,))


def test_inside_jit_it_is_none_and_no_derivative_is_spoilt():
    state, (fix, fields) = (
        filtering.initial_state(filtering.Filter(TEXTBOOK, start=STD), *START),
        spoilt_fix(),
    )

    def distance(arguments, fix):
        final, history = filtering.run_filter(
            filtering.Filter(TEXTBOOK, NOISE), *arguments, measurements=(fix,)
        )
        return jnp.sum(final.position**2) + jnp.sum(history.outcomes["fix"].nis), (final, history)

    gradient_of = quick(jax.value_and_grad(distance, (0, 1), has_aux=True, allow_int=True))
    arguments = state, GYRO, ACCEL, np.nan_to_num(DISPLACEMENT), np.tile(np.eye(3), (ROWS, 1, 1))
    (_, (final, history)), gradients = gradient_of(arguments, fix)
    present = np.arange(ROWS) >= len(fields)
    np.testing.assert_array_equal(history.outcomes["fix"].present, present)
    for gradient in jax.tree.leaves(gradients):
        assert gradient.dtype == jax.dtypes.float0 or np.isfinite(gradient).all()
    assert (np.abs(gradients[1].position).max(axis=1) > 0).tolist() == present.tolist()
    absent = fix._replace(position=np.where(present[:, None], fix.position, NAN))
    (_, (expected, _)), _ = gradient_of(arguments, absent)
    for leaf, other in zip(jax.tree.leaves(final), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(leaf, other)
