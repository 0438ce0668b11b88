"""Validation, resampling, self-check and HDF5 against signals whose values are known in closed
form."""

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data import sequence as seq
from gnio_jax.types import InputError, Sequence


def circle(rate=100.0, seconds=30.0, speed=1.2, turn=0.4, stamps=None) -> Sequence:
    """Walking a circle on the level, phone flat and x ahead, up and down by a gait of 2 Hz: every
    field in closed form."""
    time = np.arange(round(seconds * rate)) / rate if stamps is None else stamps
    yaw, radius = turn * time, speed / turn
    lift, omega = 0.02, 4 * np.pi
    position = np.stack(
        [radius * np.sin(yaw), -radius * np.cos(yaw), lift * np.sin(omega * time)], axis=1
    )
    velocity = np.stack(
        [speed * np.cos(yaw), speed * np.sin(yaw), lift * omega * np.cos(omega * time)], axis=1
    )
    accel = np.stack(
        [0 * time, speed * turn + 0 * time, 9.81 - lift * omega**2 * np.sin(omega * time)], axis=1
    )
    gyro = np.stack([0 * time, 0 * time, turn + 0 * time], axis=1)
    orientation = np.stack([np.cos(yaw / 2), 0 * time, 0 * time, np.sin(yaw / 2)], axis=1)
    return Sequence(
        "circle",
        time,
        gyro,
        accel,
        orientation,
        position,
        velocity,
        np.ones(len(time), dtype=bool),
        attributes={"dataset": "test"},
    )


def changed(sequence, field, row, value):
    """`sequence` with one row (or entry) of one field overwritten."""
    values = getattr(sequence, field).copy()
    values[row] = value
    return sequence._replace(**{field: values})


# --- validate
# --------------------------------------------------------------------------------------------------------

GOOD = circle(seconds=2.0)

BAD = [
    (GOOD._replace(gyro=GOOD.gyro[:-1]), "'gyro'", "shape"),
    (GOOD._replace(velocity=GOOD.velocity[:, :2]), "'velocity'", "shape"),
    (GOOD._replace(device_orientation=GOOD.orientation[1:]), "'device_orientation'", "shape"),
    (GOOD._replace(time=GOOD.time[:1]), "'time'", "two stamps"),
    (GOOD._replace(valid=GOOD.valid.astype(float)), "'valid'", "booleans"),
    (changed(GOOD, "time", 7, GOOD.time[6]), "'time'", "row 7"),
    (changed(GOOD, "time", 7, np.nan), "'time'", "row 7"),
    (changed(GOOD, "gyro", 9, np.nan), "'gyro'", "row 9"),
    (changed(GOOD, "accel", (9, 2), np.inf), "'accel'", "row 9"),
    (GOOD._replace(accel=GOOD.accel / 9.81), "'accel'", "looks like G"),
    (GOOD._replace(accel=GOOD.accel - np.array([0, 0, 9.81])), "'accel'", "no gravity"),
    (GOOD._replace(accel=GOOD.accel * 1e3), "'accel'", "not in m/s²"),
    (GOOD._replace(gyro=GOOD.gyro * 180 / np.pi), "'gyro'", "looks like deg/s"),
    (changed(GOOD, "orientation", 5, [0.9, 0, 0, 0]), "'orientation'", "row 5"),
    (changed(GOOD, "orientation", 5, 0.0), "'orientation'", "row 5"),
    (changed(GOOD, "orientation", 5, np.nan), "'orientation'", "row 5"),
    (changed(GOOD, "position", 5, np.nan), "'position'", "mark these rows invalid"),
    (changed(GOOD, "velocity", 5, np.inf), "'velocity'", "row 5"),
    (
        changed(GOOD._replace(device_orientation=GOOD.orientation), "device_orientation", 5, 2.0),
        "'device_orientation'",
        "row 5",
    ),
]


@pytest.mark.parametrize(
    ("sequence", "field", "problem"), BAD, ids=[f"{bad[1]}-{bad[2]}" for bad in BAD]
)
def test_validate_names_file_field_and_problem_in_one_line(sequence, field, problem):
    if "deg/s" in problem:
        sequence = sequence._replace(gyro=sequence.gyro * 10)
    with pytest.raises(InputError) as error:
        seq.validate(sequence, "walk.csv")
    text = str(error.value)
    assert text.startswith("walk.csv: ") and field in text and problem in text and "\n" not in text


