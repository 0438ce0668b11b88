"""Rotations against SciPy, and their derivatives against differences, limits included."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gnio_jax import geometry

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 9.99e-2, 1.001e-1, 0.7, 3.0, np.pi, 6.0]
AXIS = np.array([0.36, -0.48, 0.8])

exp, right_jacobian = map(jax.jit, (geometry.exp, geometry.right_jacobian))
slope_of_exp = jax.jit(jax.jacrev(geometry.exp))
slope_of_right_jacobian = jax.jit(jax.jacrev(geometry.right_jacobian))
integrate_turns = jax.jit(geometry.integrate_turns)
slopes_of_integrate_turns = jax.jit(jax.jacrev(geometry.integrate_turns, (0, 1)))


@jax.jit
def curvature_of_exp(phi, along):
    slope = lambda p: jax.jvp(geometry.exp, (p,), (along,))[1]  # noqa: E731
    return jax.jvp(slope, (phi,), (along,))[1]


@jax.jit
def yaws(matrix, angle):
    """The yaw of a rotation, the rotation by it, that by an angle, and the slope of the yaw along
    a further turn."""

    def yaw(matrix):
        cosine, sine = geometry.yaw_direction(matrix)
        return jnp.arctan2(sine, cosine)

    further = jax.grad(lambda turn: yaw(geometry.rotation_z(turn) @ matrix))
    results = yaw(matrix), geometry.yaw_rotation(matrix), geometry.rotation_z(angle)
    return *results, further(jnp.asarray(0.01))


def differences(function, x, step=1e-6):
    return np.stack(
        [
            (np.asarray(function(x + step * e)) - np.asarray(function(x - step * e))) / (2 * step)
            for e in np.eye(x.size)
        ],
        -1,
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_its_derivative(angle):
    phi = jnp.asarray(angle * AXIS)
    expected = Rotation.from_rotvec(angle * AXIS).as_matrix()
    np.testing.assert_allclose(exp(phi), expected, atol=2e-15)
    expected = differences(lambda x: Rotation.from_rotvec(x).as_matrix(), angle * AXIS)
    np.testing.assert_allclose(slope_of_exp(phi), expected, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_right_jacobian_and_its_derivative(angle):
    """J_r = ∫₀¹ exp(−s φ) ds, the upper right block of exp([−hat φ, I; 0, 0])."""

    def oracle(phi):
        block = np.zeros((6, 6))
        block[:3, :3], block[:3, 3:] = -np.cross(np.eye(3), phi), np.eye(3)
        return expm(block)[:3, 3:]

    phi = jnp.asarray(angle * AXIS)
    np.testing.assert_allclose(right_jacobian(phi), oracle(angle * AXIS), atol=3e-15)
    expected = differences(oracle, angle * AXIS)
    np.testing.assert_allclose(slope_of_right_jacobian(phi), expected, atol=1e-8)


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_of_a_rigid_motion_and_its_derivative(angle):
    """The upper rows of exp([hat φ, x; 0, 0])."""

    def oracle(twist):
        block = np.zeros((4, 4))
        block[:3, :3], block[:3, 3] = np.cross(np.eye(3), twist[:3]), twist[3:]
        return expm(block)[:3]

    def motion(twist):
        rotation, translation = geometry.exp_rigid(twist[:3], twist[3:])
        return jnp.concatenate([rotation, translation[:, None]], axis=1)

    twist = np.concatenate([angle * AXIS, [0.3, -1.2, 0.5]])
    np.testing.assert_allclose(jax.jit(motion)(twist), oracle(twist), atol=3e-15)
    for jacobian in (jax.jacrev, jax.jacfwd):
        slope = jax.jit(jacobian(motion))(twist)
        np.testing.assert_allclose(slope, differences(oracle, twist), atol=1e-8)


def test_cumulative_rotation():
    for n in (1, 2, 3, 10):
        rng = np.random.default_rng(n)
        phi = rng.standard_normal((n, 3))
        expected = [Rotation.from_rotvec(rng.standard_normal(3))]
        for step in phi:
            expected.append(expected[-1] * Rotation.from_rotvec(step))
        steps = np.moveaxis(Rotation.from_rotvec(phi).as_matrix(), 0, 2)
        matrices = jax.jit(geometry.cumulative_rotation)(expected[0].as_matrix(), steps)
        expected_matrices = [rotation.as_matrix() for rotation in expected]
        np.testing.assert_allclose(np.moveaxis(matrices, 2, 0), expected_matrices, atol=1e-14)


@pytest.mark.parametrize("p,k,q,n", [(3, 4, 2, (5,)), (3, 9, 40, ()), (40, 3, 3, ())])
def test_matmul_is_a_stack_of_products_and_has_its_derivatives(p, k, q, n):
    """In both modes, of short and long contractions, also where one factor is a constant."""
    rng = np.random.default_rng(0)
    a, da = map(jnp.asarray, rng.standard_normal((2, p, k, *n)))
    b, db = map(jnp.asarray, rng.standard_normal((2, k, q, *n)))
    result = rng.standard_normal((p, q, *n))
    product, along = jax.jit(functools.partial(jax.jvp, geometry.matmul))((a, b), (da, db))
    np.testing.assert_allclose(product, np.einsum("pk...,kq...->pq...", a, b), 1e-12, 1e-13)
    expected = np.einsum("pk...,kq...->pq...", da, b) + np.einsum("pk...,kq...->pq...", a, db)
    np.testing.assert_allclose(along, expected, rtol=1e-12, atol=1e-13)

    @jax.jit
    def backwards(a, b, result):
        of_both = jax.vjp(geometry.matmul, a, b)[1](result)
        of_first = jax.vjp(lambda a: geometry.matmul(a, b), a)[1](result)
        of_second = jax.vjp(lambda b: geometry.matmul(a, b), b)[1](result)
        return *of_both, *of_first, *of_second

    by_first = np.einsum("pq...,kq...->pk...", result, b)
    by_second = np.einsum("pk...,pq...->kq...", a, result)
    wanted_ones = (by_first, by_second) * 2
    for gradient, expected_gradient in zip(backwards(a, b, result), wanted_ones, strict=True):
        np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-12, atol=1e-13)


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
    np.testing.assert_allclose(integrate_turns(start, turns), oracle(x), atol=1e-14)
    by_start, by_turns = slopes_of_integrate_turns(start, turns)
    expected = differences(oracle, x)
    np.testing.assert_allclose(by_start.reshape(3, 3, 5, 9), expected[..., :9], atol=1e-9)
    np.testing.assert_allclose(by_turns.reshape(3, 3, 5, 12), expected[..., 9:], atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 9.99e-2, 1.001e-1, 0.7, 3.0])
def test_second_derivative_of_exp(angle):
    """Along one direction E: the top right block of exp([X, E, 0; 0, X, E; 0, 0, X]) is half of
    it."""
    phi, along = angle * AXIS, np.array([0.2, 0.9, -0.4])
    x, e = (np.cross(np.eye(3), v) for v in (phi, along))
    blocks = np.kron(np.eye(3), x) + np.kron(np.eye(3, k=1), e)
    second = curvature_of_exp(phi, along)
    np.testing.assert_allclose(second, 2 * expm(blocks)[:3, 6:], atol=1e-11)


def test_quaternions_are_wxyz():
    rotation = Rotation.from_euler("xyz", [0.4, -1.0, 2.0])
    wxyz = np.roll(rotation.as_quat(), 1)
    matrix = jax.jit(geometry.matrix_from_quaternion)(wxyz)
    np.testing.assert_allclose(matrix, rotation.as_matrix(), atol=1e-15)


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 0.0), (0.5, -0.3, 2.0), (-2.5, 1.2, -3.0), (1.0, 0.1, np.pi)]
)
def test_yaw_is_the_last_extrinsic_euler_angle(angles):
    rotation = Rotation.from_euler("xyz", angles)
    yaw = rotation.as_euler("xyz")[2]
    angle, about_z, by_yaw, slope = yaws(rotation.as_matrix(), yaw)
    expected = Rotation.from_euler("z", yaw).as_matrix()
    np.testing.assert_allclose(np.exp(1j * float(angle)), np.exp(1j * yaw), atol=1e-14)
    np.testing.assert_allclose(about_z, expected, atol=1e-14)
    np.testing.assert_allclose(by_yaw, expected, atol=1e-14)
    np.testing.assert_allclose(slope, 1.0, atol=1e-12)


def test_direction_of_many_vectors_and_of_none():
    x, y = jnp.asarray([3.0, 0.0, -1e-3]), jnp.asarray([-4.0, 0.0, 0.0])
    directions = jax.jit(geometry.direction)(x, y)
    np.testing.assert_allclose(directions, [[0.6, 1, -1], [-0.8, 0, 0]], atol=1e-15)
    slope = jax.jit(jax.vmap(jax.jacrev(geometry.direction, (0, 1))))(x, y)
    np.testing.assert_allclose(slope[0][0], [16 / 125, 0, 0], atol=1e-15)
    np.testing.assert_allclose(slope[1][1], [9 / 125, 0, 1e3], atol=1e-9)


def test_yaw_at_gimbal_lock_is_zero_with_zero_derivative():
    locked = jnp.asarray([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    yaw, about_z, _, _ = yaws(locked, 0.0)
    np.testing.assert_array_equal(about_z, np.eye(3))
    assert float(yaw) == 0.0
    for function in (geometry.yaw_rotation, geometry.yaw_direction):
        for slope in jax.tree.leaves(jax.jit(jax.jacrev(function))(locked)):
            np.testing.assert_array_equal(slope, np.zeros(slope.shape))


def test_shapes_are_checked_while_the_tests_run():
    with pytest.raises(TypeCheckError, match=r"geometry\.exp"):
        geometry.exp(jnp.zeros(4))


@jax.jit
def alignment(x, y, weight):
    """Rotation and shift in one array (6,), and its derivatives by x."""

    def flat(x):
        return jnp.concatenate([part.ravel() for part in geometry.planar_alignment(x, y, weight)])

    return flat(x), jax.jacrev(flat)(x).reshape(6, -1)


@pytest.mark.parametrize("collinear", [False, True])
def test_planar_alignment(collinear):
    rng = np.random.default_rng(0)
    weight = rng.uniform(0.1, 2, 6)
    x = np.outer(rng.normal(size=6), [2.0, 1.0]) if collinear else rng.normal(size=(6, 2))
    turned = lambda x, angle: x @ Rotation.from_euler("z", angle).as_matrix()[:2, :2].T  # noqa: E731
    y = turned(x, 2.5) + [30.0, -4.0] + 0.1 * rng.normal(size=x.shape)
    error = lambda p: (np.sqrt(weight)[:, None] * (y - turned(x, p[0]) - p[1:])).ravel()  # noqa: E731
    angle, *shift = least_squares(error, [2.0, 0.0, 0.0], xtol=1e-15, gtol=1e-15).x
    transform, derivatives = alignment(x, y, weight)
    expected = [*turned(np.eye(2), angle).T.ravel(), *shift]
    np.testing.assert_allclose(transform, expected, atol=1e-6)
    slopes = differences(lambda x: alignment(x.reshape(6, 2), y, weight)[0], x.ravel())
    np.testing.assert_allclose(derivatives, slopes, atol=1e-7)


def test_planar_alignment_without_a_direction():
    """One point, points in one place, and targets in one place: a shift alone, with derivatives of
    its own."""
    rng = np.random.default_rng(1)
    x, same = rng.normal(size=(3, 2)), np.tile([1.0, 2.0], (3, 1))
    alone, alike = np.array([0, 1.0, 0]), np.ones(3)
    for source, target, weight in [(x, x + 5, alone), (same, x, alike), (x, same, alike)]:
        transform, derivatives = alignment(source, target, weight)
        np.testing.assert_array_equal(transform[:4], np.eye(2).ravel())
        np.testing.assert_allclose(
            transform[4:], np.average(target - source, 0, weight), atol=1e-12
        )
        slopes = -np.kron(weight / weight.sum(), np.eye(2))
        np.testing.assert_allclose(derivatives, np.vstack([np.zeros((4, 6)), slopes]), atol=1e-12)
