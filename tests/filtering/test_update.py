"""The algebra of an update against NumPy and differences, and the memory of the χ² gate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.displacement import innovation_gate
from gnio_jax.filtering.update import downdate, whiten

ROOT = np.array([[0.3, 0.0, 0.0], [0.1, 0.5, 0.0], [-0.2, 0.4, 0.2]])
COVARIANCE = ROOT @ ROOT.T


ROWS = np.random.default_rng(0).standard_normal((3, 7))


def whitened(s, rows):
    """L⁻¹ rows and √det S in one vector, by NumPy."""
    root = np.linalg.cholesky(s)
    return np.append(np.linalg.solve(root, rows), np.prod(np.diag(root)))


@pytest.mark.parametrize("size", [1, 2, 3])
def test_whiten_and_its_derivatives(size):
    """In both modes, along symmetric changes of S; of several rows that share it."""
    covariance, all_rows = COVARIANCE[:size, :size], ROWS[:size]

    def flat(s, rows):
        (left, right), volume = whiten(s, (rows[:, :2], rows[:, 2:]))
        return jnp.append(jnp.concatenate([left, right], axis=1), volume)

    @jax.jit
    def with_derivatives(given, change):
        return flat(*given), jax.jvp(flat, given, change)[1], jax.jacrev(flat, (0, 1))(*given)

    change = np.array([[0.2, -0.1, 0.05], [-0.1, 0.3, 0.15], [0.05, 0.15, -0.1]])[:size, :size]
    ahead, behind = (
        whitened(covariance + step * change, (1 + step) * all_rows) for step in (1e-6, -1e-6)
    )
    expected = (ahead - behind) / 2e-6
    found, forward, (by_s, by_rows) = with_derivatives((covariance, all_rows), (change, all_rows))
    np.testing.assert_allclose(found, whitened(covariance, all_rows), rtol=1e-13)
    reverse = np.tensordot(by_s, change, 2) + np.tensordot(by_rows, all_rows, 2)
    np.testing.assert_allclose(forward, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(reverse, expected, rtol=1e-6, atol=1e-6)
    assert not np.isfinite(whiten(jnp.asarray(-covariance), ())[1])


def test_downdate_and_its_derivatives():
    rng = np.random.default_rng(1)
    shapes = (5, 5), (3, 5)
    given, change = ([rng.standard_normal(shape) for shape in shapes] for _ in range(2))
    result = rng.standard_normal((5, 5))
    (covariance, rows), (d_covariance, d_rows) = given, change

    @jax.jit
    def with_derivatives(given, change, result):
        return jax.jvp(downdate, given, change), jax.vjp(downdate, *given)[1](result)

    (found, along), (by_covariance, by_rows) = with_derivatives(given, change, result)
    np.testing.assert_allclose(found, covariance - rows.T @ rows, rtol=1e-12, atol=1e-14)
    expected = d_covariance - d_rows.T @ rows - rows.T @ d_rows
    np.testing.assert_allclose(along, expected, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(by_covariance, result)
    np.testing.assert_allclose(by_rows, -rows @ (result + result.T), rtol=1e-12, atol=1e-13)


def test_gate_boundaries_count_samples():
    """Strict comparisons at exact multiples of dt = 0.1 s, where a running sum of dt errs:
    convergence, age of success, end of pause."""
    seconds = dict(convergence_seconds=0.3, success_seconds=0.7, pause_seconds=1.2)
    config = filtering.FilterConfig(0.1, 1, 1, **seconds)
    gate = jax.jit(lambda memory, *given: innovation_gate(memory, config, *given))

    def step(memory, now, nis=20.0, tested=True):
        memory = filtering.GateState(*map(jnp.asarray, memory))
        memory, weight = gate(memory, *map(jnp.asarray, (now, nis, tested)))
        return tuple(int(value) for value in memory), weight == 1

    # The oldest clone is exactly 0.3 s old: not yet converged, a success; then older.
    assert step((False, -1, 0), 4) == ((0, 4, 0), True)
    assert step((False, -1, 0), 5) == ((1, -1, 0), False)
    assert step((True, 10, 0), 17) == ((1, 10, 0), False)  # exactly 0.7 s old: still active
    assert step((True, 10, 0), 18) == ((1, 18, 30), True)  # older: passes, pause of 1.2 s
    assert step((True, 18, 30), 29) == ((1, 29, 30), True)  # inside the pause
    assert step((True, 29, 30), 30) == ((1, 29, 30), False)  # exactly at its end
    assert step((True, 29, 30), 30, nis=11.3) == ((1, 30, 30), True)
    # no measurement: the last success moves along, if there was one
    assert step((True, 10, 0), 40, tested=False) == ((1, 11, 0), False)
    assert step((True, -1, 0), 40, tested=False) == ((1, -1, 0), False)
    assert step((True, -1, 0), 40) == ((1, -1, 0), False)