def test_validate_lets_the_reference_be_missing_where_it_is_marked_invalid():
    sequence = GOOD
    for field in ("position", "velocity", "orientation"):
        sequence = changed(sequence, field, 5, np.nan)
    sequence = changed(sequence, "valid", 5, False)
    assert seq.validate(sequence, "walk.csv").valid.sum() == len(GOOD.time) - 1


def test_validate_normalizes_rounded_quaternions_and_keeps_exact_ones_bit_for_bit():
    assert seq.validate(GOOD, "walk.csv").orientation is GOOD.orientation
    rounded = GOOD._replace(orientation=np.round(GOOD.orientation, 4))
    np.testing.assert_allclose(
        np.linalg.norm(seq.validate(rounded, "walk.csv").orientation, axis=1), 1.0, atol=1e-14
    )


def test_check_rate_and_gaps():
    time = np.arange(100) / 202.3
    assert seq.check_rate(time, 200.0, "walk.csv") == pytest.approx(202.3)
    with pytest.raises(
        InputError, match=r"walk\.csv: field 'time' runs at 202\.3 Hz, expected about 100 Hz"
    ):
        seq.check_rate(time, 100.0, "walk.csv")
    with pytest.raises(InputError, match=r"field 'time'"):  # milliseconds taken for seconds
        seq.check_rate(time * 1e3, 200.0, "walk.csv")
    seq.check_gaps(time, "walk.csv")
    time[50:] += 1.2
    with pytest.raises(
        InputError, match=r"walk\.csv: field 'time' has a gap of 1\.205 s after row 49"
    ):
        seq.check_gaps(time, "walk.csv")


@pytest.mark.parametrize("count", [1, 2, 7, 16])
def test_cumulative_rotation_against_a_loop(count):
    turns = Rotation.random(count, random_state=3)
    product, expected = np.eye(3), []
    for turn in turns.as_matrix():
        product = product @ turn
        expected.append(product)
    np.testing.assert_allclose(seq.cumulative_rotation(turns).as_matrix(), expected, atol=1e-12)


# --- resample
# --------------------------------------------------------------------------------------------------------


def test_resampling_what_is_uniform_already_changes_nothing():
    sequence = circle(200.0, 2.0)
    assert seq.resample(sequence, 200.0) is sequence
    stamped = sequence._replace(
        time=np.round(sequence.time * 0.99999, 6)
    )  # µs stamps of a clock off by 10 ppm, as TLIO's
    assert seq.resample(stamped, 200.0) is stamped
    slow = sequence._replace(time=sequence.time * 1.0005)  # half a per mille of every displacement
    assert seq.resample(slow, 200.0) is not slow


@pytest.mark.parametrize(
    ("native", "rate"), [(202.3, 200.0), (100.0, 200.0), (200.0, 100.0), (250.0, 100.0)]
)
def test_resampling_returns_the_signal_at_the_new_stamps(native, rate):
    sequence = circle(native, 4.0)
    start = 12.5  # stamps need not start at zero
    result = seq.resample(sequence._replace(time=sequence.time + start), rate)
    np.testing.assert_allclose(np.diff(result.time), 1 / rate, rtol=1e-9)
    assert (
        result.time[0] == start
        and result.time[-1] <= sequence.time[-1] + start < result.time[-1] + 1 / rate + 1e-9
    )
    truth = circle(stamps=result.time - start)
    edge = slice(round(0.3 * rate), -round(0.3 * rate))  # the FIR mirrors the signal at its ends
    np.testing.assert_allclose(result.accel[edge], truth.accel[edge], atol=3e-3)
    np.testing.assert_allclose(result.gyro[edge], truth.gyro[edge], atol=1e-4)
    for field, tolerance in (("position", 1e-6), ("velocity", 1e-4), ("orientation", 1e-12)):
        np.testing.assert_allclose(getattr(result, field), getattr(truth, field), atol=tolerance)
    assert (
        result.valid.all() and result.name == "circle" and result.attributes == sequence.attributes
    )


