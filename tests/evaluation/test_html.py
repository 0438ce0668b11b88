"""The page of results: what it holds, and what a browser shows of it."""

import html.parser
import re

import numpy as np
import pytest

from gnio_jax.evaluation import Estimate, Trajectory, never_moves, report, score
from gnio_jax.evaluation import html as pages
from gnio_jax.evaluation.curves_file import with_curves
from gnio_jax.evaluation.html import folders
from gnio_jax.evaluation.html.curves import curves, ellipses, walked
from tests.support import browser
from tests.support.estimates import SETTINGS, estimate

EVIL = "</script><script>alert('x')</script><b onmouseover=alert(1)>&amp; $$x$$"
BLUE, BLACK = (0, 114, 178), (0, 0, 0)


def report_of(estimates, settings=SETTINGS):
    groups = {e.name: e.name for e in estimates}
    rows = {"never_moves": score(never_moves(estimates), groups)}
    notes = {estimates[0].name: ["start: rough"]}
    return report.Report(settings, score(estimates, groups), rows, notes, {})


@pytest.fixture(scope="module")
def walks():
    walk = estimate("walk", 0)
    # The ellipse is twice as long along y; gates that tell the axes apart.
    covariance = walk.position_covariance * np.array([1.0, 4.0, 1.0])
    return [walk._replace(position_covariance=covariance), estimate(EVIL, 1)]


@pytest.fixture(scope="module")
def entries(walks):
    ours = pages.of_evaluation(report_of(walks), walks, "gnio evaluate --workdir 'a b'", "seed: 3")
    summed = [
        Estimate(e.name, e.trajectory._replace(position=1.1 * e.trajectory.position), e.reference)
        for e in walks
    ]
    others = pages.of_evaluation(report_of(summed), summed)
    return [ours, others._replace(name="summed")]


@pytest.fixture(scope="module")
def page(entries, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    pages.write_report(path, EVIL, entries)
    return path


# The curves
# --------------------------------------------------------------------------------------------------


def test_ellipses_are_contours_of_their_covariance():
    covariance = np.array([[[4.0, 1.5], [1.5, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]])
    found = ellipses(covariance)
    angle = np.linspace(0, 2 * np.pi, 25)
    along, across = found.major[0] * np.cos(angle), found.minor[0] * np.sin(angle)
    cosine, sine = np.cos(found.angle[0]), np.sin(found.angle[0])
    points = np.stack([cosine * along - sine * across, sine * along + cosine * across], 1)
    distance = np.einsum("ki,ij,kj->k", points, np.linalg.inv(covariance[0]), points)
    np.testing.assert_allclose(distance, 9.0)
    assert found.major[0] > found.minor[0] and np.isnan(found.major[1])


def test_curves_stand_in_the_frame_of_the_reference(walks):
    """The estimate is turned by 90° and moved: alignment takes that back, for the ellipse too."""
    walk = walks[0]
    path, half = walk.trajectory, np.sqrt(0.5)
    turned = np.stack([-path.position[:, 1], path.position[:, 0], path.position[:, 2]], 1)
    w, x, y, z = path.orientation.T
    attitude = half * np.stack([w - z, x - y, y + x, z + w], 1)  # a quarter turn from the left
    covariance = walk.position_covariance[:, [1, 0, 2]][:, :, [1, 0, 2]]
    moved = walk._replace(
        trajectory=Trajectory(path.time, turned + 5.0, attitude), position_covariance=covariance
    )
    whole, found = curves(walk, "origin", 1000), curves(moved, "origin", 1000)
    np.testing.assert_allclose(found.position, whole.position, atol=1e-9)
    np.testing.assert_allclose(found.error, whole.error, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sin(whole.ellipses.angle)), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sin(found.ellipses.angle)), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.ellipses.major, 2 * found.ellipses.minor)
    # By hand: the starts are one, and so are the yaws.
    shift = path.position[0] - walk.reference.position[0]
    error = np.linalg.norm((path.position - shift - walk.reference.position)[:, :2], axis=1)
    np.testing.assert_allclose(whole.error, error, atol=1e-9)


