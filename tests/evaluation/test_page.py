"""The page of results: what it holds, and what a browser shows of it."""

import html.parser
import re

import numpy as np
import pytest

from gnio_jax.config import TrainConfig
from gnio_jax.evaluation import Estimate, Trajectory, page, plots, report
from tests.support import browser
from tests.support.estimates import SETTINGS, estimate, reported, with_covariance

EVIL = "</script><script>alert('x')</script><b onmouseover=alert(1)>&amp; $$x$$"
BLUE, BLACK = (0, 114, 178), (0, 0, 0)


def run_of(estimates, *more, **named):
    made = reported(estimates, notes={estimates[0].name: ["start: rough"]})
    return page.of_report(made, [plots.view(each) for each in estimates], *more, **named)


@pytest.fixture(scope="module")
def walks():
    walk = estimate("walk", 0)
    # The ellipse is twice as long along y; gates that tell the axes apart.
    covariance = walk.filtered.covariance * np.array([1.0, 4.0, 1.0])
    return [with_covariance(walk, covariance), estimate(EVIL, 1)]


@pytest.fixture(scope="module")
def runs(walks):
    summed = [
        Estimate(e.name, e.trajectory._replace(position=1.1 * e.trajectory.position), e.reference)
        for e in walks
    ]
    ours = run_of(walks, "gnio evaluate --workdir 'a b'", "seed: 3")
    return [ours, run_of(summed, name="summed")]


@pytest.fixture(scope="module")
def written(runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    page.write(path, EVIL, runs)
    return path


# --- columns


def test_thinned_curves_keep_the_largest_innovation(walks):
    nis = np.full(400, 2.0)
    nis[[0, 201]], nis[3:6] = [np.nan, 70.0], np.nan
    seen = plots.view(walks[0]._replace(filtered=walks[0].filtered._replace(nis=nis)))
    found = page.columns(seen, 150)
    assert len(found["time"]) == 134 and found["time"][1] == pytest.approx(0.3)
    np.testing.assert_allclose(found["x"][:3], seen.position[:9:3, 0], rtol=1e-6)
    assert found["nis"][67] == 70.0 and found["nis"][0] == 2.0 and np.isnan(found["nis"][1])
    assert "scale_x" not in found and np.isfinite(found["gate_x"][-1])
    assert all(len(values) == 134 and values.dtype == np.float32 for values in found.values())


def test_the_distance_walked_is_not_of_noise():
    time = np.arange(100) * 0.1
    path = np.stack([1.5 * time, 0.01 * (-1.0) ** np.arange(100), 0 * time], 1)
    path[50:60] = np.nan  # hides the seconds that begin at 4 s and 5 s
    found = page.walked(path, time, 0.1)
    assert found[30] == pytest.approx(4.5, abs=1e-3)
    assert found[-1] == pytest.approx(1.5 * (9.9 - 2.0), abs=0.01)


def test_the_map_has_room_for_the_ellipses_and_no_more_than_the_walk_again(walks):
    walk = walks[0]
    small, seen = (run_of([with_covariance(walk, p * walk.filtered.covariance)]) for p in (0, 1))
    bare, room = (page.frame([run], "walk") for run in (small, seen))
    half = 3 * np.sqrt(walk.filtered.covariance[:, 0, 0])
    wide = seen.views[0].position[:, 0]
    assert room["x"] == pytest.approx([(wide - half).min(), (wide + half).max()])
    assert bare["x"][0] > room["x"][0] and bare["x"][1] < room["x"][1]
    huge = run_of([with_covariance(walk, 1e6 * walk.filtered.covariance)])
    size = max(np.ptp(bare["x"]), np.ptp(bare["y"]))
    found = page.frame([huge], "walk")
    assert found["x"] == pytest.approx([bare["x"][0] - size, bare["x"][1] + size])
    nowhere = Trajectory(walk.reference.time, *(part * np.nan for part in walk.reference[1:]))
    lost = walk._replace(trajectory=nowhere, reference=nowhere)
    assert np.isfinite([*page.frame([run_of([lost])], "walk").values()]).all()


# --- the file


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


def test_the_page_is_one_file_that_loads_nothing(written):
    text = written.read_text(encoding="utf-8")
    loads = Loads(text)
    assert loads.places == ["data:,"]  # the icon, which a browser would ask a server for
    assert "b" not in loads.tags and "alert('x')</script>" not in text
    assert not re.search(r"@import|url\(\s*['\"]?https?:", text.partition("<body>")[0])
    assert "default-src 'none'" in text and len(text) < 3e6
    assert "gnio evaluate --workdir &#39;a b&#39;" in text and "seed: 3" in text
    assert "walk: start: rough" in text


def test_the_table_has_the_figures_of_both_runs(written, runs):
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "|", written.read_text(encoding="utf-8")))
    for run in runs:
        ate, seconds = (run.figures["walk"][name] for name in ("ate", "duration"))
        line = re.search(rf"walk\|+ ?\|+{run.name}\|[^a-z]*", text).group()
        assert f"|{ate:.2f}|" in line and f"|{seconds:.0f}|" in line
    assert "never moves" in text and "window orientation" in text