def test_resampling_accepts_uneven_stamps():
    rng = np.random.default_rng(0)
    stamps = np.arange(400) / 100
    stamps[1:-1] += rng.uniform(-0.003, 0.003, 398)
    result = seq.resample(circle(stamps=stamps), 100.0)
    np.testing.assert_allclose(np.diff(result.time), 0.01, rtol=1e-9)
    truth = circle(stamps=result.time)
    np.testing.assert_allclose(result.position, truth.position, atol=1e-6)
    np.testing.assert_allclose(result.accel, truth.accel, atol=5e-3)
    assert result.valid.all()


def test_a_vibration_above_the_new_nyquist_frequency_does_not_fold_into_the_gait_band():
    sequence = circle(200.0, 10.0)
    vibration = (
        5.0 * np.sin(2 * np.pi * 70.0 * sequence.time)[:, None]
    )  # taken at 100 Hz it would look like 30 Hz
    result = seq.resample(
        sequence._replace(accel=sequence.accel + vibration, gyro=sequence.gyro + vibration), 100.0
    )
    truth = circle(stamps=result.time)
    edge = slice(50, -50)
    assert (
        np.abs(result.accel[edge] - truth.accel[edge]).max() < 5e-3
    )  # 60 dB down, and no delay of the gait
    assert np.abs(result.gyro[edge] - truth.gyro[edge]).max() < 5e-3


def test_at_no_multiple_of_the_rate_images_of_the_spline_do_not_fold_back():
    """The spline's image of 205 Hz, at 621 Hz, would alias to 21 Hz at 600 Hz."""
    sequence = circle(416.0, 4.0)
    tone = np.sin(2 * np.pi * 205.0 * sequence.time[:, None] + [0.0, 1.0, 2.0])
    result = seq.resample(sequence._replace(gyro=tone), 200.0)
    assert np.abs(result.gyro[50:-50]).max() < 1e-3


def test_what_the_new_rate_can_carry_is_kept_up_to_the_ends():
    sequence = circle(200.0, 10.0)
    time = sequence.time
    tone = np.stack([np.sin(2 * np.pi * 35.0 * time), 0.1 * time, 1.0 + 0.02 * time], axis=1)
    result = seq.resample(sequence._replace(gyro=tone), 100.0)
    kept = np.stack(
        [np.sin(2 * np.pi * 35.0 * result.time), 0.1 * result.time, 1.0 + 0.02 * result.time],
        axis=1,
    )
    np.testing.assert_allclose(result.gyro[50:-50, 0], kept[50:-50, 0], atol=5e-3)
    np.testing.assert_allclose(result.gyro[:, 1:], kept[:, 1:], atol=1e-4)


def test_attitudes_are_slerped_whatever_the_signs_of_the_quaternions():
    rng = np.random.default_rng(1)
    time = np.arange(300) / 100
    axis = np.array([1.0, 2.0, -2.0]) / 3.0

    def attitude(t):
        angle = 3.0 * t[:, None]
        return np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=1)

    flipped = attitude(time) * rng.choice([-1.0, 1.0], size=(300, 1))
    sequence = circle(stamps=time)._replace(orientation=flipped, device_orientation=flipped)
    result = seq.resample(sequence, 330.0)
    for got in (result.orientation, result.device_orientation):
        np.testing.assert_allclose(
            np.abs((got * attitude(result.time)).sum(axis=1)), 1.0, atol=1e-12
        )


def test_a_hole_is_bridged_in_the_imu_and_marked_in_the_reference():
    time = np.arange(400) / 100
    time = time[(time <= 1.0) | (time >= 1.5)]
    result = seq.resample(circle(stamps=time), 100.0)
    inside = (result.time > 1.0 + 1e-6) & (result.time < 1.5 - 1e-6)
    np.testing.assert_array_equal(result.valid, ~inside)
    ends = circle(stamps=np.array([1.0, 1.5])).accel
    line = ends[0] + (result.time[inside, None] - 1.0) / 0.5 * (ends[1] - ends[0])
    np.testing.assert_allclose(result.accel[inside], line, atol=1e-9)
    short = seq.resample(circle(stamps=np.delete(np.arange(400) / 100, [100, 101])), 100.0)
    assert short.valid.all()  # two lost samples are jitter


def test_an_outlier_marked_invalid_does_not_reach_its_valid_neighbours():
    sequence = circle(100.0, 4.0)
    rows = slice(200, 210)
    for field, value in (("position", 1e4), ("velocity", 1e4), ("valid", False)):
        sequence = changed(sequence, field, rows, value)
    result = seq.resample(sequence, 130.0)
    truth = circle(stamps=result.time)
    near = (result.time > 1.99 + 1e-6) & (result.time < 2.10 - 1e-6)
    np.testing.assert_array_equal(result.valid, ~near)
    np.testing.assert_allclose(
        result.position[result.valid], truth.position[result.valid], atol=1e-5
    )


