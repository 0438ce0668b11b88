"""The content of pictures."""

import jax
import numpy as np
import pytest

from gnio_jax import drawing
from gnio_jax.evaluation import plots
from gnio_jax.evaluation.views import horizontal_speed, make_view
from tests.support.reports import LOST, report_of


def labels(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_the_picture_of_a_sequence_has_its_curves(estimates):
    view = make_view(estimates[0])
    figure = plots.sequence(view, "walk: ATE 1.23 m")
    plan, horizontal, vertical, speed, gate = figure.axes
    assert figure.get_suptitle() == "walk: ATE 1.23 m" and plan.get_aspect() == 1.0
    assert labels(plan) == ["reference", "estimate", "3σ", "start", "end"]
    reference, path = plan.get_lines()[:2]
    np.testing.assert_array_equal(reference.get_xydata(), view.reference[:, :2])
    np.testing.assert_array_equal(path.get_xydata(), view.position[:, :2])
    assert len(plan.patches) == plots.ELLIPSES
    error = np.linalg.norm((view.position - view.reference)[:, :2], axis=1)
    np.testing.assert_allclose(horizontal.get_lines()[0].get_ydata(), error)
    bands = [axes.collections[0].get_paths()[0].vertices[:, 1] for axes in (horizontal, vertical)]
    bound = 3 * 0.03 * np.sqrt(400)
    assert [band.max() for band in bands] == pytest.approx([bound, bound])
    assert [band.min() for band in bands] == pytest.approx([0, -bound])
    assert np.nanmax(speed.get_lines()[0].get_ydata()) == pytest.approx(1.6, abs=0.02)
    assert labels(gate)[-3:] == ["x", "y", "z"]
    (shaded,) = [patch for patch in speed.patches if patch.get_width() > 1]
    assert (shaded.get_x(), shaded.get_width()) == pytest.approx((15, 7), abs=1)


def test_paths_and_errors_decide_the_scale_and_not_large_ellipses(estimates):
    walk = estimates[0]
    for size in (1.0, 1e4):
        filtered = walk.filtered._replace(covariance=size * walk.filtered.covariance)
        view = make_view(walk._replace(filtered=filtered))
        figure = plots.sequence(view)
        drawing.FigureCanvasAgg(figure).draw()
        plan, horizontal, vertical, *_ = figure.axes
        extent = np.ptp(np.concatenate([view.position, view.reference])[:, :2], axis=0)
        shown = np.ptp(plan.get_xlim()), np.ptp(plan.get_ylim())
        # One of the axes is filled to two thirds; the other one has the same scale.
        assert max(extent / shown) == pytest.approx(1 / 1.5, rel=1e-6)
        error = np.linalg.norm((view.position - view.reference)[:, :2], axis=1).max()
        assert error < horizontal.get_ylim()[1] <= 3 * error + 1e-9
        assert vertical.get_ylim()[0] == -vertical.get_ylim()[1]


def test_a_picture_without_a_reference_shows_no_error(estimates):
    blind = estimates[2]
    blind = blind._replace(displacements=blind.displacements._replace(diagnostics={}))
    figure = plots.sequence(make_view(blind, alignment=None))
    plan, horizontal, vertical, speed, used = figure.axes
    assert "reference" not in labels(plan) and labels(horizontal) == ["3σ"]
    assert "error" not in horizontal.get_ylabel() + vertical.get_ylabel()
    assert labels(speed) == ["estimate"]
    assert labels(used) == ["accepted"]
    bare = make_view(blind._replace(filtered=None))
    assert len(plots.sequence(bare).axes) == 2


def test_the_distribution_of_errors_counts_what_diverged(with_divergence):
    walks, report = with_divergence
    figure = plots.error_cdf([make_view(estimate, "se3") for estimate in walks], report)
    sample_axes, sequence_axes = figure.axes
    of_one, of_all = sample_axes.get_lines()[1], sample_axes.get_lines()[3]
    assert of_one.get_ydata()[-1] == pytest.approx(0.5)  # the lost walk: 200 of 400 samples
    assert of_all.get_label() == "all samples"
    assert of_all.get_ydata()[-1] == pytest.approx(1000 / 1200)
    assert sequence_axes.get_lines()[0].get_ydata()[-1] == pytest.approx(2 / 3)


def test_each_sequence_has_a_picture(tmp_path, estimates, made_report):
    plots.save_all(tmp_path, [make_view(estimate) for estimate in estimates[:2]], made_report)
    pictures = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert pictures.keys() == {"error_cdf.png", "room_1_walk.png", "room_1_walk_.png"}
    assert all(picture.startswith(b"\x89PNG") for picture in pictures.values())
    view = make_view(estimates[0])._replace(name="a$x^$\udcff")  # any bytes
    fields = (x for x in view._fields if x not in ("name", "waypoints", "at_waypoints"))
    parts = {x: jax.tree.map(lambda rows: rows[:3], getattr(view, x)) for x in fields}
    assert np.isnan(horizontal_speed(parts["position"], 0.1)).all()
    drawing.save(tmp_path / "p.png", plots.sequence(view._replace(**parts)))


def test_sequences_have_a_dot_for_each_row():
    """A sequence that diverged has no dot, and its name is marked. Names that Matplotlib would
    interpret are shown as they are."""
    groups = {"a": "ann", "b": "bob", "c": "bob"}
    seeds = ({"a": 1.0, "b": 5.0}, {"a": 3.0, "b": 7.0})
    first = [report_of(ates, groups) for ates in seeds]
    second = [report_of({"a": LOST, "b": 2.0, "c": 4.0}, groups)]
    figure = plots.sequence_dots({"a$x^$": first, "_under": second, "\udcff_x": second}, "ate")
    (axes,) = figure.axes
    assert axes.get_xlabel() == "ATE (m)" and axes.get_title() == "synthetic test"
    ticks = [label.get_text() for label in axes.get_yticklabels()]
    assert ticks == ["c  (bob)", "a  (ann) †", "b  (bob)"]
    dots = [line for line in axes.get_lines() if line.get_marker() == "o"]
    assert list(dots[0].get_xdata()) == [2.0, 6.0]
    np.testing.assert_array_equal(dots[1].get_xdata(), [4.0, np.nan, 2.0])
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert shown == [r"a\$x^\$", "\u200b_under", r"\udcff_x", "† an estimate diverged"]