def test_thinned_curves_keep_the_largest_innovation(walks):
    nis = np.full(400, 2.0)
    nis[[0, 201]], nis[3:6] = [np.nan, 70.0], np.nan
    found = curves(walks[0]._replace(nis=nis), "origin", 150)
    assert len(found.time) == 134 and found.time[1] == pytest.approx(0.3)
    path = walks[0].trajectory.position
    np.testing.assert_allclose(np.diff(found.position[:3], axis=0), path[[3, 6]] - path[[0, 3]])
    assert found.nis[67] == 70.0 and found.nis[0] == 2.0 and np.isnan(found.nis[1])
    assert np.isnan(found.scale).all() and np.isfinite(found.gate[-1]).all()


def test_the_distance_walked_is_not_of_noise():
    time = np.arange(100) * 0.1
    path = np.stack([1.5 * time, 0.01 * (-1.0) ** np.arange(100), 0 * time], 1)
    path[50:60] = np.nan  # hides the seconds that begin at 4 s and 5 s
    found = walked(path, time)
    assert found[30] == pytest.approx(4.5, abs=1e-3)
    assert found[-1] == pytest.approx(1.5 * (9.9 - 2.0), abs=0.01)


# The file
# --------------------------------------------------------------------------------------------------


class Loads(html.parser.HTMLParser):
    """What the tags of a page load, and how many there are of each."""

    def __init__(self, text):
        super().__init__()
        self.places, self.tags = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            assert not name.startswith("on"), (tag, name)
            if name in ("src", "href", "srcset", "data", "action"):
                self.places.append(value)


def test_the_page_is_one_file_that_loads_nothing(page):
    text = page.read_text(encoding="utf-8")
    loads = Loads(text)
    assert loads.places == ["data:,"]  # the icon, which a browser would ask a server for
    assert "b" not in loads.tags and "alert('x')</script>" not in text
    assert not re.search(r"@import|url\(\s*['\"]?https?:", text.partition("<body>")[0])
    assert "default-src 'none'" in text and len(text) < 3e6
    assert "gnio evaluate --workdir &#39;a b&#39;" in text and "seed: 3" in text
    assert "walk: start: rough" in text


def test_the_table_has_the_figures_of_both_runs(page, entries):
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "|", page.read_text(encoding="utf-8")))
    for entry in entries:
        ate, seconds = (entry.figures["walk"][name] for name in ("ate", "duration"))
        line = re.search(rf"walk\|+ ?\|+{entry.name}\|[^a-z]*", text).group()
        assert f"|{ate:.2f}|" in line and f"|{seconds:.0f}|" in line
    assert "never moves" in text and "orientation source" in text


def test_the_windows_are_told_with_their_context():
    windows = {"window_seconds": 1.0, "rate": 100.0}
    assert pages.windows_in_words(windows) == "1 s at 100 Hz"
    assert pages.windows_in_words({**windows, "context_seconds": 0.0}) == "1 s at 100 Hz"
    with_context = pages.windows_in_words({**windows, "context_seconds": 0.5})
    assert with_context == "1 s at 100 Hz, and 0.5 s before"


def test_a_page_that_fails_leaves_the_old_one(page, entries, monkeypatch):
    before = page.read_bytes()
    monkeypatch.setattr("pathlib.Path.write_text", lambda *_, **__: (_ for _ in ()).throw(OSError))
    with pytest.raises(OSError):
        pages.write_report(page, "new", entries)
    assert page.read_bytes() == before and len(list(page.parent.iterdir())) == 1


def test_an_hour_is_thinned(walks, tmp_path):
    """36,000 rows, 15 of which of each curve would be 4 MB."""
    rows = np.arange(36000) % 400

    def longer(values):
        return values[rows] if isinstance(values, np.ndarray) else values

    walk = walks[0]
    time = 0.1 * np.arange(36000)
    paths = (Trajectory(time, *map(longer, each[1:])) for each in (walk.trajectory, walk.reference))
    hour = Estimate(walk.name, *paths, *map(longer, walk[3:5]), {"gate": longer(walk.displacement)})
    made = pages.of_evaluation(report_of([walk]), [hour])
    assert len(pages.render("hour", [made])) < 2.5e6


