"""Numerics of the host, in NumPy and float64: rotations, interpolation and masks.

Loaders and metrics use these functions. Those that run on a device are in `geometry`; functions
with the same name do the same. Quaternions are wxyz, body→world, as everywhere in the package. A
stack of rotations is SciPy's `Rotation`.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int, Real
from scipy import fft
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

# --- rows


def filled_up(values: np.ndarray, rows: int, filling: float | None = None) -> np.ndarray:
    """`values` extended to `rows` rows by copies of the last one, or by rows of `filling`."""
    last = values[-1:] if filling is None else np.full((1, *values.shape[1:]), filling)
    return np.concatenate([values, np.repeat(last, rows - len(values), axis=0)])


def convolve(
    values: Float[np.ndarray, "n *w"], kernel: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "m *w"]:
    """Convolve columns of n rows with a kernel of k ≤ n at complete overlap: m = n − k + 1.

    `scipy.signal.fftconvolve` gives the same, but its import takes longer than most calls here.
    """
    rows, taps = len(values), len(kernel)
    length = fft.next_fast_len(rows + taps - 1, real=True)
    kernel = kernel.reshape(-1, *[1] * (values.ndim - 1))
    of_values, of_kernel = (np.asarray(fft.rfft(x, length, axis=0)) for x in (values, kernel))
    return np.asarray(fft.irfft(of_values * of_kernel, length, axis=0))[taps - 1 : rows]


# --- quaternions


def wxyz_from_xyzw(xyzw: Float[np.ndarray, "*k 4"]) -> Float[np.ndarray, "*k 4"]:
    """The same quaternions with the scalar first, the order of this package."""
    return xyzw[..., [3, 0, 1, 2]]


def xyzw_from_wxyz(wxyz: Float[np.ndarray, "*k 4"]) -> Float[np.ndarray, "*k 4"]:
    """The same quaternions with the scalar last, the order of ROS and of the TUM format."""
    return wxyz[..., [1, 2, 3, 0]]


def rotations(wxyz: Float[np.ndarray, "*k 4"]) -> Rotation:
    """SciPy's rotations of quaternions, which are scaled to unit length."""
    return Rotation.from_quat(wxyz, scalar_first=True)


def quaternions(rotation: Rotation) -> Float[np.ndarray, "*k 4"]:
    """Unit quaternions of SciPy's rotations."""
    return rotation.as_quat(scalar_first=True)


def quaternion_product(p: np.ndarray, q: np.ndarray, axis: int = -1) -> np.ndarray:
    """p ⊗ q of quaternions along `axis`; all other axes are broadcast.

    With the components along the first axis, `axis=0`, long stacks are multiplied several times
    faster.
    """
    (a, b, c, d), (w, x, y, z) = np.moveaxis(p, axis, 0), np.moveaxis(q, axis, 0)
    product = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    return np.stack(product, axis=axis)


# --- rotation matrices


def matrix_from_quaternion(wxyz: Float[np.ndarray, "*k 4"]) -> Float[np.ndarray, "*k 3 3"]:
    """Rotation matrices of quaternions, which are scaled to unit length; NaN if one is not
    finite."""
    flat = wxyz.reshape(-1, 4)
    finite = finite_rows(flat)
    matrices = np.full((len(flat), 3, 3), np.nan)
    if finite.any():
        matrices[finite] = rotations(flat[finite]).as_matrix()
    return matrices.reshape(*wxyz.shape[:-1], 3, 3)


