"""Rotations of the method: gravity and yaw frames, quaternions, the right Jacobian, on top of jaxlie.

Every function acts on one element (use `jax.vmap` for more) unless its shape says otherwise, keeps the
dtype of its input and has finite derivatives at its singular points.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Float

Scalar = Float[jax.Array, ""]
Vector = Float[jax.Array, "3"]
Matrix = Float[jax.Array, "3 3"]
Quaternion = Float[jax.Array, "4"]


def hat(v: Vector) -> Matrix:
    """The cross-product matrix: hat(v) w = v × w."""
    zero = jnp.zeros_like(v[0])
    return jnp.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


def exp(phi: Vector) -> Matrix:
    """Rotation by the rotation vector `phi` (rad)."""
    return jaxlie.SO3.exp(phi).as_matrix()


def log(rotation: Matrix) -> Vector:
    """Rotation vector (rad, norm ≤ π) of a rotation matrix."""
    return jaxlie.SO3.from_matrix(rotation).log()


def cumulative_rotation(phi: Float[jax.Array, "n 3"]) -> Float[jax.Array, "n+1 3 3"]:
    """I, exp(φ_0), exp(φ_0) exp(φ_1), …: the rotation since the start before each of n steps and after the last.

    The products are formed in about log2(n) rounds over the whole array, each doubling the reach of every product.
    """
    turns = jaxlie.SO3.exp(phi).wxyz
    reach = 1
    while reach < turns.shape[0]:
        turns = jnp.concatenate([turns[:reach], _quaternion_product(turns[:-reach], turns[reach:])])
        reach *= 2
    return jnp.concatenate([jnp.eye(3, dtype=phi.dtype)[None], jaxlie.SO3(turns).as_matrix()])


def _quaternion_product(a: Float[jax.Array, "n 4"], b: Float[jax.Array, "n 4"]) -> Float[jax.Array, "n 4"]:
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return jnp.stack([aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
                      aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw], axis=1)


def matrix_from_quaternion(wxyz: Quaternion) -> Matrix:
    """Rotation matrix of a unit quaternion wxyz."""
    return jaxlie.SO3(wxyz).as_matrix()


def quaternion_from_matrix(rotation: Matrix) -> Quaternion:
    """Unit quaternion wxyz of a rotation matrix."""
    return jaxlie.SO3.from_matrix(rotation).wxyz


def right_jacobian(phi: Vector) -> Matrix:
    """J_r(φ): exp(φ + δ) ≈ exp(φ) exp(J_r(φ) δ).

    J_r = I − (1 − cos θ)/θ² hat(φ) + (θ − sin θ)/θ³ hat(φ)²; below θ² = 1e-4 (1e-2 in float32, where 1 − cos θ
    has few digits left) the series takes over, so that the derivative at zero is the true one.
    """
    squared = jnp.dot(phi, phi)
    small = squared < (1e-4 if phi.dtype == jnp.float64 else 1e-2)
    safe = jnp.where(small, 1.0, squared)
    theta = jnp.sqrt(safe)
    first = jnp.where(small, 0.5 - squared / 24 + squared**2 / 720, (1 - jnp.cos(theta)) / safe)
    second = jnp.where(small, 1 / 6 - squared / 120 + squared**2 / 5040, (theta - jnp.sin(theta)) / (safe * theta))
    cross = hat(phi)
    return jnp.eye(3, dtype=phi.dtype) - first * cross + second * (cross @ cross)


def yaw_direction(rotation: Matrix) -> tuple[Scalar, Scalar]:
    """(cos, sin) of the yaw of `rotation`, yaw = atan2(R[1,0], R[0,0]).

    At gimbal lock (both entries zero) the yaw is undefined: (1, 0) is returned, with zero derivative.
    """
    x, y = rotation[0, 0], rotation[1, 0]
    squared = x * x + y * y
    locked = squared < 1e-14
    norm = jnp.sqrt(jnp.where(locked, 1.0, squared))
    return jnp.where(locked, 1.0, x / norm), jnp.where(locked, 0.0, y / norm)


def yaw(rotation: Matrix) -> Scalar:
    """Yaw angle of a body→world rotation, rad, in (−π, π]."""
    cosine, sine = yaw_direction(rotation)
    return jnp.arctan2(sine, cosine)


def rotation_z(angle: Scalar) -> Matrix:
    """Rotation by `angle` (rad) about the world's z axis."""
    return _rotation_z(jnp.cos(angle), jnp.sin(angle))


def yaw_rotation(rotation: Matrix) -> Matrix:
    """R_γ(R): the rotation by the yaw of `rotation` about z."""
    return _rotation_z(*yaw_direction(rotation))


def _rotation_z(cosine: Scalar, sine: Scalar) -> Matrix:
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    return jnp.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]])