def test_without_a_reference_nothing_is_called_an_error(estimates):
    """And a single sequence needs no selector. χ² does not go by the name of the network's gate."""
    text = page.render("blind", [run_of([estimates[2]])])
    assert "error (m)" not in text and "distance walked" not in text
    assert r"3\\u03c3 (m)" in text  # as JSON in a script has it
    assert re.search(r"<label hidden>sequence", text)
    assert '"start"' in text  # where it begins is marked, as its legend says
    assert "refused above 11.3" in text and '"gate (11' not in text


def test_an_hour_is_thinned(walks):
    """36,000 rows, 15 of which of each curve would be 4 MB."""
    rows = np.arange(36000) % 400
    seen = plots.view(walks[0])
    hour = seen._replace(
        **{x: getattr(seen, x)[rows] for x in seen._fields if x not in ("name", "taps")}
    )._replace(time=0.1 * np.arange(36000))
    made = run_of([walks[0]])._replace(views=[hour])
    assert len(page.render("hour", [made])) < 2.5e6


def test_evaluations_beside_are_read_back(tmp_path, estimates, made):
    """With their paths and figures; what is of other recordings or another network is left away."""
    settings = SETTINGS | {"model": "gnio", "checkpoint": "best", "step": 7}
    settings |= {"rate": 100.0, "window_seconds": 1.0, "context_seconds": 0.0}
    summed = {"estimator": "integrate", "coupling": None, "orientation_source": "device"}
    of = {
        "ours": {},
        "summed": summed,
        "again": {},
        "imu": {"estimator": "imu_only", "coupling": None},
        "older": {"definitions": 1},
        "other": {"step": 8},
        "another": {"split": "val"},
        "elsewhere": {"data_root": "/elsewhere"},
        "longer": {"recordings": {**SETTINGS["recordings"], "blind": 50.0}},
    }
    for name, changes in of.items():
        own = made._replace(settings=settings | changes)
        report.write(tmp_path / name, own, estimates, TrainConfig(), plots=False)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "metrics.json").write_text("{")
    found = page.beside(tmp_path / "ours", settings)
    assert [run.name for run in found] == ["again", "imu_only", "integrate, device orientation"]
    first = found[0]
    for name, measures in made.scores.items():
        assert first.figures[name] == measures.values
    seen = {view.name: view for view in first.views}
    whole = plots.view(estimates[0])
    np.testing.assert_allclose(seen["room 1/walk"].position, whole.position, atol=1e-6)
    np.testing.assert_allclose(seen["room 1/walk"].reference, whole.reference, atol=1e-8)
    assert not seen["blind"].known and first.remarks[0] == "blind: start: rough"
    assert first.summary["never moves"]["path_length_ratio"] == 0


# --- in a browser

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


@pytest.mark.slow
@pytest.mark.skipif(browser.NAME is None, reason="no Chromium here (apt-get install chromium)")
def test_in_a_browser(written, walks):
    """It opens from the disk, asks for nothing, draws both paths where they are, and the slider
    moves the marker with its ellipse."""
    walk = walks[0]
    whole = plots.view(walk)
    error = np.linalg.norm((whole.position - whole.reference)[:, :2], axis=1)
    shapes = plots.ellipses(whole.covariance)
    with browser.browser() as tab:
        tab.open(written, width=1500)  # the map is wider than high, unlike the walk
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
    assert f"12.0 s  ·  x {x:.1f} m, y {y:.1f} m  ·  error {error[120]:.2f} m" in told
    assert f"3σ {shapes.major[120]:.2f} × {shapes.minor[120]:.2f} m" in told
    size = shapes.major[120] * 0.8 * np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])
    around = pixels(place, whole.position[120, :2] + size)
    changed = np.abs(after.astype(int) - before).max(2) > 15
    inside = [changed[row - 2 : row + 3, column - 2 : column + 3].any() for column, row in around]
    assert inside == [True, True, False, False]  # its major axis is along y
    assert told_of_other.startswith("20.0 s") and told_of_other != told


@pytest.mark.slow
@pytest.mark.skipif(browser.NAME is None, reason="no Chromium here (apt-get install chromium)")
def test_on_a_phone(written):
    """One column, and only the table of measures is wider than the screen, which scrolls alone."""
    with browser.browser() as tab:
        tab.open(written, width=390, height=844)
        assert tab.evaluate("document.documentElement.scrollWidth") <= 390
        assert tab.evaluate("document.querySelector('.figures').children[0].offsetWidth") > 320
        assert tab.errors == []