@pytest.mark.parametrize("rows", [2, 20])
def test_a_missing_reference_stays_missing(rows):
    sequence = circle(100.0, 4.0)
    for field, value in (
        ("position", np.nan),
        ("velocity", np.nan),
        ("orientation", np.nan),
        ("valid", False),
    ):
        sequence = changed(sequence, field, slice(200, 200 + rows), value)
    result = seq.resample(sequence, 130.0)
    for field in ("position", "velocity", "orientation"):
        np.testing.assert_array_equal(np.isfinite(getattr(result, field)).all(axis=1), result.valid)
    assert np.isfinite(result.accel).all()
    seq.validate(result, "walk")


# --- self_check
# ------------------------------------------------------------------------------------------------------


def test_self_check_of_a_consistent_walk():
    check = seq.self_check(circle())
    assert check.failures == ()
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.05)
    assert (
        check.duration == pytest.approx(29.99)
        and check.rate == pytest.approx(100.0)
        and check.share_valid == 1.0
    )
    assert check.gyro_consistency_degrees < 1e-6
    assert check.median_speed == pytest.approx(1.2, abs=0.1)
    assert check.accel_correlation_horizontal > 0.999


def test_self_check_removes_one_constant_gyro_bias():
    sequence = circle()
    assert (
        seq.self_check(
            sequence._replace(gyro=sequence.gyro + np.array([0.02, -0.03, 0.05]))
        ).gyro_consistency_degrees
        < 0.1
    )


def test_self_check_judges_gyro_by_the_median_window():
    sequence = circle(seconds=100.0)
    spoilt = changed(sequence, "gyro", slice(3000, 4000), [1.0, 0.5, 0.0])
    assert seq.self_check(spoilt).gyro_consistency_degrees < 0.1
    drifting = sequence._replace(gyro=sequence.gyro + 0.1 * np.sin(0.3 * sequence.time)[:, None])
    assert any("gyro" in failure for failure in seq.self_check(drifting).failures)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda s: s._replace(accel=s.accel * 1.1), "mean of R·accel"),
        (lambda s: s._replace(accel=s.accel[:, [1, 2, 0]]), "mean of R·accel"),
        (lambda s: s._replace(accel=-s.accel), "mean of R·accel"),
        (lambda s: s._replace(gyro=s.gyro[:, [2, 0, 1]] * np.sin(s.time)[:, None]), "gyro"),
        (lambda s: s._replace(position=s.position * [-1, 1, 1]), "correlates"),
        (lambda s: s._replace(velocity=s.velocity * 4), "too fast for a pedestrian"),
        (lambda s: s._replace(valid=np.zeros_like(s.valid)), "no sample has a valid reference"),
        (lambda s: s._replace(valid=(np.arange(len(s.time)) % 700) < 100), "no window"),
    ],
    ids=["scale", "axes", "sign", "gyro", "mirrored", "speed", "nothing-valid", "no-window"],
)
def test_self_check_says_what_is_implausible(spoil, reason):
    failures = seq.self_check(spoil(circle())).failures
    assert any(reason in failure for failure in failures)


def test_self_check_spares_the_fast_who_do_not_walk_and_those_who_stand():
    sequence = circle()
    assert (
        seq.self_check(sequence._replace(velocity=sequence.velocity * 4), pedestrian=False).failures
        == ()
    )
    still = sequence._replace(
        gyro=0 * sequence.gyro,
        accel=0 * sequence.accel + [0, 0, 9.81],
        velocity=0 * sequence.velocity,
        position=0 * sequence.position,
        orientation=0 * sequence.orientation + [1, 0, 0, 0],
    )
    assert seq.self_check(still).failures == ()
    rng = np.random.default_rng(2)
    noisy = still._replace(
        accel=still.accel + 0.1 * rng.standard_normal(still.accel.shape),
        position=1e-4 * rng.standard_normal(still.position.shape),
    )
    check = seq.self_check(noisy)
    assert check.failures == () and abs(check.accel_correlation_horizontal) < 0.2
    pinned = sequence._replace(
        position=0 * sequence.position, accel=sequence.accel + np.sin(3 * sequence.time)[:, None]
    )
    assert any("correlates" in failure for failure in seq.self_check(pinned).failures)


