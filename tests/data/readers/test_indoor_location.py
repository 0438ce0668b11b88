"""Indoor Location: a known walk, traps included, must come back with its waypoints."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers import indoor_location
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from tests.support import known_walk as walk
from tests.support.indoor_location_files import NAME, START, TAPS, field, lines, write


def check_walk(sequence):
    time = sequence.time
    np.testing.assert_allclose(np.diff(time), 0.02, rtol=1e-6)
    inner = slice(5, -5)  # stamps are whole ms, and splines err at their ends
    np.testing.assert_allclose(sequence.gyro[inner], walk.rate(time)[inner], atol=0.02)
    np.testing.assert_allclose(sequence.accel[inner], walk.force(time)[inner], atol=0.1)
    taps = sequence.waypoints
    np.testing.assert_allclose(taps.time, np.maximum(TAPS, 0.0), atol=1e-9)
    np.testing.assert_allclose(taps.position, walk.position(TAPS)[:, :2], atol=1e-6)
    magnetometer = sequence.readings["magnetometer"]
    assert len(magnetometer.time) > 1500 and (np.diff(magnetometer.time) > 0).all()
    np.testing.assert_allclose(magnetometer.values, field(magnetometer.time), atol=1e-3)
    assert np.isnan(magnetometer.std).all()


def test_a_walk_comes_back_with_its_waypoints(tmp_path):
    (sequence,) = indoor_location.read(write(tmp_path))
    check_walk(sequence)
    assert not sequence.valid.any() and np.isnan(sequence.position).all()
    assert sequence.name == f"site1_F4_{NAME}"
    attributes = sequence.attributes
    assert attributes["start_time"] == pytest.approx(START / 1e3, abs=1e-4)
    assert attributes["group"] == "site1_F4" and attributes["device"] == "OPPO PBCM10"
    assert attributes["truth"] == "waypoints"
    check = self_check(sequence)
    assert check.failures == () and np.isnan(check.accel_correlation_horizontal)


def test_lines_that_are_merged_repeated_or_out_of_order_come_back(tmp_path):
    text = lines()
    text[200:200] = text[200:230]
    text[400], text[403] = text[403], text[400]
    tap = next(i for i, line in enumerate(text[500:], 500) if "WAYPOINT" in line)
    for row in (tap - 1, tap - 40, 20):
        text[row : row + 2] = [text[row] + text[row + 1]]
    (sequence,) = indoor_location.read(write(tmp_path, text))
    check_walk(sequence)


def test_a_walk_may_have_no_magnetometer_but_no_damaged_one(tmp_path):
    text = [line for line in lines() if "MAGNETIC" not in line]
    (sequence,) = indoor_location.read(write(tmp_path, text))
    assert sequence.readings == {}
    text = lines()
    row = next(i for i, line in enumerate(text) if "MAGNETIC" in line)
    text[row] = "\t".join(text[row].split("\t")[:4])
    with pytest.raises(InputError, match=f"'TYPE_MAGNETIC_FIELD' is cut short.* in line {row + 1}"):
        indoor_location.read(write(tmp_path, text))


def test_a_walk_of_few_waypoints_is_of_no_use(tmp_path):
    path = write(tmp_path, lines(taps=TAPS[:2]))
    with pytest.raises(Refusal, match="'TYPE_WAYPOINT' holds 2, at least 3"):
        indoor_location.read(path)
    with pytest.raises(InputError), pytest.warns(UserWarning, match=f"left out: .*{NAME}"):
        data.load("indoor_location", tmp_path, "test")
