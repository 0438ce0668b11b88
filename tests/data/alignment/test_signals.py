"""Parts that the fits share, against closed forms."""

from __future__ import annotations

import numpy as np

from gnio_jax.data.alignment import signals


def test_hat_functions_are_linear_interpolation():
    time = np.linspace(2.0, 33.0, 400)
    knots = signals.uniform_knots(time, 10.0)
    assert (
        len(knots) == 5 and np.diff(knots).max() <= 10.0 and knots[0] == 2.0 and knots[-1] == 33.0
    )
    values = np.random.default_rng(0).standard_normal(len(knots))
    hats = signals.hat_functions(time, knots)
    np.testing.assert_allclose(hats @ values, np.interp(time, knots, values), atol=1e-12)


def test_second_difference_is_exact_for_a_parabola_and_zero_for_a_constant():
    time = np.arange(0.0, 5.0, 0.01)
    parabola = np.stack([0.5 * 3.0 * time**2, 7.0 - time], axis=1)
    np.testing.assert_allclose(
        signals.second_difference(parabola, 0.01), np.tile([3.0, 0.0], (len(time), 1)), atol=1e-9
    )
    assert (signals.second_difference(np.full((9, 1), np.pi), 0.01) == 0.0).all()


def test_bending_is_free_for_a_line_and_costs_a_kink_its_square():
    precision = signals.bending(4, 0.5)
    line = np.array([1.0, 3.0, 5.0, 7.0])
    np.testing.assert_allclose(precision @ line, 0.0, atol=1e-12)
    kink = np.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(kink @ precision @ kink, 4.0)
    assert not signals.bending(2, 0.5).any()


def test_cauchy_weights_forgive_a_flip():
    error = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 300.0, 0.0]])
    np.testing.assert_allclose(signals.cauchy_weights(error, 1.0), [1.0, 0.5, 1 / 10001.0])


def test_covered_keeps_a_margin():
    clock = np.array([0.0, 10.0])
    times = np.array([-1.0, 0.5, 1.5, 8.9, 9.5, 11.0])
    inside = signals.covered(times, clock, margin=1.0)
    np.testing.assert_array_equal(inside, [False, False, True, True, False, False])
