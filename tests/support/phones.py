"""Phones that send a recording: Sensor Logger, which pushes, and phyphox, which is asked."""

import http.client
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qsl, unquote

import numpy as np

EPOCH = 1_700_000_000_000_000_000
"""ns since 1970 of the first sample."""


def low(accel):
    """Something like gravity: slow, and not the whole of the acceleration."""
    kernel = np.ones(25) / 25
    return np.stack([np.convolve(axis, kernel, mode="same") for axis in accel.T], axis=1)


def messages(time, gyro, accel, period=0.5, kind="sum", session="one", device="phone"):
    """The messages of a recording, as Sensor Logger numbers them. `kind` says how the accelerometer
    comes: sum (without gravity, and gravity), total, raw (in g), or none."""
    gravity = low(accel)
    sensors = {"gyroscope": gyro, "barometer": np.zeros((len(time), 1))}
    if kind == "sum":
        sensors |= {"accelerometer": accel - gravity, "gravity": gravity}
    elif kind == "total":
        sensors |= {"accelerometer": accel - gravity, "totalacceleration": accel}
    elif kind == "raw":
        sensors |= {"accelerometeruncalibrated": accel / 9.80665}
    contents = []
    for number, begin in enumerate(np.arange(time[0], time[-1] + period, period)):
        rows = np.flatnonzero((time >= begin - 1e-9) & (time < begin + period - 1e-9))
        payload = [
            {
                "name": name,
                "time": EPOCH + round(1e9 * float(time[row])),
                "values": dict(zip("xyz", values[row].tolist(), strict=False)),
            }
            for name, values in sensors.items()
            for row in rows
        ]
        if payload:
            head = {"messageId": number, "sessionId": session, "deviceId": device}
            contents.append(json.dumps({**head, "payload": payload}).encode())
    return contents


def post(address, body, path="/data", **headers):
    """The status of a request."""
    connection = http.client.HTTPConnection(*address, timeout=20)
    try:
        connection.request("POST", path, body, {"Content-Type": "application/json", **headers})
        return connection.getresponse().status
    finally:
        connection.close()


class Experiment(ThreadingHTTPServer):
    """An experiment of phyphox that measures a recording, `speed` times as fast."""

    daemon_threads = True

    def __init__(self, time, gyro, accel, speed=1.0, sources=("accelerometer", "gyroscope")):
        self.columns, self.inputs = {}, []
        signals = {"accelerometer": accel, "linear_acceleration": accel - low(accel)}
        signals |= {"gravity": low(accel), "gyroscope": gyro}
        for source in sources:
            prefix = source[:3]
            stamps = time[1:] if source == "gyroscope" else time
            values = signals[source][len(time) - len(stamps) :]
            names = [f"{prefix}{axis}" for axis in "XYZ"] + [f"{prefix} time"]
            self.columns |= {
                name: (stamps, column)
                for name, column in zip(names, [*values.T, stamps], strict=True)
            }
            outputs = [{axis: name} for axis, name in zip("xyzt", names, strict=True)]
            self.inputs.append({"source": source, "outputs": outputs})
        self.speed, self.begin, self.elapsed, self.requests = speed, None, 0.0, []
        super().__init__(("127.0.0.1", 0), _Phyphox)
        threading.Thread(target=self.serve_forever, args=(0.05,), daemon=True).start()

    @property
    def address(self):
        return f"127.0.0.1:{self.server_address[1]}"

    @property
    def now(self):
        """Time of the experiment, which stands still in a pause."""
        running = 0.0 if self.begin is None else (time.monotonic() - self.begin) * self.speed
        return self.elapsed + running

    def control(self, command):
        if command == "start" and self.begin is None:
            self.begin = time.monotonic()
        elif command == "stop":
            self.elapsed, self.begin = self.now, None
        return {"result": command in ("start", "stop")}

    def rows(self, name, query, now):
        """Values with eight digits, as the app writes them."""
        stamps, values = self.columns[name]
        come = stamps <= now
        if not query:
            return [None if not come.any() else float(f"{values[come][-1]:.7e}")]
        threshold, _, reference = query.partition("|")
        limit = float(threshold)
        limit += 10 ** np.floor(np.log10(abs(limit) / 1e7)) if limit else 0.0
        reference = self.columns[reference][1]
        return [float(f"{value:.7e}") for value in values[come & (reference > limit)]]


class _Phyphox(BaseHTTPRequestHandler):
    def do_GET(self):
        path, _, query = self.path.partition("?")
        server = self.server
        server.requests.append(unquote(self.path))
        pairs = parse_qsl(query, keep_blank_values=True)
        if path == "/config":
            answer = {"title": "two sensors", "inputs": server.inputs}
        elif path == "/control":
            answer = server.control(dict(pairs)["cmd"])
        else:
            now, measuring = server.now, server.begin is not None
            buffers = {name: {"size": 0, "buffer": server.rows(name, w, now)} for name, w in pairs}
            answer = {"buffer": buffers, "status": {"session": "ab", "measuring": measuring}}
        content = json.dumps(answer).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_):
        pass
