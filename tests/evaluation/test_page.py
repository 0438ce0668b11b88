"""The page of results: what it holds, and what a browser shows of it."""

import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from gnio_jax.evaluation import SequenceEstimate, Trajectory, page
from gnio_jax.evaluation.views import ellipses, make_view
from gnio_jax.types import Waypoints
from tests.support.estimates import estimate, reported, with_covariance

EVIL = "</script><script>alert('x')</script><b onmouseover=alert(1)>&amp; $$x$$"


def run_of(estimates, *more, **named):
    report = reported(estimates, notes={estimates[0].name: ["start: rough"]})
    return page.describe_report(
        report, [make_view(estimate) for estimate in estimates], *more, **named
    )


@pytest.fixture(scope="module")
def walks():
    walk = estimate("walk", 0)
    # The ellipse is twice as long along y; gates that tell the axes apart.
    covariance = walk.filtered.covariance * np.array([1.0, 4.0, 1.0])
    return [with_covariance(walk, covariance), estimate(EVIL, 1)]


@pytest.fixture(scope="module")
def runs(walks):
    summed = [
        SequenceEstimate(
            e.name, e.trajectory._replace(position=1.1 * e.trajectory.position), e.reference
        )
        for e in walks
    ]
    ours = run_of(walks, "gnio evaluate --network 'a b'", "seed: 3")
    return [ours, run_of(summed, name="summed")]


@pytest.fixture(scope="module")
def written(runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    page.write(path, EVIL, runs)
    return path


def test_thinned_curves_keep_the_largest_innovation(walks):
    nis = np.full(400, 2.0)
    nis[[0, 201]], nis[3:6] = [np.nan, 70.0], np.nan
    view = make_view(walks[0]._replace(filtered=walks[0].filtered._replace(nis=nis)))
    curves = page.make_columns(view, 150)
    assert len(curves["time"]) == 134 and curves["time"][1] == pytest.approx(0.3)
    np.testing.assert_allclose(curves["x"][:3], view.position[:9:3, 0], rtol=1e-6)
    assert curves["nis"][67] == 70.0 and curves["nis"][0] == 2.0 and np.isnan(curves["nis"][1])
    assert "scale_x" not in curves and np.isfinite(curves["gate_x"][-1])
    assert all(len(values) == 134 and values.dtype == np.float32 for values in curves.values())


def test_a_thinned_page_has_the_end_of_a_path_and_every_waypoint(walks):
    """Twelve taps, which are 0.5 s apart, of a walk of 40 s in ten rows: each is joined to the
    place of the estimate at its time."""
    walk = walks[0]
    rows = np.arange(101, 161, 5)
    waypoints = Waypoints(walk.reference.time[rows], walk.reference.position[rows, :2])
    blind = walk.reference._replace(position=walk.reference.position * np.nan)
    view = make_view(walk._replace(reference=blind, waypoints=waypoints))
    curves = page.make_columns(view, 10)
    tapped = np.isfinite(curves["waypoint_x"])
    assert tapped.sum() == 12 and len(curves["time"]) <= 10 + 12 + 1
    np.testing.assert_allclose(curves["time"][tapped], 0.1 * rows, atol=1e-4)
    np.testing.assert_allclose(curves["waypoint_x"][tapped], waypoints.position[:, 0], rtol=1e-6)
    drawn = np.hypot(*(curves[x][tapped] - curves[f"waypoint_{x}"][tapped] for x in "xy"))
    np.testing.assert_allclose(drawn, curves["waypoint_error"][tapped], atol=1e-5)
    assert curves["time"][-1] == pytest.approx(39.9)
    np.testing.assert_allclose(curves["x"][-1], view.position[-1, 0], rtol=1e-6)


def test_the_map_has_the_size_of_the_paths_or_of_the_ellipses(walks):
    walk = walks[0]
    for size in (1e-4, 1.0, 1e6):
        run = run_of([with_covariance(walk, size * walk.filtered.covariance)])
        view = run.views[0]
        paths = np.concatenate([view.position, view.reference])[:, 0]
        middle, reach = (paths.min() + paths.max()) / 2, 1.5 * np.ptp(paths) / 2
        room = page.frame([run], "walk")["x"]
        assert room == pytest.approx([middle - reach, middle + reach])
        wide, half = view.position[:, 0], 3 * np.sqrt(view.filtered.covariance[:, 0, 0])
        low, high = min((wide - half).min(), room[0]), max((wide + half).max(), room[1])
        assert page.frame([run], "walk", whole=True)["x"] == pytest.approx([low, high])
    nowhere = Trajectory(walk.reference.time, *(part * np.nan for part in walk.reference[1:]))
    lost = walk._replace(trajectory=nowhere, reference=nowhere)
    for whole in (False, True):
        assert np.isfinite([*page.frame([run_of([lost])], "walk", whole).values()]).all()


class Loads(html.parser.HTMLParser):
    """The places from which the tags of a page load, and the tags."""

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


def test_the_page_is_one_file_that_loads_nothing(written, runs):
    text = written.read_text(encoding="utf-8")
    loads = Loads(text)
    assert loads.places == ["data:,"]  # the icon, which a browser would ask a server for
    assert "b" not in loads.tags and "alert('x')</script>" not in text
    assert not re.search(r"@import|url\(\s*['\"]?https?:", text.partition("<body>")[0])
    assert "default-src 'none'" in text and len(text) < 3e6
    assert "gnio evaluate --network &#39;a b&#39;" in text and "seed: 3" in text
    assert "walk: start: rough" in text
    shown = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "|", text.replace("<wbr>", "")))
    for run in runs:  # the table
        ate, seconds = (run.figures["walk"][name] for name in ("ate", "duration"))
        line = re.search(rf"walk\|+ ?\|+{run.name}\|[^a-z]*", shown).group()
        assert f"|{ate:.2f}|" in line and f"|{seconds:.0f}|" in line
    assert "never moves" in shown


