"""A whole walk from a phone to the page: its path is that of the same samples as lines."""

import html
import http.client
import json
import re
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from gnio_jax.apps.live import server as servers
from gnio_jax.apps.live.checks import Nature
from gnio_jax.apps.live.server import listen
from gnio_jax.apps.live.session import Followed
from gnio_jax.apps.live.state import describe
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.filtering import Pose
from tests.support.live_streams import as_lines, walked
from tests.support.phones import Experiment, messages, post

WALK = Path(__file__).parents[3] / "examples" / "walk.csv"


@pytest.fixture
def port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def pushed_by_a_phone(port, bodies, answers):
    """Push messages out of order and repeated, as soon as somebody listens, and look at the
    page."""
    order = list(range(len(bodies)))
    order[4:6] = [5, 4, 4]
    address = ("127.0.0.1", port)

    def push():
        end = time.monotonic() + 100
        while time.monotonic() < end:
            try:
                statuses = [post(address, bodies[0])]
                break
            except OSError:
                time.sleep(0.05)
        statuses += [post(address, bodies[number]) for number in order[1:]]
        while time.monotonic() < end:  # until the walk is over, and then the server is gone
            try:
                connection = http.client.HTTPConnection(*address, timeout=20)
                connection.request("GET", "/state?from=0")
                answers.append(json.loads(connection.getresponse().read()))
            except (OSError, http.client.HTTPException):
                break
            time.sleep(0.05)
        answers.append(statuses)

    thread = threading.Thread(target=push, daemon=True)
    thread.start()
    return thread


def assert_same_path(path, expected, shift):
    """To a millimetre, though stamps of 1970 have steps of 0.2 µs."""
    np.testing.assert_allclose(path.time - shift, expected.time[: len(path.time)], atol=1e-4)
    assert len(path.time) >= len(expected.time) - 1
    error = np.linalg.norm(path.position - expected.position[: len(path.time)], axis=1)
    assert error.max() < 1e-3


@pytest.mark.parametrize("kind", ["sum", "total"])
def test_a_phone_that_pushes_gives_the_path_of_its_lines(gnio, follow, run, port, tmp_path, kind):
    recorded, answers = walked(), []
    bodies = messages(*recorded, period=0.4, kind=kind)
    thread = pushed_by_a_phone(port, bodies, answers)
    sign = ("--accel-sign", "android") if kind == "sum" else ()
    words = ("--silence", "2", "--network", run, "--out", tmp_path / "http.txt", *sign)
    output = gnio("live", f"http:{port}", *words)
    thread.join(60)
    assert f"page: http://127.0.0.1:{port}/" in output and "samples come at 50 Hz" in output
    assert "warning: 1 lines refused, the first: message 4 of Sensor Logger came twice" in output
    *states, statuses = answers
    assert set(statuses) == {200} and states[-1]["state"] in ("moving", "at rest")
    assert states[-1]["walked"] > 1.0 and len(states[-1]["points"]) > 5
    follow(as_lines(recorded), "--out", tmp_path / "lines.txt")
    path, expected = read_tum(tmp_path / "http.txt"), read_tum(tmp_path / "lines.txt")
    assert_same_path(path, expected, 1.7e9)


def test_phyphox_gives_the_path_of_its_lines(gnio, follow, run, port, tmp_path):
    """With the page beside it; the gyro begins a sample later than the accelerometer."""
    recorded = walked(seconds=6.0)
    experiment = Experiment(*recorded, speed=2)
    words = ("--silence", "1", "--network", run, "--out", tmp_path / "phyphox.txt")
    output = gnio("live", f"phyphox:{experiment.address}", "--page", str(port), *words)
    assert f"page: http://127.0.0.1:{port}/" in output and "refused" not in output
    lines = as_lines([field[1:] for field in recorded])
    follow(lines, "--out", tmp_path / "lines.txt")
    path, expected = read_tum(tmp_path / "phyphox.txt"), read_tum(tmp_path / "lines.txt")
    assert_same_path(path, expected, 0.0)


@pytest.mark.slow
def test_the_example_by_a_phone_is_the_example_by_lines(gnio, port, tmp_path):
    """With the network that comes with gnio-jax; the true path goes 4.2 m away from its start."""
    rows, answers = np.loadtxt(WALK, delimiter=",", skiprows=1)[:1500], []
    recorded = rows[:, 0], rows[:, 1:4], rows[:, 4:]
    thread = pushed_by_a_phone(port, messages(*recorded, period=1.0, kind="total"), answers)
    gnio("live", f"http:{port}", "--silence", "2", "--out", tmp_path / "http.txt")
    thread.join(60)
    lines = as_lines(recorded)
    gnio("live", "--out", tmp_path / "lines.txt", lines=lines)
    path, expected = read_tum(tmp_path / "http.txt"), read_tum(tmp_path / "lines.txt")
    assert_same_path(path, expected, 1.7e9)
    assert 3 < np.linalg.norm(path.position[:, :2] - path.position[0, :2], axis=1).max() < 6


