"""Rotations against SciPy, and their derivatives against differences, limits included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gnio_jax import geometry

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 9.99e-2, 1.001e-1, 0.7, 3.0, np.pi, 6.0]
AXIS = np.array([0.36, -0.48, 0.8])


def differences(function, x, step=1e-6):
    return np.stack(
        [
            (np.asarray(function(x + step * e)) - np.asarray(function(x - step * e))) / (2 * step)
            for e in np.eye(x.size)
        ],
        -1,
    )


def test_hat_is_the_cross_product():
    v, w = np.array([1.0, 2.0, 3.0]), np.array([-2.0, 0.5, 4.0])
    np.testing.assert_allclose(geometry.hat(jnp.asarray(v)) @ w, np.cross(v, w))


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_its_derivative(angle):
    phi = jnp.asarray(angle * AXIS)
    np.testing.assert_allclose(
        geometry.exp(phi), Rotation.from_rotvec(angle * AXIS).as_matrix(), atol=2e-15
    )
    expected = differences(lambda x: Rotation.from_rotvec(x).as_matrix(), angle * AXIS)
    np.testing.assert_allclose(jax.jacrev(geometry.exp)(phi), expected, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_right_jacobian_and_its_derivative(angle):
    """J_r = ∫₀¹ exp(−s φ) ds, the upper right block of exp([−hat φ, I; 0, 0])."""

    def oracle(phi):
        block = np.zeros((6, 6))
        block[:3, :3], block[:3, 3:] = -np.cross(np.eye(3), phi), np.eye(3)
        return expm(block)[:3, 3:]

    phi = jnp.asarray(angle * AXIS)
    np.testing.assert_allclose(geometry.right_jacobian(phi), oracle(angle * AXIS), atol=3e-15)
    np.testing.assert_allclose(
        jax.jacrev(geometry.right_jacobian)(phi), differences(oracle, angle * AXIS), atol=1e-8
    )


def test_right_jacobian_by_its_definition():
    phi, delta = np.array([0.5, -1.2, 0.8]), 1e-6 * np.array([1.0, -2.0, 0.5])
    turned = geometry.exp(jnp.asarray(phi)).T @ geometry.exp(jnp.asarray(phi + delta))
    wanted = geometry.right_jacobian(jnp.asarray(phi)) @ delta
    np.testing.assert_allclose(
        Rotation.from_matrix(np.array(turned)).as_rotvec(), wanted, atol=1e-11
    )


@pytest.mark.parametrize("dtype,tolerance", [(jnp.float64, 1e-14), (jnp.float32, 1e-6)])
def test_dtype_is_kept(dtype, tolerance):
    phi = jnp.asarray([0.02, 0.01, -0.03], dtype)
    for function in (
        geometry.exp,
        geometry.right_jacobian,
        geometry.hat,
        lambda v: geometry.log(geometry.exp(v)),
        lambda v: geometry.yaw_rotation(geometry.exp(v)),
        lambda v: geometry.quaternion_from_matrix(geometry.exp(v)),
    ):
        assert function(phi).dtype == dtype
    np.testing.assert_allclose(geometry.exp(phi) @ geometry.exp(-phi), np.eye(3), atol=tolerance)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 10])
def test_cumulative_rotation(n):
    rng = np.random.default_rng(n)
    phi = rng.standard_normal((n, 3))
    start = Rotation.from_rotvec(rng.standard_normal(3))
    expected = [start]
    for step in phi:
        expected.append(expected[-1] * Rotation.from_rotvec(step))
    found = geometry.cumulative_rotation(
        jnp.asarray(start.as_matrix()), jax.vmap(geometry.exp, out_axes=2)(jnp.asarray(phi))
    )
    np.testing.assert_allclose(
        np.moveaxis(found, 2, 0), [rotation.as_matrix() for rotation in expected], atol=1e-14
    )


def test_matmul_is_a_stack_of_products():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((3, 4, 5)), rng.standard_normal((4, 2, 5))
    np.testing.assert_allclose(
        geometry.matmul(jnp.asarray(a), jnp.asarray(b)), np.einsum("pkn,kqn->pqn", a, b), rtol=1e-13
    )


@pytest.mark.parametrize("p,k,q,n", [(3, 4, 2, (5,)), (3, 9, 40, ()), (40, 3, 3, ())])
def test_derivatives_of_matmul(p, k, q, n):
    """In both modes, of short and long contractions, also where one factor is a constant."""
    rng = np.random.default_rng(0)
    a, da = map(jnp.asarray, rng.standard_normal((2, p, k, *n)))
    b, db = map(jnp.asarray, rng.standard_normal((2, k, q, *n)))
    result = rng.standard_normal((p, q, *n))
    _, along = jax.jvp(geometry.matmul, (a, b), (da, db))
    expected = np.einsum("pk...,kq...->pq...", da, b) + np.einsum("pk...,kq...->pq...", a, db)
    np.testing.assert_allclose(along, expected, rtol=1e-12, atol=1e-13)
    of_both = jax.vjp(geometry.matmul, a, b)[1](result)
    of_first = jax.vjp(lambda a: geometry.matmul(a, b), a)[1](result)
    of_second = jax.vjp(lambda b: geometry.matmul(a, b), b)[1](result)
    by_first = np.einsum("pq...,kq...->pk...", result, b)
    by_second = np.einsum("pk...,pq...->kq...", a, result)
    for found, wanted in zip(
        (*of_both, *of_first, *of_second), (by_first, by_second) * 2, strict=True
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.7])
def test_integrate_turns_and_its_derivative(angle):
    """Against the product of exponentials, also off the rotations, where the start is any matrix
    near to one."""
    rng = np.random.default_rng(1)
    turns = angle * rng.standard_normal((4, 3))
    start = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()

    def oracle(x):
        rotations = [x[:9].reshape(3, 3)]
        for turn in x[9:].reshape(-1, 3):
            rotations.append(rotations[-1] @ Rotation.from_rotvec(turn).as_matrix())
        return np.stack(rotations, -1)

    x = np.concatenate([start.ravel(), turns.ravel()])
    given = jnp.asarray(start), jnp.asarray(turns)
    np.testing.assert_allclose(geometry.integrate_turns(*given), oracle(x), atol=1e-14)
    by_start, by_turns = jax.jacrev(geometry.integrate_turns, (0, 1))(*given)
    expected = differences(oracle, x)
    np.testing.assert_allclose(by_start.reshape(3, 3, 5, 9), expected[..., :9], atol=1e-9)
    np.testing.assert_allclose(by_turns.reshape(3, 3, 5, 12), expected[..., 9:], atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 9.99e-2, 1.001e-1, 0.7, 3.0])
def test_second_derivative_of_exp(angle):
    """Along one direction E: the top right block of exp([X, E, 0; 0, X, E; 0, 0, X]) is half of
    it."""
    phi, along = jnp.asarray(angle * AXIS), jnp.asarray([0.2, 0.9, -0.4])
    x, e = (np.cross(np.eye(3), v) for v in (phi, along))
    blocks = np.kron(np.eye(3), x) + np.kron(np.eye(3, k=1), e)
    _, second = jax.jvp(lambda p: jax.jvp(geometry.exp, (p,), (along,))[1], (phi,), (along,))
    np.testing.assert_allclose(second, 2 * expm(blocks)[:3, 6:], atol=1e-11)


@pytest.mark.parametrize("angle", [1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-4])
def test_log_inverts_exp(angle):
    phi = angle * AXIS
    np.testing.assert_allclose(
        geometry.log(jnp.asarray(Rotation.from_rotvec(phi).as_matrix())), phi, atol=1e-12
    )
    jacobian = jax.jacrev(lambda x: geometry.log(geometry.exp(x)))(jnp.asarray(phi))
    np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-6)


def test_log_and_quaternion_have_finite_derivatives_at_the_identity():
    for function in (geometry.log, geometry.quaternion_from_matrix):
        assert np.isfinite(jax.jacrev(function)(jnp.eye(3))).all()
        assert np.isfinite(jax.jacrev(function)(jnp.diag(jnp.asarray([1.0, -1.0, -1.0])))).all()


def test_quaternions_are_wxyz():
    rotation = Rotation.from_euler("xyz", [0.4, -1.0, 2.0])
    wxyz = np.roll(rotation.as_quat(), 1)
    np.testing.assert_allclose(
        geometry.matrix_from_quaternion(jnp.asarray(wxyz)), rotation.as_matrix(), atol=1e-15
    )
    found = np.asarray(geometry.quaternion_from_matrix(jnp.asarray(rotation.as_matrix())))
    np.testing.assert_allclose(found * np.sign(found @ wxyz), wxyz, atol=1e-15)


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 0.0), (0.5, -0.3, 2.0), (-2.5, 1.2, -3.0), (1.0, 0.1, np.pi)]
)
def test_yaw_is_the_last_extrinsic_euler_angle(angles):
    rotation = Rotation.from_euler("xyz", angles)
    yaw = rotation.as_euler("xyz")[2]
    matrix = jnp.asarray(rotation.as_matrix())
    np.testing.assert_allclose(
        np.exp(1j * float(geometry.yaw(matrix))), np.exp(1j * yaw), atol=1e-14
    )
    np.testing.assert_allclose(
        geometry.yaw_rotation(matrix), Rotation.from_euler("z", yaw).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(
        geometry.rotation_z(jnp.asarray(yaw)), Rotation.from_euler("z", yaw).as_matrix(), atol=1e-14
    )
    slope = jax.grad(lambda angle: geometry.yaw(geometry.rotation_z(angle) @ matrix))(
        jnp.asarray(0.01)
    )
    np.testing.assert_allclose(slope, 1.0, atol=1e-12)


def test_direction_of_many_vectors_and_of_none():
    x, y = jnp.asarray([3.0, 0.0, -1e-3]), jnp.asarray([-4.0, 0.0, 0.0])
    np.testing.assert_allclose(geometry.direction(x, y), [[0.6, 1, -1], [-0.8, 0, 0]], atol=1e-15)
    slope = jax.vmap(jax.jacrev(geometry.direction, (0, 1)))(x, y)
    np.testing.assert_allclose(slope[0][0], [16 / 125, 0, 0], atol=1e-15)
    np.testing.assert_allclose(slope[1][1], [9 / 125, 0, 1e3], atol=1e-9)


def test_yaw_at_gimbal_lock_is_zero_with_zero_derivative():
    locked = jnp.asarray([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(geometry.yaw_rotation(locked), np.eye(3))
    np.testing.assert_array_equal(jax.jacrev(geometry.yaw_rotation)(locked), np.zeros((3, 3, 3, 3)))
    assert float(geometry.yaw(locked)) == 0.0 and np.isfinite(jax.grad(geometry.yaw)(locked)).all()


def test_shapes_are_checked_while_the_tests_run():
    with pytest.raises(TypeCheckError, match=r"geometry\.exp"):
        geometry.exp(jnp.zeros(4))