def test_self_check_looks_at_valid_samples_only():
    sequence = circle()
    for field, value in (
        ("position", np.nan),
        ("velocity", np.nan),
        ("orientation", np.nan),
        ("accel", 90.0),
        ("valid", False),
    ):
        sequence = changed(sequence, field, slice(700, 760), value)
    check = seq.self_check(sequence)
    assert (
        check.failures == ()
        and check.share_valid == pytest.approx(0.98)
        and check.accel_correlation_horizontal > 0.99
    )
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.05)


def speeding(seconds=4.0, start=5.0, push=1.5):
    """Straight ahead, ever faster, as a car leaves a crossing."""
    sequence = circle(seconds=seconds, turn=0.01)
    time, zero = sequence.time, 0 * sequence.time
    still = np.tile([1.0, 0, 0, 0], (len(time), 1))
    return sequence._replace(
        orientation=still,
        gyro=np.zeros((len(time), 3)),
        accel=np.stack([zero + push, zero, zero + 9.81], axis=1),
        velocity=np.stack([start + push * time, zero, zero], axis=1),
        position=np.stack([start * time + push * time**2 / 2, zero, zero], axis=1),
    )


def test_who_ends_faster_than_he_began_is_not_tilted():
    check = seq.self_check(speeding(), pedestrian=False)
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=1e-9)
    assert check.failures == ()
    steady = speeding(push=0.0)  # the same force without the gain in speed is a tilt
    tilted = steady._replace(accel=steady.accel + np.array([1.5, 0, 0]))
    np.testing.assert_allclose(
        seq.self_check(tilted, pedestrian=False).gravity_mean, [1.5, 0, 9.81], atol=1e-9
    )
    assert (
        "mean of R·accel is (1.50, 0.00, 9.81)"
        in seq.self_check(tilted, pedestrian=False).failures[0]
    )


def test_the_gain_in_speed_is_that_of_the_valid_stretches():
    sequence = speeding(seconds=12.0, push=0.5)
    # A stop and start in the middle that nobody has seen: speeds before and after say nothing of
    # each other.
    velocity = np.where(
        sequence.time[:, None] >= 6.0, sequence.velocity - [4.0, 0, 0], sequence.velocity
    )
    sequence = sequence._replace(
        velocity=velocity, valid=(sequence.time < 5.0) | (sequence.time >= 7.0)
    )
    np.testing.assert_allclose(
        seq.self_check(sequence, pedestrian=False).gravity_mean, [0, 0, 9.81], atol=1e-9
    )


@pytest.mark.parametrize(
    ("seconds", "judged"), [(4.0, False), (15.0, False), (19.9, False), (20.1, True), (30.0, True)]
)
def test_one_window_says_nothing_of_the_gyro_since_a_bias_explains_it(seconds, judged):
    sequence = circle(seconds=seconds)
    wrong = sequence._replace(gyro=sequence.gyro[:, [1, 2, 0]] * np.sin(sequence.time)[:, None])
    check = seq.self_check(wrong)
    assert np.isnan(check.gyro_consistency_degrees) != judged
    assert any("gyro" in failure for failure in check.failures) == judged
    assert not any("no window" in failure for failure in check.failures)
    assert seq.self_check(sequence).failures == ()


def test_one_valid_window_of_a_long_recording_says_nothing_either():
    sequence = circle(seconds=60.0)
    check = seq.self_check(
        sequence._replace(valid=(sequence.time >= 20.0) & (sequence.time < 31.0))
    )
    assert np.isnan(check.gyro_consistency_degrees) and check.failures == ()


def test_windows_of_the_gyro_tell_when_it_is_off():
    sequence = circle(seconds=100.0)
    starts, degrees = seq.gyro_windows(
        changed(sequence, "gyro", slice(4000, 4100), [0.5, 0.0, 0.4])
    )
    np.testing.assert_allclose(starts, np.arange(0, 86, 5.0))
    # Half a radian about x in the second from 40 to 41 s, which the windows that begin at 35 and 40
    # s see.
    touched = np.isin(starts, [35.0, 40.0])
    np.testing.assert_allclose(degrees[touched], np.degrees(0.5), atol=0.5)
    assert degrees[~touched].max() < 0.2  # one ends between two samples of which one is touched