def test_evaluations_beside_are_read_back(tmp_path, estimates, made):
    settings = SETTINGS | {"definitions": report.DEFINITIONS, "model": "gnio", "step": 7}
    of = {
        "ours": settings,
        "summed": settings | {"estimator": "integrate", "orientation_source": "device"},
        "again": settings,
        "imu": settings | {"estimator": "imu_only", "model": None, "step": None},
        "older": settings | {"definitions": 1},
        "other": settings | {"step": 8},
        "another": settings | {"split": "val"},
    }
    for name, each in of.items():
        (tmp_path / name).mkdir()
        report.write(tmp_path / name, made._replace(settings=each), estimates)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metrics.json").write_text("{")
    found = folders.beside(tmp_path / "ours", settings)
    assert [entry.name for entry in found] == ["again", "imu_only", "integrate, device orientation"]
    first = found[0]
    for name, measures in made.scores.sequences.items():
        for metric, value in measures.values.items():
            assert first.figures[name][metric] == value
    np.testing.assert_allclose(
        first.estimates[0].reference.position, estimates[0].reference.position, atol=1e-8
    )
    assert np.isnan(first.estimates[2].reference.position).all()
    assert first.summary["never moves"]["path_length_ratio"] == 0


def test_a_page_made_later_has_the_strips_of_the_first(tmp_path, walks):
    """σ, NIS, gate, scale and ellipses, of a filter that diverged at the end, too."""
    lost = walks[1].trajectory.position.copy()
    lost[380:] = np.nan
    walks = [walks[0], walks[1]._replace(trajectory=walks[1].trajectory._replace(position=lost))]
    walks[0].diagnostics["scale"] = 1.0 + 0.1 * walks[0].displacement
    (tmp_path / "eval").mkdir()
    told = report_of(walks, SETTINGS | {"definitions": report.DEFINITIONS})
    report.write(tmp_path / "eval", told, walks)
    now, later = pages.of_evaluation(told, walks), folders.read_entry(tmp_path / "eval")
    assert later.remarks == now.remarks and later.remarks[0] == "walk: start: rough"
    assert "diverged" in later.remarks[-1]
    for ours, theirs, rows in zip(now.estimates, later.estimates, (400, 380), strict=True):
        first, again = (curves(each, "none", 400) for each in (ours, theirs))
        assert np.isfinite(again.std).any() and np.isfinite(again.nis).any()
        for name in set(first._fields) - {"sequence", "ellipses"}:
            found, wanted = getattr(again, name), getattr(first, name)[:rows]
            if name == "distance":  # its last second is known less well
                found, wanted = found[:-10], wanted[:-10]
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6, err_msg=name)
        for found, wanted in zip(again.ellipses, first.ellipses, strict=True):
            np.testing.assert_allclose(found, wanted[:rows], rtol=1e-5, atol=1e-6)
    file = tmp_path / "eval" / "curves" / "walk.npz"
    assert file.stat().st_size < 400 * 16 * 4
    file.write_bytes(file.read_bytes()[:200])  # what is damaged costs the strips alone
    damaged = folders.read_entry(tmp_path / "eval").estimates[0]
    assert damaged.nis is None and len(damaged.trajectory.time) == 400


def compressed(file, **arrays):
    np.savez_compressed(file, **arrays)
    return file.read_bytes()


def test_damaged_curves_cost_the_strips_alone(tmp_path, walks):
    """Whatever was damaged: bits of the compressed numbers, or what they are."""
    file, n = tmp_path / "walk.npz", len(walks[0].trajectory.time)
    nis, std = np.linspace(0, 9, n), np.ones((n, 3))
    sound = compressed(file, nis=nis, std=std)
    assert with_curves(walks[0], file).displacement_std is not None
    bare = walks[0]._replace(nis=None)
    flipped = (sound[:k] + bytes([sound[k] ^ 0xFF]) + sound[k + 1 :] for k in range(0, 400, 3))
    others = ({"nis": np.float32(1)}, {"covariance": std}, {"nis": std}, {"gate": nis})
    for content in (*flipped, *(compressed(file, **each) for each in others)):
        file.write_bytes(content)
        found = with_curves(bare, file)
        assert found.nis is None or found.nis.shape == (n,)
        assert len(found.trajectory.time) == n