# --- what a browser shows

BROWSERS = "chromium", "chromium-browser", "google-chrome"
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), "")
PROBE = b"""<script>
setInterval(() => {
  document.body.dataset.beyond = document.documentElement.scrollWidth - innerWidth;
  const box = document.querySelector("canvas").getBoundingClientRect();
  document.body.dataset.path = JSON.stringify(path);
  document.body.dataset.map = `${Math.round(box.width)} ${Math.round(box.height)}`;
}, 50);
</script>"""
EVIL = "<img src=x onerror=alert(1)>&amp;"


def walking(steps, side=1.0):
    """A walk on a circle of 8 m to the left (side 1) or right, at rest in the end."""
    result, zero = Followed(rest_seconds=0.5), np.zeros(3)
    for k in range(steps):
        angle = min(k, steps - 10) / 50
        position = np.array([8 * np.sin(angle), side * 8 * (1 - np.cos(angle)), 0.1])
        covariance = np.eye(15)
        covariance[6:8, 6:8] = [[0.5, 0.3], [0.3, 0.4]]
        speed = np.array([1.2, 0.5, 0.0])
        poses = (np.eye(3), speed, position, zero, zero, covariance, 1.0, 1.0, True, "")
        result.add(Pose(k / 10, *poses, k > steps - 10))
    result.samples, result.waiting = steps * 10, ""
    return result


def shown(server, width, *, height=800, picture=None):
    """The text of the page, and its body's data, as a browser shows them."""
    options = "--headless --no-sandbox --disable-gpu --virtual-time-budget=3000".split()
    options += ["--enable-logging=stderr", f"--window-size={width},{height}"]
    options.append(f"--screenshot={picture}" if picture else "--dump-dom")
    command = [BROWSER, *options, f"http://127.0.0.1:{server.server_address[1]}/"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert "CONSOLE" not in done.stderr, done.stderr
    if picture:
        return "", {}
    body = re.search(r"<body([^>]*)>(.*?)<script>", done.stdout, re.DOTALL)
    assert body is not None and "<img" not in body[2] and "onerror" not in body[1]
    text = html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", body[2])))
    return text, dict(re.findall(r'data-(\w+)="([^"]*)"', body[1]))


def server_with_probe(port):
    """A server whose page says more of itself."""
    server = listen(str(port), "http")
    end = server.page.rpartition(b"</body>")
    server.page = end[0] + PROBE + b"".join(end[1:])
    digest = servers._hash(PROBE[len("<script>") : -len("</script>")])
    server.policy = server.policy.replace("script-src", f"script-src {digest}")
    return server


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here (apt-get install chromium)")
def test_a_page_that_stays_open_shows_the_next_stream_alone(port):
    """The next one has more points than the first when the page asks again."""
    server, walks, requests = server_with_probe(port), (walking(200), walking(400, -1.0)), []

    def state(first):
        requests.append(first)
        if len(requests) == 4:
            server.session = "another"
        return describe(walks[len(requests) >= 4], Nature("udp:5"), "net", True, first)

    server.state = state
    server.run()
    try:
        text, data = shown(server, 1500)
    finally:
        server.close()
    assert requests[3] == len(walks[0].points) < len(walks[1].points) and "time 39.9 s" in text
    np.testing.assert_allclose(json.loads(data["path"]), walks[1].points, atol=0.01)


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no Chromium here (apt-get install chromium)")
@pytest.mark.parametrize(("width", "columns"), [(1500, 2), (500, 1)])
@pytest.mark.parametrize("kind", ["waiting", "walking", "still"])
def test_a_browser_shows_the_walk(port, width, columns, kind):
    """Under the page's own policy, which forbids scripts of others; names are text, never tags."""
    server = server_with_probe(port)
    result = Followed() if kind == "waiting" else walking(300)
    result.waiting = "a rest (samples are missing for 0.3 s)" if kind == "waiting" else ""
    result.notices.append(f"hello {EVIL}")
    server.state = lambda first: describe(result, Nature(EVIL), "net", kind != "still", first)
    server.run()
    try:
        text, data = shown(server, width)
    finally:
        server.close()
    assert int(data["beyond"]) <= 0 and f"{EVIL}, network net" in text and f"hello {EVIL}" in text
    across, down = map(int, data["map"].split())
    assert down > 300 and (across < width - 300) == (columns == 2)
    if kind == "waiting":
        assert "waiting for a rest (samples are missing for 0.3 s)" in text
    else:
        assert ("at rest" if kind == "walking" else "still") in text
        assert f"walked {result.distance:.1f} m" in text and "speed 1.30 m/s" in text
        assert "time 29.9 s" in text and int(data["polled"]) == len(result.points)