def quaternion_from_matrix(rotation: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k 4"]:
    """Unit quaternions of rotation matrices; NaN if one is not finite."""
    flat = rotation.reshape(-1, 3, 3)
    finite = finite_rows(flat.reshape(-1, 9))
    wxyz = np.full((len(flat), 4), np.nan)
    if finite.any():
        wxyz[finite] = quaternions(Rotation.from_matrix(flat[finite]))
    return wxyz.reshape(*rotation.shape[:-2], 4)


def hat(v: Float[np.ndarray, "*k 3"]) -> Float[np.ndarray, "*k 3 3"]:
    """Cross-product matrices: hat(v) w = v × w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    rows = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return rows.reshape(*v.shape[:-1], 3, 3)


def yaw(rotation: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k"]:
    """Yaw atan2(R[1, 0], R[0, 0]) of body→world matrices, rad in (−π, π]: the azimuth of the body's
    x axis; 0 if that axis is vertical."""
    return np.asarray(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]))


def rotation_z(angle: Float[np.ndarray, "*k"] | float) -> Float[np.ndarray, "*k 3 3"]:
    """Rotations by an angle (rad) about the world's z axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    rows = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], axis=-1)
    return rows.reshape(*np.shape(angle), 3, 3)


def yaw_rotation(rotation: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k 3 3"]:
    """R_γ(R): the rotations about z by the yaw of `rotation`."""
    return rotation_z(yaw(rotation))


# --- stacks of SciPy's rotations


def about_z(angle: Float[np.ndarray, " n"]) -> Rotation:
    """n rotations by an angle (rad) about the world's z axis."""
    return Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def levelling(up: Float[np.ndarray, "3"]) -> Rotation:
    """The smallest rotation that turns `up` (any length) onto z; the half turn about x if `up`
    points down (ours).

    It levels a tilted world in which the mean specific force is `up`, with the least change of yaw.
    `geometry.level` is a different rotation, which also sets the yaw to 0.
    """
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return Rotation.from_rotvec([np.pi if up[2] < 0 else 0.0, 0.0, 0.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2]))


def cumulative_rotation(turns: Rotation) -> Rotation:
    """R_0 = I, R_{j+1} = R_j turns_j: n + 1 rotations of n turns.

    The products are formed in about log2(n) rounds over the whole stack; each doubles the reach of
    every product. Raises `ValueError` for a turn that is not finite.
    """
    # Arrays (4, n), scalar first: 30 times as fast as products of SciPy's rotations.
    steps = turns.as_quat(scalar_first=True).reshape(-1, 4).T
    products, reach = np.hstack([np.eye(4, 1), steps]), 1
    while reach < products.shape[1]:
        later = quaternion_product(products[:, :-reach], products[:, reach:], axis=0)
        products, reach = np.hstack([products[:, :reach], later]), 2 * reach
    return Rotation.from_quat(products.T, scalar_first=True)


def integrate_gyro(
    gyro: Float[np.ndarray, "n 3"], step: float | Float[np.ndarray, " m"]
) -> Rotation:
    """Attitude relative to the first sample, n rotations, from `gyro` (rad/s) at the stamps. The
    rate of each interval is the mean of its ends. `step` is the interval, or the n − 1 intervals,
    s."""
    return cumulative_rotation(Rotation.from_rotvec(midpoints(gyro) * np.reshape(step, (-1, 1))))


def turns_between(attitude: Rotation) -> Float[np.ndarray, "m 3"]:
    """Rotation vectors (rad, in the body) from each of n attitudes body→world to the next: divided
    by the interval they are the mean angular rates."""
    return (attitude[:-1].inv() * attitude[1:]).as_rotvec()


# --- series of samples


def midpoints(values: Float[np.ndarray, "n *w"]) -> Float[np.ndarray, "m *w"]:
    """Means of each row and the next."""
    return 0.5 * (values[:-1] + values[1:])


def neighbours(
    stamps: Real[np.ndarray, " n"], time: Real[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Rows (left, right = left + 1) of the increasing stamps that enclose each time.

    Beyond the ends it is the outermost pair. A time that equals a stamp has that stamp on its
    right, except for the first stamp.
    """
    right = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    return right - 1, right


def interpolate(
    time: Real[np.ndarray, " m"], stamps: Real[np.ndarray, " n"], values: Float[np.ndarray, "n w"]
) -> Float[np.ndarray, "m w"]:
    """`np.interp` of each column: linear between increasing stamps, constant beyond the ends."""
    return np.stack([np.interp(time, stamps, column) for column in values.T], axis=1)


def slerp(
    time: Real[np.ndarray, " m"], stamps: Real[np.ndarray, " n"], attitude: Rotation
) -> Rotation:
    """Attitudes on the shorter arc between increasing stamps, constant beyond the ends."""
    return Slerp(stamps, attitude)(np.clip(time, stamps[0], stamps[-1]))


def finite_rows(values: Float[np.ndarray, "n w"]) -> Bool[np.ndarray, " n"]:
    """Which rows have neither NaN nor infinity."""
    return np.asarray(np.isfinite(values).all(axis=1))


def robust_std(error: Float[np.ndarray, "*k"]) -> float:
    """Standard deviation of the normal distribution with the median absolute value of `error`."""
    return 1.4826 * float(np.median(np.abs(error)))


# --- masks


def spans(mask: Bool[np.ndarray, " n"]) -> Int[np.ndarray, "k 2"]:
    """(start, stop) of each run of True, in order.

    `for start, stop in spans(mask)` gives them one by one, `start, stop = spans(mask).T` together.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return edges.reshape(-1, 2)


def stretches(broken: Bool[np.ndarray, " m"]) -> list[slice]:
    """The unbroken stretches of a series as slices of its rows.

    `broken` is True for each of the m intervals between m + 1 rows at which the series is cut.
    """
    edges = [0, *(np.flatnonzero(broken) + 1).tolist(), len(broken) + 1]
    return [slice(first, last) for first, last in itertools.pairwise(edges)]


def within(mask: Bool[np.ndarray, " n"], reach: int) -> Bool[np.ndarray, " n"]:
    """True within `reach` rows of a True."""
    return np.asarray(maximum_filter1d(mask.astype(np.uint8), 2 * reach + 1)).astype(bool)


def last_true(mask: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Row of the latest True at or before each row. Before the first True it is the row of the
    first True."""
    rows = np.arange(len(mask))
    return np.maximum.accumulate(np.where(mask, rows, int(np.argmax(mask))))
