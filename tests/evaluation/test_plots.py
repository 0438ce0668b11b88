"""Pictures are drawn and show what they say."""

import jax
import numpy as np
import pytest

from gnio_jax import drawing
from gnio_jax.evaluation import Trajectory, plots
from gnio_jax.evaluation.views import ellipses, make_view
from tests.support.estimates import with_covariance
from tests.support.reports import LOST, report_of


def labels(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_ellipses_are_contours_of_their_covariance():
    covariance = np.array([[[4.0, 1.5, 0], [1.5, 1.0, 0], [0, 0, 9]], np.full((3, 3), np.nan)])
    found = ellipses(covariance)
    angle = np.linspace(0, 2 * np.pi, 25)
    along, across = found.major[0] * np.cos(angle), found.minor[0] * np.sin(angle)
    cosine, sine = np.cos(found.angle[0]), np.sin(found.angle[0])
    points = np.stack([cosine * along - sine * across, sine * along + cosine * across], 1)
    inverse = np.linalg.inv(covariance[0, :2, :2])
    distance = np.einsum("ki,ij,kj->k", points, inverse, points)
    np.testing.assert_allclose(distance, 9.0)
    assert found.major[0] > found.minor[0] and np.isnan(found.major[1])


def test_an_estimate_is_seen_in_the_frame_of_the_reference(estimates):
    """The estimate is turned by 90° and moved: alignment takes that back, for the ellipse too."""
    walk = estimates[0]
    walk = with_covariance(walk, walk.filtered.covariance * np.array([1.0, 4.0, 1.0]))
    path, half = walk.trajectory, np.sqrt(0.5)
    turned = np.stack([-path.position[:, 1], path.position[:, 0], path.position[:, 2]], 1)
    w, x, y, z = path.orientation.T
    attitude = half * np.stack([w - z, x - y, y + x, z + w], 1)  # a quarter turn from the left
    covariance = walk.filtered.covariance[:, [1, 0, 2]][:, :, [1, 0, 2]]
    moved = with_covariance(walk, covariance)
    moved = moved._replace(trajectory=Trajectory(path.time, turned + 5.0, attitude))
    whole, found = make_view(walk), make_view(moved)
    np.testing.assert_allclose(found.position, whole.position, atol=1e-9)
    angles = [ellipses(seen.filtered.covariance).angle for seen in (whole, found)]
    np.testing.assert_allclose(np.abs(np.sin(angles)), 1.0, atol=1e-6)
    # By hand: the starts are one, and so are the yaws.
    shift = path.position[0] - walk.reference.position[0]
    np.testing.assert_allclose(whole.position, path.position - shift, atol=1e-9)
    np.testing.assert_array_equal(whole.reference, walk.reference.position)
    # A track stays where it is, and its reference comes to it.
    own = make_view(moved, alignment=None)
    np.testing.assert_array_equal(own.position, moved.trajectory.position)
    np.testing.assert_allclose(own.reference[0], moved.trajectory.position[0], atol=1e-9)


def test_the_picture_of_a_sequence(estimates):
    seen = make_view(estimates[0])
    figure = plots.sequence(seen, "walk: ATE 1.23 m")
    plan, horizontal, vertical, speed, gate = figure.axes
    assert figure.get_suptitle() == "walk: ATE 1.23 m" and plan.get_aspect() == 1.0
    assert labels(plan) == ["reference", "estimate", "3σ", "start", "end"]
    reference, path = plan.get_lines()[:2]
    np.testing.assert_array_equal(reference.get_xydata(), seen.reference[:, :2])
    np.testing.assert_array_equal(path.get_xydata(), seen.position[:, :2])
    assert len(plan.patches) == plots.ELLIPSES
    error = np.linalg.norm((seen.position - seen.reference)[:, :2], axis=1)
    np.testing.assert_allclose(horizontal.get_lines()[0].get_ydata(), error)
    bands = [axes.collections[0].get_paths()[0].vertices[:, 1] for axes in (horizontal, vertical)]
    bound = 3 * 0.03 * np.sqrt(400)
    assert [band.max() for band in bands] == pytest.approx([bound, bound])
    assert [band.min() for band in bands] == pytest.approx([0, -bound])
    assert np.nanmax(speed.get_lines()[0].get_ydata()) == pytest.approx(1.6, abs=0.02)
    assert labels(gate)[-3:] == ["x", "y", "z"]
    (shaded,) = [patch for patch in speed.patches if patch.get_width() > 1]
    assert (shaded.get_x(), shaded.get_width()) == pytest.approx((15, 7), abs=1)


def test_without_a_reference_nothing_is_called_an_error(estimates):
    blind = estimates[2]
    blind = blind._replace(displacements=blind.displacements._replace(diagnostics={}))
    figure = plots.sequence(make_view(blind, alignment=None))
    plan, horizontal, vertical, speed, used = figure.axes
    assert "reference" not in labels(plan) and labels(horizontal) == ["3σ"]
    assert "error" not in horizontal.get_ylabel() + vertical.get_ylabel()
    assert labels(speed) == ["estimate"]
    assert labels(used) == ["used"]
    bare = make_view(blind._replace(filtered=None))
    assert len(plots.sequence(bare).axes) == 2


def test_the_distribution_of_errors_counts_what_diverged(with_divergence):
    of, made = with_divergence
    figure = plots.error_cdf([make_view(each, "se3") for each in of], made)
    left, right = figure.axes
    of_one, of_all = left.get_lines()[1], left.get_lines()[3]
    assert of_one.get_ydata()[-1] == pytest.approx(0.5)  # the lost walk: 200 of 400 samples
    assert of_all.get_label() == "all samples"
    assert of_all.get_ydata()[-1] == pytest.approx(1000 / 1200)
    assert right.get_lines()[0].get_ydata()[-1] == pytest.approx(2 / 3)


def test_one_picture_for_each_sequence(tmp_path, estimates, made):
    plots.save_all(tmp_path, [make_view(each) for each in estimates[:2]], made)
    pictures = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert pictures.keys() == {"error_cdf.png", "room_1_walk.png", "room_1_walk_.png"}
    assert all(each.startswith(b"\x89PNG") for each in pictures.values())
    seen = make_view(estimates[0])._replace(name="a$x^$\udcff")  # of any bytes, and short
    kept = (x for x in seen._fields if x not in ("name", "waypoints", "at_waypoints"))
    parts = {x: jax.tree.map(lambda rows: rows[:3], getattr(seen, x)) for x in kept}
    assert np.isnan(plots.speed(parts["position"], 0.1)).all()
    drawing.save(tmp_path / "p.png", plots.sequence(seen._replace(**parts)))


def test_rows_side_by_side():
    """Dots of what diverged are not there; its name is marked. Names that Matplotlib would read
    otherwise stand as they are."""
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
