"""Host numerics against SciPy, closed forms and plain loops, singular cases included."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from gnio_jax import geometry, numerics


def some(count, seed=0):
    return Rotation.random(count, rng=np.random.default_rng(seed))


def test_the_scalar_comes_first():
    half_turn = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
    expected = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    np.testing.assert_allclose(numerics.quaternions(half_turn), expected, atol=1e-15)
    np.testing.assert_allclose(
        numerics.rotations(expected).as_matrix(), half_turn.as_matrix(), atol=1e-15
    )
    order = np.array([1.0, 2.0, 3.0, 4.0])  # w x y z
    np.testing.assert_array_equal(numerics.xyzw_from_wxyz(order), [2.0, 3.0, 4.0, 1.0])
    np.testing.assert_array_equal(numerics.wxyz_from_xyzw(numerics.xyzw_from_wxyz(order)), order)


def test_product_and_conjugate_are_those_of_rotations():
    first, second = some(20), some(20, 1)
    left_factor, right = numerics.quaternions(first), numerics.quaternions(second)
    expected = (first * second).as_matrix()
    product = numerics.quaternion_product(left_factor, right)
    np.testing.assert_allclose(numerics.matrix_from_quaternion(product), expected, atol=1e-14)
    np.testing.assert_array_equal(
        numerics.quaternion_product(left_factor.T, right.T, axis=0), product.T
    )  # the other layout
    np.testing.assert_array_equal(
        numerics.quaternion_product(left_factor[0], right)[0], product[0]
    )  # one on many
    nothing = numerics.quaternion_product(left_factor * [1, -1, -1, -1], left_factor)
    np.testing.assert_allclose(nothing, np.tile([1.0, 0.0, 0.0, 0.0], (20, 1)), atol=1e-15)


def test_matrices_of_quaternions_and_back_keep_what_is_not_finite():
    rotation = some(6)
    wxyz = numerics.quaternions(rotation).reshape(2, 3, 4)
    wxyz[1, 0, 2] = np.nan
    matrices = numerics.matrix_from_quaternion(wxyz)
    assert matrices.shape == (2, 3, 3, 3)
    mask = np.isfinite(wxyz).all(axis=-1)
    np.testing.assert_allclose(
        matrices[mask], rotation[mask.ravel()].as_matrix(), atol=1e-15, rtol=0
    )
    assert np.isnan(matrices[1, 0]).all()
    again = numerics.quaternion_from_matrix(matrices)
    sign = np.sign((again * wxyz).sum(axis=-1, keepdims=True))
    np.testing.assert_allclose((again * sign)[mask], wxyz[mask], atol=1e-15)
    assert np.isnan(again[1, 0]).all()
    assert np.isnan(numerics.matrix_from_quaternion(np.full((2, 4), np.nan))).all()
    np.testing.assert_allclose(
        numerics.matrix_from_quaternion(np.array([2.0, 0.0, 0.0, 0.0])), np.eye(3)
    )


def test_hat_is_the_cross_product():
    v, w = np.random.default_rng(0).standard_normal((2, 5, 3))
    np.testing.assert_allclose((numerics.hat(v) @ w[..., None])[..., 0], np.cross(v, w))
    np.testing.assert_array_equal(numerics.hat(v[0]), geometry.hat(jnp.asarray(v[0])))


def test_yaw_is_the_azimuth_of_the_body_axis_and_that_of_geometry():
    rotation = some(50)
    along = rotation.apply([1.0, 0.0, 0.0])
    expected = np.arctan2(along[:, 1], along[:, 0])
    matrices = rotation.as_matrix()
    np.testing.assert_allclose(numerics.yaw(matrices), expected, atol=1e-14)
    twins = np.stack([geometry.yaw_rotation(jnp.asarray(matrix)) for matrix in matrices])
    np.testing.assert_allclose(numerics.yaw_rotation(matrices), twins, atol=1e-14)
    vertical = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert numerics.yaw(vertical) == 0.0
    np.testing.assert_array_equal(numerics.yaw_rotation(vertical), np.eye(3))


def test_rotations_about_z():
    angles = np.array([0.0, 1e-9, 0.3, np.pi / 2, np.pi, -2.0, 7.0])
    expected = Rotation.from_euler("z", angles[:, None]).as_matrix()
    np.testing.assert_allclose(numerics.about_z(angles).as_matrix(), expected, atol=1e-15)
    for angle, matrix in zip(angles, expected, strict=True):
        np.testing.assert_allclose(numerics.rotation_z(angle), matrix, atol=1e-15)


def test_levelling_turns_up_onto_z_about_a_horizontal_axis_by_the_angle_between():
    for up in ([0.1, -0.2, 9.7], [0, 0, 3], [1e-9, 0, 1], [2, 0, 0], [0.3, 0.4, -1], [0, 0, -2]):
        up = np.array(up, float)
        turn, length = numerics.levelling(up), np.linalg.norm(up)
        np.testing.assert_allclose(turn.apply(up), [0.0, 0.0, length], atol=1e-14 * length)
        assert turn.as_rotvec()[2] == 0.0
        between = np.arctan2(np.hypot(*up[:2]), up[2])
        np.testing.assert_allclose(turn.magnitude(), between, atol=1e-15)


@pytest.mark.parametrize("count", [1, 2, 3, 17, 64])
def test_cumulative_rotation_is_the_running_product_from_the_identity(count):
    turns = some(count)
    expected = [np.eye(3)]
    for turn in turns.as_matrix():
        expected.append(expected[-1] @ turn)
    rotations = numerics.cumulative_rotation(turns)
    assert len(rotations) == count + 1
    np.testing.assert_allclose(rotations.as_matrix(), np.stack(expected), atol=1e-13)


def test_a_turn_that_is_not_finite_is_refused():
    turns = Rotation.from_rotvec([[0.1, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    with pytest.raises(ValueError):
        numerics.cumulative_rotation(turns)


def test_integrate_gyro_returns_the_attitude_of_a_steady_turn_on_any_clock():
    rate = np.array([0.3, -0.5, 0.9])
    time = np.cumsum(np.random.default_rng(0).uniform(0.005, 0.02, 40))
    expected = Rotation.from_rotvec((time - time[0])[:, None] * rate).as_matrix()
    gyro = np.tile(rate, (40, 1))
    attitude = numerics.integrate_gyro(gyro, np.diff(time))
    np.testing.assert_allclose(attitude.as_matrix(), expected, atol=1e-13)
    np.testing.assert_allclose(numerics.turns_between(attitude) / np.diff(time)[:, None], gyro[1:])
    steady = numerics.integrate_gyro(gyro, 0.01)
    np.testing.assert_allclose(steady[-1].as_rotvec(), 0.39 * rate, atol=1e-13)


def test_interpolation_is_linear_per_column_and_holds_its_ends():
    stamps = np.array([0.0, 1.0, 3.0])
    values = np.array([[0.0, 10.0], [2.0, 20.0], [4.0, 0.0]])
    rows = numerics.interpolate(np.array([-1.0, 0.5, 1.0, 2.0, 9.0]), stamps, values)
    np.testing.assert_array_equal(
        rows, [[0.0, 10.0], [1.0, 15.0], [2.0, 20.0], [3.0, 10.0], [4.0, 0.0]]
    )
    by_row = numerics.interpolate(np.arange(3), np.array([0, 2]), values[:2])
    np.testing.assert_array_equal(by_row, [[0.0, 10.0], [1.0, 15.0], [2.0, 20.0]])
    np.testing.assert_array_equal(numerics.midpoints(values), [[1.0, 15.0], [3.0, 10.0]])


def test_slerp_turns_evenly_on_the_shorter_arc_and_holds_its_ends():
    stamps = np.array([0.0, 1.0, 2.0])
    attitude = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 1.0], [0, 0, 1.0 + 1.5 * np.pi]])
    rotations = numerics.slerp(np.array([-3.0, 0.25, 1.5, 2.5]), stamps, attitude)
    expected = [0.0, 0.25, 1.0 - 0.25 * np.pi, 1.0 - 0.5 * np.pi]
    np.testing.assert_allclose(rotations.as_rotvec()[:, 2], expected, atol=1e-14)


def test_neighbours_bracket_every_time():
    stamps = np.array([0.0, 1.0, 2.0, 5.0])
    left_neighbours, right = numerics.neighbours(
        stamps, np.array([-1.0, 0.0, 0.5, 1.0, 4.0, 5.0, 9.0])
    )
    np.testing.assert_array_equal(right, [1, 1, 1, 1, 3, 3, 3])
    np.testing.assert_array_equal(left_neighbours, right - 1)


def test_robust_std_is_that_of_normal_noise_and_ignores_a_few_flips():
    noise = 0.3 * np.random.default_rng(0).standard_normal((20000, 3))
    noise[:100] = 50.0
    assert numerics.robust_std(noise) == pytest.approx(0.3, rel=0.02)


def test_spans_are_the_runs_of_true():
    for mask in ([], [0], [1], [0, 1, 1, 0, 1], [1, 1, 0, 0, 0, 1, 0], [0, 0, 0]):
        mask = np.array(mask, dtype=bool)
        spans, again = numerics.spans(mask), np.zeros_like(mask)
        assert spans.shape[1:] == (2,)
        for start, stop in spans:
            assert stop > start and mask[start:stop].all()
            assert (start == 0 or not mask[start - 1]) and (stop == len(mask) or not mask[stop])
            again[start:stop] = True
        np.testing.assert_array_equal(again, mask)


def test_stretches_are_the_rows_between_breaks():
    broken = np.array([False, True, False, True])
    assert numerics.stretches(broken) == [slice(0, 2), slice(2, 4), slice(4, 5)]
    assert numerics.stretches(np.zeros(0, dtype=bool)) == [slice(0, 1)]


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_within_is_dilation(reach):
    mask = np.random.default_rng(0).uniform(size=100) < 0.05
    mask[[0, -1]] = True, False
    np.testing.assert_array_equal(
        numerics.within(mask, reach), binary_dilation(mask, iterations=reach)
    )
    np.testing.assert_array_equal(numerics.within(mask, 0), mask)


def test_last_true_holds_and_reaches_back_to_the_first():
    mask = np.array([False, True, False, False, True, False])
    np.testing.assert_array_equal(numerics.last_true(mask), [1, 1, 1, 1, 4, 4])


@pytest.mark.parametrize("rows, taps", [(50, 7), (11, 10), (40, 40)])
def test_columns_are_convolved_where_they_overlap_the_kernel_wholly(rows, taps):
    random = np.random.default_rng(taps)
    values, kernel = random.standard_normal((rows, 3)), random.standard_normal(taps)
    columns = [np.convolve(column, kernel, mode="valid") for column in values.T]
    np.testing.assert_allclose(numerics.convolve(values, kernel), np.transpose(columns), atol=1e-12)
    convolution = numerics.convolve(values[:, 0], kernel)
    np.testing.assert_allclose(convolution, columns[0], atol=1e-12)
