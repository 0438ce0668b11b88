"""Pictures are drawn and show what they say."""

import numpy as np
import pytest

from gnio_jax.evaluation import Trajectory, plots
from tests.support.estimates import SETTINGS


@pytest.fixture(autouse=True)
def few_dots(monkeypatch):
    monkeypatch.setattr(plots, "DOTS_PER_INCH", 30)


@pytest.mark.parametrize("alignment", ["origin", "yaw_position", "se3"])
def test_the_distribution_of_errors_counts_what_diverged(with_divergence, alignment):
    of, found = with_divergence
    figure = plots.error_cdf(of, found._replace(settings=SETTINGS | {"alignment": alignment}))
    left, right = figure.axes
    of_one, of_all = left.get_lines()[1], left.get_lines()[3]
    assert of_one.get_ydata()[-1] == pytest.approx(0.5)  # the lost walk: 200 of 400 samples
    assert of_all.get_label() == "all samples"
    assert of_all.get_ydata()[-1] == pytest.approx(1000 / 1200)
    assert right.get_lines()[0].get_ydata()[-1] == pytest.approx(2 / 3)


def test_what_diverged_is_drawn(tmp_path, with_divergence):
    plots.save_all(tmp_path, *with_divergence, 1.0)


def test_an_estimate_lost_before_the_reference_begins_is_drawn(estimates):
    """No row has both, so nothing aligns it: the error is not there, its bounds are."""
    whole, rows = estimates[0], np.arange(400)[:, None]
    path, reference = (
        Trajectory(of.time, *(np.where(there, part, np.nan) for part in of[1:]))
        for of, there in ((whole.trajectory, rows < 5), (whole.reference, rows >= 10))
    )
    figure = plots.position_error(whole._replace(trajectory=path, reference=reference))
    for axes in figure.axes:
        assert np.isnan(axes.get_lines()[0].get_ydata()).all()
        assert np.isfinite(axes.collections[0].get_paths()[0].vertices).all()


def test_plots_are_drawn(tmp_path, estimates, made):
    plots.save_all(tmp_path, estimates, made, 1.0)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "error_cdf.png",
        *(
            f"{stem}_{kind}.png"
            for stem in ("room_1_walk", "room_1_walk_")
            for kind in ("trajectory", "error", "displacement")
        ),
        "blind_trajectory.png",
        "blind_displacement.png",
    }
    assert all((tmp_path / name).read_bytes()[:4] == b"\x89PNG" for name in names)


def test_plots_say_what_they_show(estimates):
    figure = plots.trajectory(estimates[0], 1.234, 1.1)
    (axes,) = figure.axes
    assert (
        "1.23 m" in axes.get_title() and axes.get_aspect() == 1.0 and axes.get_xlabel() == "x (m)"
    )
    reference, path = axes.get_lines()[:2]
    np.testing.assert_array_equal(reference.get_xydata(), estimates[0].reference.position[:, :2])
    np.testing.assert_allclose(
        path.get_xydata()[0], estimates[0].reference.position[0, :2], atol=1e-12
    )

    figure = plots.displacement(estimates[0], 1.0)
    assert [a.get_ylabel() for a in figure.axes] == [
        "speed (m/s)",
        "displacement (m)",
        "gate γ (–)",
    ]
    truth, speed = figure.axes[0].get_lines()[:2]
    assert np.nanmax(truth.get_ydata()) == pytest.approx(1.6, abs=0.02)
    np.testing.assert_allclose(speed.get_xdata(), np.arange(400) * 0.1 - 0.5, atol=1e-6)
    shaded = figure.axes[0].patches
    assert (
        len(shaded) == 1
        and shaded[0].get_x() == pytest.approx(15, abs=0.5)
        and shaded[0].get_width() == pytest.approx(7, abs=1)
    )

    error = plots.position_error(estimates[0])
    band = error.axes[0].collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(3 * 0.03 * np.sqrt(400))
