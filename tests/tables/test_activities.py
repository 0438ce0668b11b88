"""Windows by activity, by hand."""

import numpy as np
import pytest

from gnio_jax.errors import InputError
from gnio_jax.tables import activities
from tests.support import indoor_location_files, tiny_run


def test_activities_by_speed():
    truth = np.array(
        [[0.01, 0, 0], [0.3, 0.4, 0], [1.3, 0, 0.02], [0, 2.5, 0], [0.4, 0, 0.3], [0, 0, 0.08]]
    )
    names = [activities.ACTIVITIES[k] for k in activities.activity(truth, 1.0)]
    assert names == ["standing", "slow", "walking", "running", "stairs", "slow"]
    names = [activities.ACTIVITIES[k] for k in activities.activity(truth, 2.0)[[1, 3]]]
    assert names == ["slow", "walking"]  # the same way in twice the time


def test_figures_of_windows_by_hand():
    attention = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.0, 1.0], [0.5, 0.5]]])
    predicted = activities.PredictedWindows(
        np.zeros((2, 3)),
        np.array([[0.3, 0, 0.4], [0.0, 0.1, 0]]),
        np.full((2, 3), 0.1),
        {"gate": np.array([[-0.2, 0.4, 9.0], [1.0, 1.0, 9.0]]), "attention": attention},
        np.array([0, 2]),
    )
    figures = activities.by_activity(predicted)
    assert set(figures) == {"standing", "walking"}
    expected = {"error": 0.5, "gate": 0.3, "normalised": np.sqrt((9 + 16) / 3)}
    assert {name: figures["standing"][name] for name in expected} == pytest.approx(expected)
    assert figures["walking"]["length"] == pytest.approx(0.1)
    # First head certain and different, second undecided: half the entropy in a window, all of it in
    # their mean.
    assert activities.entropy(attention) == pytest.approx((0.5, 1.0))


def test_information_of_prototypes():
    rng = np.random.default_rng(0)
    activity = rng.integers(0, 4, 4000)
    attention = np.full((4000, 2, 8), 0.05)
    attention[np.arange(4000), :, activity] = 0.65
    nothing = [np.zeros((4000, 3))] * 3
    predicted = activities.PredictedWindows(*nothing, {"attention": attention}, activity)
    bits, chance = activities.information(predicted)
    # Four equally frequent activities: two bits.
    assert bits == pytest.approx(2.0, abs=0.01) and chance < 0.01
    names, lifts = activities.attention_by_activity(predicted)
    assert names == ["standing", "slow", "walking", "running"]
    np.testing.assert_array_equal(lifts.argmax(1), [0, 1, 2, 3])
    np.testing.assert_allclose(lifts[:, 4:], 1.0)


def test_walks_with_waypoints_have_no_true_windows(tmp_path):
    with tiny_run.registry_entry():
        run = tiny_run.save(tmp_path / "tiny_s0", tiny_run.CONFIGURED)
        indoor_location_files.write(tmp_path)
        recordings = activities.Recordings("indoor_location", str(tmp_path), "test")
        with pytest.raises(InputError, match="has waypoints, no poses; name another --dataset"):
            activities.predict_split(run, recordings)
