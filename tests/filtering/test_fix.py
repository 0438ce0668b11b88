"""Fixes of position: against the dense filter in NumPy, and as they are laid and refused. The
smoother with fixes is in `test_smoother`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.errors import InputError
from tests.support import scekf_numpy
from tests.support.compiling import quick
from tests.support.random_walk import random_walk

N, CLONES, INTERVALS, DT = 5, 4, 40, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, history="core", convergence_seconds=1.0)
NOISE = filtering.NoiseModel.per_sample(4e-3, 2e-2, DT, 2e-3, 3e-3)
STD = filtering.InitialStd(0.02, 0.1, 0.3, 0.5, 2e-3, 0.05)
START, *GIVEN = random_walk(
    1, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, nan_rows=(9, 10), outliers=(25,)
)
NAMES = ("rotation", "velocity", "position", "gyro_bias", "accel_bias")
FAR = 23
LENGTH = N * DT


@functools.cache
def run():
    """(fixes,) or () -> the history; one program for each tree."""
    state = filtering.initial_state(CONFIG, *START, std=STD)
    return quick(
        lambda measurements: filtering.run_filter(
            state, *GIVEN, CONFIG, NOISE, measurements=measurements
        )
    )


def drawn(axes):
    """{k: (position, covariance, seconds before the end, standard deviation of the time)} near to
    where the filter without fixes is, before the ring is full and after each move of the anchor;
    the one of interval `FAR` is a kilometre off."""
    rng, (_, history) = np.random.default_rng(axes), run()(())
    fixes = {}
    for k in (0, 2, 7, 8, 11, FAR, 24, 30, 38):
        root = 0.2 * (np.eye(axes) + 0.3 * rng.normal(size=(axes, axes)))
        before = rng.uniform(-0.5, 0.5) * LENGTH * (k > 0)
        z = np.asarray(history.position[k] - before * history.velocity[k])[:axes]
        z = z + root @ rng.normal(size=axes)
        z[0] += 1000.0 * (k == FAR)
        fixes[k] = z, root @ root.T, before, 0.1
    return fixes


def laid(fixes, start=0.0):
    time = [start + (k + 1) * LENGTH - before for k, (_, _, before, _) in fixes.items()]
    position, covariance, _, late = (np.stack(x) for x in zip(*fixes.values(), strict=True))
    return filtering.fixes_on_intervals(
        time, position, covariance, INTERVALS, CONFIG, start, late[0]
    )


@pytest.mark.parametrize("axes", [2, 3])
def test_equals_the_dense_filter(axes):
    """Over all moves of the anchor; one that is a kilometre off is refused, and counted."""
    fixes = drawn(axes)
    state = filtering.initial_state(CONFIG, *START, std=STD)
    _, history = run()((laid(fixes, start=100.0),))
    wanted = scekf_numpy.run_from(state, NOISE, CONFIG, *GIVEN, std=STD._asdict(), fixes=fixes)
    (outcome,) = history.others
    there = np.isfinite(wanted["fix_nis"])
    np.testing.assert_array_equal(outcome.present, there)
    assert np.flatnonzero(there & ~np.asarray(outcome.accepted)).tolist() == [FAR]
    np.testing.assert_allclose(outcome.nis[there], wanted["fix_nis"][there], rtol=1e-6)
    np.testing.assert_array_equal(history.accepted, wanted["accepted"])
    for name in NAMES:
        np.testing.assert_allclose(getattr(history, name), wanted[name], atol=1e-8, err_msg=name)
    sigma = np.sqrt(wanted["covariance_diagonal"])
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(history.covariance / scale, wanted["covariance"] / scale, atol=1e-6)


def test_without_a_fix_nothing_changes():
    """To the last bit, also where the only one is refused."""
    none = laid(drawn(2))
    none.position[:] = np.nan
    none.position[FAR] = 1e6
    for found, wanted in zip(
        jax.tree.leaves(run()((none,))[1]._replace(others=())),
        jax.tree.leaves(run()(())[1]._replace(others=())),
        strict=True,
    ):
        np.testing.assert_array_equal(found, wanted)


def test_gradient():
    """Of the track in a fix's position, covariance, moment and the spread of its moment, against
    differences; intervals without a fix have a gradient of zero."""
    fix = laid(drawn(2))
    state = filtering.initial_state(CONFIG, *START, std=STD)

    def loss(x):
        moved = filtering.Fix(
            jnp.asarray(fix.position) + x[0],
            jnp.asarray(fix.covariance) * (1 + x[1]),
            jnp.asarray(fix.before_end) + x[2],
            jnp.asarray(fix.time_std) + x[3],
            fix.threshold,
        )
        _, history = filtering.run_filter(state, *GIVEN, CONFIG, NOISE, measurements=(moved,))
        return jnp.sum(history.position**2)

    value_and_gradient = quick(jax.value_and_grad(loss))
    gradient = np.asarray(value_and_gradient(jnp.zeros(4))[1])
    steps = 1e-5 * np.eye(4)
    wanted = [
        (float(value_and_gradient(e)[0]) - float(value_and_gradient(-e)[0])) / 2e-5 for e in steps
    ]
    assert (np.abs(wanted) > 1e-3).all()
    np.testing.assert_allclose(gradient, wanted, rtol=1e-5)


def test_each_lies_in_the_interval_whose_end_is_nearest():
    """Of 0.1 s; one before the middle of the first interval lies in that."""
    time, rows = [5.02, 5.44, 5.46, 9.0, 6.2], [0, 3, 4, 39, 11]
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


def test_two_in_an_interval_become_one():
    """The same as one after the other for a filter at a constant velocity, where their covariances
    are of one shape: the information is the sum, and so is what it says of p − a v."""
    shape = np.array([[0.4, 0.1, 0.0], [0.1, 0.3, 0.0], [0.0, 0.0, 0.2]])
    time, size = [0.98, 1.03], np.array([1.0, 3.0])
    position, covariance = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 5.0]]), size[:, None, None] * shape
    fix = filtering.fixes_on_intervals(time, position, covariance, INTERVALS, CONFIG)
    assert np.isfinite(fix.position).all(1).sum() == 1
    np.testing.assert_allclose(fix.covariance[9], shape / (1 + 1 / 3))
    np.testing.assert_allclose(fix.position[9], [1.25, 2.0, 3.5])
    np.testing.assert_allclose(fix.before_end[9], 0.75 * 0.02 - 0.25 * 0.03)


@pytest.mark.parametrize(
    "change, text",
    [
        (
            dict(time=[0.5, 99.0]),
            "fixes: 1 of 2 are outside of the recording, one at 99 s; it lasts",
        ),
        (dict(time=[0.5, np.nan]), "fixes: 1 of 2 are outside of the recording, one at nan s"),
        (dict(start=-1e9), "fixes: 2 of 2 are outside of the recording"),
        (dict(time=[0.5]), "fixes: time, position and covariance must be"),
        (dict(position=np.zeros((2, 4))), "fixes: time, position and covariance must be"),
        (dict(position=np.zeros((2, 3))), "fixes: time, position and covariance must be"),
        (dict(time_std=[0.1, -0.1]), "fixes: time_std must be at least 0"),
        (dict(covariance=np.zeros((2, 2, 2))), "fixes: a covariance is not symmetric and positive"),
        (
            dict(covariance=np.array([np.eye(2), [[1.0, 0.5], [0.0, 1.0]]])),
            "fixes: a covariance is not symmetric and positive",
        ),
    ],
)
def test_what_is_no_fix_is_refused_in_one_line(change, text):
    good = dict(
        time=[0.5, 1.0], position=np.zeros((2, 2)), covariance=np.tile(np.eye(2), (2, 1, 1))
    )
    with pytest.raises(InputError, match=f"^{text}") as caught:
        filtering.fixes_on_intervals(**(good | change), intervals=INTERVALS, config=CONFIG)
    assert "\n" not in str(caught.value)