# In a browser
# --------------------------------------------------------------------------------------------------

PLACE = """(() => {
  const [view] = Bokeh.index.roots;
  const {x_range, y_range} = view.model;
  const box = view.canvas.el.getBoundingClientRect(), frame = view.frame.bbox;
  return {left: box.left + frame.left, right: box.left + frame.right, top: box.top + frame.top,
          bottom: box.top + frame.bottom, x: [x_range.start, x_range.end],
          y: [y_range.start, y_range.end]};
})()"""
SLIDE = """(() => {
  const slider = document.getElementById("time");
  slider.value = %s;
  slider.dispatchEvent(new Event("input"));
  const told = document.getElementById("readout").textContent;
  return new Promise((done) => setTimeout(() => done(told), 300));  // until it is painted
})()"""
CHOOSE = """(() => {
  document.querySelectorAll("tr[data-sequence]")[2].click();
  return document.getElementById("sequence").selectedOptions[0].textContent;
})()"""


def pixels(place, points):
    """Where points (m) lie on the screen, (column, row)."""
    (x0, x1), (y0, y1) = place["x"], place["y"]
    column = place["left"] + (points[:, 0] - x0) / (x1 - x0) * (place["right"] - place["left"])
    row = place["bottom"] + (points[:, 1] - y0) / (y1 - y0) * (place["top"] - place["bottom"])
    return np.stack([column, row], 1).round().astype(int)


def share_near(picture, places, colour, reach=2):
    """Share of the places that have a pixel of about this colour within `reach` pixels."""
    alike = np.abs(picture.astype(int) - colour).max(2) < 60
    return np.mean(
        [alike[r - reach : r + reach + 1, c - reach : c + reach + 1].any() for c, r in places]
    )


@pytest.mark.skipif(browser.NAME is None, reason="no Chromium here (apt-get install chromium)")
def test_in_a_browser(page, walks):
    """It opens from the disk, asks for nothing, draws both paths where they are, and the slider
    moves the marker with its ellipse."""
    walk = walks[0]
    whole = curves(walk, "origin", 400)
    with browser.browser() as tab:
        tab.open(page, width=1500)  # the map is wider than high, unlike the walk
        place, before = tab.evaluate(PLACE), tab.picture()
        per_metre = [
            (place["right"] - place["left"]) / np.ptp(place["x"]),
            (place["bottom"] - place["top"]) / np.ptp(place["y"]),
        ]
        assert per_metre[0] == pytest.approx(per_metre[1], rel=0.02)  # equal axes
        told = tab.evaluate(SLIDE % 12.04)
        after = tab.picture()
        assert tab.evaluate(CHOOSE) == EVIL
        told_of_other = tab.evaluate(SLIDE % 20.0)
        assert tab.errors == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in tab.requests)
    rows = np.arange(5, 395, 5)
    for colour, points in ((BLUE, whole.position), (BLACK, whole.reference)):
        found = share_near(before, pixels(place, points[rows]), colour)
        assert found > (0.95 if colour == BLUE else 0.6), (colour, found)
    assert share_near(before, pixels(place, 1.4 * whole.position[rows]), BLUE) < 0.1
    # The marker is where the walk is at 12 s, and no longer at its end.
    x, y = whole.position[120, :2]
    assert f"12.0 s  ·  x {x:.1f} m, y {y:.1f} m  ·  error {whole.error[120]:.2f} m" in told
    assert f"3σ {whole.ellipses.major[120]:.2f} × {whole.ellipses.minor[120]:.2f} m" in told
    size = whole.ellipses.major[120] * 0.8 * np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])
    around = pixels(place, whole.position[120, :2] + size)
    changed = np.abs(after.astype(int) - before).max(2) > 15
    inside = [changed[row - 2 : row + 3, column - 2 : column + 3].any() for column, row in around]
    assert inside == [True, True, False, False]  # its major axis is along y
    assert told_of_other.startswith("20.0 s") and told_of_other != told
