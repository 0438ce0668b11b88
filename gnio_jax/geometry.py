"""Rotations of the method: the exponential map, its right Jacobian, gravity and yaw frames.

Every function acts on one element (use `jax.vmap` for more) unless its shape says otherwise, keeps
the dtype of its input and has finite derivatives at its singular points.

The functions that the filter calls most have a derivative of their own (`jax.custom_jvp`), in both
modes. It keeps whole matrices for the backward pass, while JAX would keep every term of a sum that
is written out. It costs a few operations, while the transpose of such a sum costs dozens.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

Scalar = Float[jax.Array, ""]
Vector = Float[jax.Array, "3"]
Matrix = Float[jax.Array, "3 3"]
Quaternion = Float[jax.Array, "4"]


_GENERATORS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ]
)
"""hat of the unit vectors. Sums over three are written out in this file, because XLA fuses them,
while a reduction can become a library call."""


@jax.custom_jvp
def hat(v: Vector) -> Matrix:
    """The cross-product matrix: hat(v) w = v × w."""
    x, y, z = jnp.split(v[:, None], 3)
    of_x, of_y, of_z = _GENERATORS.astype(v.dtype)
    return x * of_x + y * of_y + z * of_z


@hat.defjvp
def _hat_jvp(primals: tuple, tangents: tuple) -> tuple[Matrix, Matrix]:
    (v,), (dv,) = primals, tangents
    return hat(v), jnp.sum(_GENERATORS.astype(v.dtype) * dv[:, None, None], axis=0)


@jax.custom_jvp
def _series(squared: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ from θ².

    The quotients lose digits as θ → 0 and have no derivative there, so below θ² = 1e-2 the power
    series takes over, to the last bit.
    """
    small, x, safe = _small_or_safe(squared)
    half = 0.5 * jnp.sqrt(safe)
    sine, cosine = jnp.sin(half), jnp.cos(half)
    first = sine * cosine / half
    return (
        jnp.where(small, 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72))), first),
        jnp.where(
            small, 0.5 - x / 24 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))), 2 * sine**2 / safe
        ),
        jnp.where(
            small, 1 / 6 - x / 120 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))), (1 - first) / safe
        ),
    )


def _small_or_safe(squared: Scalar) -> tuple[jax.Array, Scalar, Scalar]:
    """Whether θ² is small; θ² if it is small, else 0; θ² if it is not small, else 1."""
    small = squared < 1e-2
    return small, jnp.where(small, squared, 0.0), jnp.where(small, 1.0, squared)


@_series.defjvp
def _series_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    (squared,), (d_squared,) = primals, tangents
    values = _series(squared)
    slopes = _series_slopes(squared, *values[1:])
    return values, tuple(slope * d_squared for slope in slopes)