def test_a_page_without_a_reference_shows_no_error(estimates):
    run = run_of([estimates[2]._replace(name="a<b_c-d e")])
    run = run._replace(warnings=("it <moves>",), facts={"weights": "of walks"})
    text = page.render("blind", [run])
    assert text.count("of walks") == 1 and "warning: it &lt;moves&gt;" in text
    assert text.index("it &lt;moves&gt;") < text.index('class="figures"') < text.index("of walks")
    assert "error (m)" not in text
    assert r"horizontal 3\\u03c3 (m)" in text  # as JSON in a script has it
    assert '"value":"start"' in text
    assert re.search(r"<label hidden>sequence", text)  # a single sequence needs no choice
    assert "<td>a&lt;b_<wbr>c-<wbr>d <wbr>e</td>" in text  # names break between their words
    # The levels of χ² have another name than the network's gate.
    assert "refused above 11.3" in text and '"gate (11' not in text


BROWSERS = "chromium", "chromium-browser", "google-chrome"
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), "")
PROBE = """<script>
const problems = [];
window.addEventListener("error", (event) => problems.push(event.message));
const readAt = (seconds) => {
  const slider = document.getElementById("time");
  slider.value = seconds;
  slider.dispatchEvent(new Event("input"));
  return document.getElementById("readout").textContent;
};
const waiting = setInterval(() => {
  if (document.body.dataset.ready !== "yes") return;
  clearInterval(waiting);
  const [view] = Bokeh.index.roots, frame = view.frame.bbox;
  const {x_range: x, y_range: y} = view.model;
  const found = {perMetre: [frame.width / (x.end - x.start), frame.height / (y.end - y.start)]};
  found.beyond = document.documentElement.scrollWidth - innerWidth;
  const wide = () => view.model.x_range.end - view.model.x_range.start;
  const before = wide();
  document.getElementById("whole").click();
  found.zoom = wide() / before;
  document.getElementById("whole").click();
  found.first = readAt(12.04);
  document.querySelectorAll("tr[data-sequence]")[2].click();
  found.chosen = document.getElementById("sequence").selectedOptions[0].textContent;
  found.second = readAt(20.0);
  document.body.innerText = JSON.stringify({...found, problems});
}, 50);
</script>"""
"""A script that acts as a reader, and puts what the page then shows in its place."""


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here (apt-get install chromium)")
@pytest.mark.parametrize("width", [1500, 500])
def test_a_browser_shows_the_page(written, walks, tmp_path, width):
    """The axes have one scale, though the map is wider than high. On a phone the page has one
    column."""
    before, end, after = written.read_text(encoding="utf-8").rpartition("</body>")
    probed = tmp_path / "probed.html"
    probed.write_text(f"{before}{PROBE}{end}{after}", encoding="utf-8")
    options = "--headless --no-sandbox --disable-gpu --virtual-time-budget=30000 --dump-dom".split()
    command = [BROWSER, *options, f"--window-size={width},900", probed.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    readings = json.loads(html.unescape(re.search(r"<body[^>]*>(.*)</body>", shown, re.DOTALL)[1]))
    assert readings["perMetre"][0] == pytest.approx(readings["perMetre"][1], rel=0.02)
    assert readings["zoom"] >= 1.0
    assert readings["beyond"] <= 0 and readings["problems"] == [] and readings["chosen"] == EVIL
    whole = make_view(walks[0])
    (x, y), shapes = whole.position[120, :2], ellipses(whole.filtered.covariance)
    error = np.linalg.norm((whole.position - whole.reference)[120, :2])
    expected = f"12.0 s  ·  x {x:.1f} m, y {y:.1f} m  ·  error {error:.2f} m"
    assert readings["first"].startswith(expected)
    assert f"3σ {shapes.major[120]:.2f} × {shapes.minor[120]:.2f} m" in readings["first"]
    assert readings["second"].startswith("20.0 s") and readings["second"] != readings["first"]


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here (apt-get install chromium)")
def test_a_browser_shows_no_place_of_an_estimate_that_has_diverged(walks, tmp_path):
    walk, lost = walks[0], np.arange(len(walks[0].trajectory.time)) >= 200
    path = walk.trajectory
    blank = (np.where(lost[:, None], np.nan, part) for part in (path.position, path.orientation))
    run = run_of([walk._replace(trajectory=Trajectory(path.time, *blank))])
    page.write(tmp_path / "report.html", "lost", [run])
    options = "--headless --no-sandbox --disable-gpu --virtual-time-budget=30000 --dump-dom".split()
    command = [BROWSER, *options, (tmp_path / "report.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    readout = re.search(r'<span id="readout">(.*?)</span>', shown)[1]
    assert readout == f"{path.time[-1] - path.time[0]:.1f} s  ·  no position"
