"""A headless Chromium, driven by the DevTools protocol over two pipes."""

import contextlib
import itertools
import json
import os
import select
import shutil
import signal
import tempfile
import time

NAME = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ARGUMENTS = """--headless --no-sandbox --disable-gpu --disable-background-networking --disable-sync
--disable-component-update --disable-dev-shm-usage --disable-extensions --disable-default-apps
--no-first-run --mute-audio --hide-scrollbars --force-device-scale-factor=1
--remote-debugging-pipe""".split()
PATIENCE = 60.0


class Page:
    """A tab: what it said, what it asked the network for, what it shows."""

    def __init__(self, write_to, read_from):
        self._write_to, self._read_from = write_to, read_from
        self._numbers, self._left, self._session = itertools.count(1), b"", None
        self.errors, self.requests = [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        """The result of one command."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write_to, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != number:
            self._hear(answer)
        assert "error" not in answer, answer["error"]
        return answer["result"]

    def evaluate(self, expression):
        """The value of an expression of the page."""
        given = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        found = self.call("Runtime.evaluate", **given)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def open(self, path, width=1280, height=900):
        """Open a file and wait until its figures are drawn."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        assert "errorText" not in self.call("Page.navigate", url=path.as_uri()), path
        until = time.monotonic() + PATIENCE
        while self.evaluate("document.body && document.body.dataset.ready") != "yes":
            assert time.monotonic() < until, f"the page is not ready: {self.errors}"
            time.sleep(0.05)
        self.evaluate("new Promise((done) => setTimeout(done, 300))")  # until it is painted

    def _next(self):
        while b"\0" not in self._left:
            ready, _, _ = select.select([self._read_from], [], [], PATIENCE)
            part = os.read(self._read_from, 1 << 20) if ready else b""
            assert part, "the browser does not answer"
            self._left += part
        message, _, self._left = self._left.partition(b"\0")
        return json.loads(message)

    def _hear(self, event):
        told = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(told["exceptionDetails"])
            case "Runtime.consoleAPICalled" if told["type"] in ("error", "warning", "assert"):
                self.errors.append(told["args"])
            case "Log.entryAdded" if told["entry"]["level"] in ("error", "warning"):
                self.errors.append(told["entry"])
            case "Network.requestWillBeSent":
                self.requests.append(told["request"]["url"])


@contextlib.contextmanager
def browser():
    """A page of a browser that ends with the context."""
    inward, outward = os.pipe(), os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        actions = [
            (os.POSIX_SPAWN_DUP2, inward[0], 3),
            (os.POSIX_SPAWN_DUP2, outward[1], 4),
            (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
            (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
        ]
        command = [NAME, *ARGUMENTS, f"--user-data-dir={profile}"]
        process = os.posix_spawn(NAME, command, os.environ, file_actions=actions, setsid=True)
        for end in (inward[0], outward[1]):
            os.close(end)
        try:
            yield Page(inward[1], outward[0])
        finally:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            for end in (inward[1], outward[0]):
                os.close(end)