def _series_slopes(
    squared: Scalar, versine: Scalar, excess: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """The derivatives of the three by θ². With c_n = Σ_k (−θ²)^k / (2k + n)!, the three are c_1,
    c_2, c_3, and the derivative of c_n is (n c_{n+2} − c_{n+1}) / 2."""
    small, x, safe = _small_or_safe(squared)
    fourth = jnp.where(
        small, 1 / 24 - x / 720 * (1 - x / 56 * (1 - x / 90)), (0.5 - versine) / safe
    )
    fifth = jnp.where(
        small, 1 / 120 - x / 5040 * (1 - x / 72 * (1 - x / 110)), (1 / 6 - excess) / safe
    )
    return 0.5 * (excess - versine), fourth - 0.5 * excess, 0.5 * (3 * fifth - fourth)


def _polynomial(phi: Vector, squared: Scalar, first: Scalar, second: Scalar) -> Matrix:
    """I + first · hat(φ) + second · hat(φ)², the second power being φφᵀ − θ² I."""
    eye = np.eye(3, dtype=phi.dtype)
    return (1 - second * squared) * eye + first * hat(phi) + second * (phi[:, None] * phi[None, :])


@jax.jit
def exp(phi: Vector) -> Matrix:
    """Rotation by the rotation vector `phi` (rad): I + sin θ/θ hat(φ) + (1 − cos θ)/θ² hat(φ)²."""
    squared = jnp.sum(phi * phi)
    sine, versine, _ = _series(squared)
    return _polynomial(phi, squared, sine, versine)


@jax.custom_jvp
def matmul(
    a: Float[jax.Array, "p k *n"], b: Float[jax.Array, "k q *n"]
) -> Float[jax.Array, "p q *n"]:
    """a b for small matrices stacked along trailing axes, as a sum that XLA fuses with neighbouring
    operations; a dot would be a library call."""
    columns, rows = jnp.split(a, a.shape[1], axis=1), jnp.split(b, b.shape[0], axis=0)
    return functools.reduce(jnp.add, map(jnp.multiply, columns, rows))


@functools.partial(matmul.defjvp, symbolic_zeros=True)
def _matmul_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    (a, b), (da, db) = primals, tangents
    terms = []
    if not isinstance(da, SymbolicZero):
        terms.append(contract_left(da, b))
    if not isinstance(db, SymbolicZero):
        terms.append(contract_right(a, db))
    return matmul(a, b), functools.reduce(jnp.add, terms)


_LONG = 16
"""Largest number of terms of a sum that is not computed as a dot."""


def contract_left(
    da: Float[jax.Array, "p k *n"], b: Float[jax.Array, "k q *n"]
) -> Float[jax.Array, "p q *n"]:
    """da b as one product and one sum. Its transpose has the same form, with a sum over the columns
    of b."""
    return _contract(da, b, max(b.shape[:2]))


def contract_right(
    a: Float[jax.Array, "p k *n"], db: Float[jax.Array, "k q *n"]
) -> Float[jax.Array, "p q *n"]:
    """a db as one product and one sum. Its transpose has the same form, with a sum over the rows of
    a."""
    return _contract(a, db, max(a.shape[:2]))


def _contract(a: jax.Array, b: jax.Array, longest: int) -> jax.Array:
    if a.ndim == 2 and longest > _LONG:
        return a @ b
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def orthonormalize(rotation: Matrix) -> Matrix:
    """The rotation nearest to a matrix that is a rotation except for rounding.

    It is one Newton step of the polar decomposition: R (3 I − RᵀR) / 2."""
    return matmul(
        rotation, 1.5 * np.eye(3, dtype=rotation.dtype) - 0.5 * matmul(rotation.T, rotation)
    )


def level(up: Vector) -> Matrix:
    """The rotation body → world of yaw 0 (see `yaw_direction`) that turns `up`, a direction in the
    body, to the world's z.

    If the body's x axis is vertical, its yaw is undefined, and the body's y axis gets the direction
    of the world's y. If `up` is zero, the rotation is the identity with zero derivative.
    """
    length_squared = jnp.sum(up * up)
    defined = length_squared > 0
    z = jnp.where(defined, up, jnp.array([0.0, 0.0, 1.0], up.dtype))
    z = z / jnp.sqrt(jnp.where(defined, length_squared, 1.0))
    along = jnp.array([1.0, 0.0, 0.0], up.dtype) - z[0] * z  # the body's x axis, made horizontal
    squared = jnp.sum(along * along)
    vertical = squared < 1e-12
    across = _GENERATORS[1].astype(up.dtype) @ z  # y × z for the body's y axis
    x = jnp.where(vertical, across, along) / jnp.sqrt(jnp.where(vertical, 1.0, squared))
    return jnp.stack([x, hat(z) @ x, z])


def cumulative_rotation(
    start: Matrix, turns: Float[jax.Array, "3 3 n"]
) -> Float[jax.Array, "3 3 n+1"]:
    """R_0 = start, R_{j+1} = R_j turns_j: the rotation before each of n steps and after the last,
    along the last axis.

    The products are formed in about log2(n) rounds over the whole array; each doubles the reach of
    every product.
    """
    products, reach = jnp.concatenate([start[:, :, None], turns], axis=2), 1
    while reach < products.shape[2]:
        products = jnp.concatenate(
            [products[:, :, :reach], matmul(products[:, :, :-reach], products[:, :, reach:])],
            axis=2,
        )
        reach *= 2
    return products


@jax.custom_jvp
def integrate_turns(start: Matrix, turns: Float[jax.Array, "n 3"]) -> Float[jax.Array, "3 3 n+1"]:
    """`cumulative_rotation` by rotation vectors φ_j, rad, each in the frame of the rotation before
    it: R_{j+1} = R_j exp(φ_j)."""
    return cumulative_rotation(start, jax.vmap(exp, out_axes=2)(turns))


@integrate_turns.defjvp
def _integrate_turns_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """dR_j = (dR_0 R_0ᵀ + hat(Σ_{l<j} R_{l+1} J_r(φ_l) dφ_l)) R_j."""
    (start, turns), (d_start, d_turns) = primals, tangents
    rotations = integrate_turns(start, turns)
    right_jacobians = jax.vmap(right_jacobian, out_axes=2)(turns)
    n, dtype = turns.shape[0], turns.dtype
    reach = matmul(rotations[:, :, 1:], right_jacobians)
    world = contract_right(reach, d_turns.T[:, None])[:, 0]
    sums = world @ np.triu(np.ones((n, n + 1), dtype), 1)
    skew = jnp.sum(_GENERATORS.astype(dtype)[:, :, :, None] * sums[:, None, None], axis=0)
    d_world = contract_left(d_start, start.T)[:, :, None] + skew
    return rotations, contract_left(d_world, rotations)


def matrix_from_quaternion(wxyz: Quaternion) -> Matrix:
    """Rotation matrix of a unit quaternion wxyz: (w² − |u|²) I + 2 u uᵀ + 2 w hat(u)."""
    w, u = wxyz[0], wxyz[1:]
    eye = np.eye(3, dtype=wxyz.dtype)
    return (w * w - jnp.sum(u * u)) * eye + 2 * (u[:, None] * u[None, :]) + 2 * w * hat(u)


@jax.jit
def right_jacobian(phi: Vector) -> Matrix:
    """J_r(φ): exp(φ + δ) ≈ exp(φ) exp(J_r(φ) δ).

    J_r = I − (1 − cos θ)/θ² hat(φ) + (θ − sin θ)/θ³ hat(φ)²."""
    squared = jnp.sum(phi * phi)
    _, versine, excess = _series(squared)
    return _polynomial(phi, squared, -versine, excess)


@jax.custom_jvp
def exp_rigid(phi: Vector, x: Vector) -> tuple[Matrix, Vector]:
    """The exponential of SE(3): rotation exp(φ) and translation t = J_l(φ) x of the rigid motion
    with the twist (φ, x).

    J_l(φ) = J_r(φ)ᵀ: exp(φ + δ) ≈ exp(J_l(φ) δ) exp(φ)."""
    return exp(phi), contract_left(x[None], right_jacobian(phi))[0]


@exp_rigid.defjvp
def _exp_rigid_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """dR = hat(J_l dφ) R and dt = J_l dx + K dφ.

    With u = φ × x, w = φ × u, b = (1 − cos θ)/θ² and c = (θ − sin θ)/θ³ the translation is
    t = x + b u + c w. With the derivatives b', c' by θ²,

        K = (2 b' u + 2 c' w − 2 c x) φᵀ + c (φ xᵀ + φ·x I) − b hat(x)."""
    (phi, x), (d_phi, d_x) = primals, tangents
    eye, generators = np.eye(3, dtype=phi.dtype), _GENERATORS.astype(phi.dtype)
    squared, along = jnp.sum(phi * phi), jnp.sum(phi * x)
    _, versine, excess = _series(squared)
    _, versine_slope, excess_slope = _series_slopes(squared, versine, excess)
    once = matmul(hat(phi), x[:, None])[:, 0]
    twice = along * phi - squared * x
    by_squared = versine_slope * once + excess_slope * twice
    by_phi = (
        2 * (by_squared - excess * x)[:, None] * phi[None]
        + excess * (phi[:, None] * x[None] + along * eye)
        - versine * hat(x)
    )
    rotation, translation = exp_rigid(phi, x)
    jacobian = right_jacobian(phi)
    world = contract_left(d_phi[None], jacobian)[0]
    d_rotation = contract_left(jnp.sum(generators * world[:, None, None], axis=0), rotation)
    d_translation = contract_left(d_x[None], jacobian)[0]
    d_translation += contract_right(by_phi, d_phi[:, None])[:, 0]
    return (rotation, translation), (d_rotation, d_translation)


def direction(
    x: Float[jax.Array, "*k"], y: Float[jax.Array, "*k"]
) -> tuple[Float[jax.Array, "*k"], Float[jax.Array, "*k"]]:
    """(cos, sin) of the azimuth of horizontal vectors.

    For a vector of length 0, (1, 0) is returned, with zero derivative.
    """
    squared = x * x + y * y
    undefined = squared < 1e-14
    norm = jnp.sqrt(jnp.where(undefined, 1.0, squared))
    return jnp.where(undefined, 1.0, x / norm), jnp.where(undefined, 0.0, y / norm)


def planar_alignment(
    source: Float[jax.Array, "k 2"],
    target: Float[jax.Array, "k 2"],
    weight: Float[jax.Array, "k"],
) -> tuple[Float[jax.Array, "2 2"], Float[jax.Array, "2"]]:
    """Rotation Q and shift t of the plane with the least Σ w ‖target − (Q source + t)‖².

    With the points a, b relative to their weighted means, the angle of Q is that of the vector

        (Σ w a · b, Σ w a × b).

    If its length is 0, as for a single point or points in one place, Q is the identity with zero
    derivative. The sum of `weight` must be positive.
    """
    share = weight[:, None] / jnp.sum(weight)
    means = jnp.sum(share * source, axis=0), jnp.sum(share * target, axis=0)
    a, b = share * (source - means[0][None]), target - means[1][None]
    cosine, sine = direction(jnp.sum(a * b), jnp.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    rotation = jnp.stack([cosine, -sine, sine, cosine]).reshape(2, 2)
    return rotation, means[1] - matmul(rotation, means[0][:, None])[:, 0]


def yaw_direction(rotation: Matrix) -> tuple[Scalar, Scalar]:
    """(cos, sin) of the yaw of `rotation`, yaw = atan2(R[1,0], R[0,0]).

    At gimbal lock (both entries zero) the yaw is undefined: (1, 0) is returned, with zero
    derivative.
    """
    return direction(rotation[0, 0], rotation[1, 0])


def twist_direction(rotation: Matrix) -> tuple[Scalar, Scalar]:
    """(cos, sin) of the turn about z in `rotation` = Rz(turn) S, where S turns about a horizontal
    axis.

    It does not depend on the horizontal axes, as the yaw of a tilted rotation does. Where S turns
    by 180° it is undefined: (1, 0) is returned, with zero derivative.
    """
    return direction(rotation[0, 0] + rotation[1, 1], rotation[1, 0] - rotation[0, 1])


def rotation_z(angle: Scalar) -> Matrix:
    """Rotation by `angle` (rad) about the world's z axis."""
    return heading_rotation(jnp.cos(angle), jnp.sin(angle))


def yaw_rotation(rotation: Matrix) -> Matrix:
    """R_γ(R): the rotation by the yaw of `rotation` about z."""
    return heading_rotation(*yaw_direction(rotation))


def heading_rotation(cosine: Scalar, sine: Scalar) -> Matrix:
    """The rotation about z by the angle with this cosine and sine."""
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    return jnp.array([[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]])