def test_positions_of_another_body_need_not_correlate():
    sequence = circle()
    mirrored = sequence._replace(position=sequence.position * [-1, 1, 1])
    assert seq.self_check(mirrored, min_correlation=None).failures == ()
    assert seq.keep_plausible([mirrored], min_correlation=None) == [mirrored]
    with (
        pytest.warns(UserWarning, match="correlates by only"),
        pytest.raises(InputError, match="none of 1"),
    ):
        seq.keep_plausible([mirrored])
    # A converted recording brings along what its own dataset asks.
    chest = mirrored._replace(attributes={"check_min_correlation": -1.0, "check_pedestrian": True})
    assert seq.keep_plausible([chest]) == [chest]
    running = chest._replace(velocity=chest.velocity * 4)
    assert any("too fast" in failure for failure in seq.judge(running, pedestrian=False).failures)


def test_a_recording_without_a_reference_is_kept_where_none_is_needed():
    sequence = circle()
    bare = sequence._replace(
        valid=np.zeros_like(sequence.valid), position=sequence.position * np.nan
    )
    assert seq.keep_plausible([bare], needs_reference=False) == [bare]
    assert seq.judge(bare).failures == ("no sample has a valid reference",)


def test_keep_plausible_names_what_it_leaves_out():
    good = circle()
    upside = good._replace(name="upside", accel=-good.accel)
    with pytest.warns(UserWarning, match=r"upside: left out .* mean of R·accel") as caught:
        assert seq.keep_plausible([upside, good]) == [good]
    assert len(caught) == 1
    with (
        pytest.warns(UserWarning, match="upside"),
        pytest.raises(InputError, match="upside: none of 1 sequences"),
    ):
        seq.keep_plausible([upside])
    fast = good._replace(velocity=good.velocity * 4)
    assert seq.keep_plausible([fast], pedestrian=False) == [fast]


# --- HDF5
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", [True, False])
def test_hdf5_returns_every_bit(tmp_path, device):
    sequence = changed(circle(), "valid", 3, False)
    sequence = changed(sequence, "position", 3, np.nan)._replace(
        device_orientation=circle().orientation if device else None,
        attributes={"truth": "Vicon", "rows": 7, "bias": 0.25, "calibrated": True, "person": "Ö"},
    )
    path = tmp_path / "deep" / "walk.h5"
    seq.write_hdf5(path, sequence)
    back = seq.read_hdf5(path)
    assert back.name == "circle" and back.attributes == sequence.attributes
    assert {key: type(value) for key, value in back.attributes.items()} == {
        key: type(value) for key, value in sequence.attributes.items()
    }
    for field in (
        "time",
        "gyro",
        "accel",
        "orientation",
        "position",
        "velocity",
        "valid",
        "device_orientation",
    ):
        np.testing.assert_array_equal(getattr(back, field), getattr(sequence, field))


def test_hdf5_that_is_cut_short_or_foreign_is_named(tmp_path):
    path = tmp_path / "walk.h5"
    seq.write_hdf5(path, circle())
    whole = path.read_bytes()

    def fails(*words):
        with pytest.raises(InputError) as error:
            seq.read_hdf5(path)
        assert str(error.value).startswith(f"{path}: ") and all(
            word in str(error.value) for word in words
        )
        assert "cut short" in words or "cut short" not in str(error.value)

    for share in (0.9, 0.5, 0.01, 0.0):
        path.write_bytes(whole[: int(len(whole) * share)])
        fails("cut short")
    path.write_text("time,gyro_x\n0,1\n")
    fails("cut short")
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        del file["accel"]
    fails("field 'accel' is missing")
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        file["gyro"][4] = np.nan
    fails("'gyro'", "row 4")
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        del file["velocity"]
        file["velocity"] = "fast"
    fails("'velocity'", "not an array of numbers")
    with h5py.File(path, "w") as file:
        file["synced"] = 1.0
    fails("format")
    path.unlink()
    fails("no such file")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "walk.h5"
    seq.write_hdf5(path, circle())
    before = path.read_bytes()
    with pytest.raises(InputError, match="'shape' is list"):
        seq.write_hdf5(path, circle()._replace(attributes={"shape": [1, 2]}))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
