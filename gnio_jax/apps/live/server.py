"""The page of a stream, and the address to which phones send: a small HTTP server.

It answers three requests and nothing else: GET / is the page, GET /state?from=N what the page
shows, and POST / or /data a message for the inbox, if there is one. Nobody on the network can do
more than look and send. No text of a request is ever sent back, and the page loads nothing.
"""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import json
import re
import secrets
import socket
import threading
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from gnio_jax.apps.live.inbox import Inbox
from gnio_jax.errors import InputError

LARGEST_MESSAGE = 4_000_000
"""Largest message, bytes."""
MOST_CONNECTIONS, MOST_OF_ONE = 64, 16
"""Connections at the same time, of all machines and of one."""
PATIENCE = 10.0
"""Time for which a connection may be silent, s."""
LOCAL = "127.0.0.1"
State = Callable[..., dict[str, Any]]
"""What the page shows, with the points of the path from a number on."""


class PageServer(ThreadingHTTPServer):
    """Serves the page at an address, and puts messages into `inbox`; None: it takes none."""

    daemon_threads = True
    request_queue_size = 32

    def __init__(self, host: str, port: int, inbox: Inbox | None = None):
        self.inbox: Inbox | None = inbox
        self.state: State = no_state
        self.session = secrets.token_hex(8)
        """A page that stays open over the end of a stream sees by it that the path is another
        one."""
        self._connections, self._count = Counter[str](), threading.Lock()
        self.page = (files(__package__) / "page.html").read_bytes()
        script = re.findall(rb"<script>(.*?)</script>", self.page, re.DOTALL)
        style = re.findall(rb"<style>(.*?)</style>", self.page, re.DOTALL)
        self.policy = "; ".join(
            [
                *("default-src 'none'", "connect-src 'self'", "img-src data:", "base-uri 'none'"),
                *("form-action 'none'", "frame-ancestors 'none'"),
                f"script-src {' '.join(map(_hash, script))}",
                f"style-src {' '.join(map(_hash, style))}",
            ]
        )
        super().__init__((host, port), _Handler)
        self.is_local = ipaddress.ip_address(host).is_loopback

    def server_bind(self) -> None:
        """Bind without asking the network for the name of this machine, as `HTTPServer` does."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = map(str, self.server_address[:2])  # type: ignore

    @property
    def address(self) -> str:
        """The address of the page, for this machine, or for the network."""
        host, port = self.server_address[:2]
        shown = _address_here() if host == "0.0.0.0" else str(host)
        return f"http://{shown}:{port}/"

    def run(self) -> None:
        """Serve in a thread."""
        threading.Thread(target=self.serve_forever, args=(0.1,), daemon=True).start()

    def close(self) -> None:
        """End the server, and give the port back."""
        self.shutdown()
        self.server_close()

    def is_known(self, host: str) -> bool:
        """Whether a request is for this machine by its header Host. A name that leads here without
        being this machine's is an attack by a page of another site (DNS rebinding)."""
        name = re.sub(r":\d{1,5}$", "", host).strip("[]").lower()
        if name in (
            "localhost",
            socket.gethostname().lower(),
            f"{socket.gethostname().lower()}.local",
        ):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self.is_local

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread, or close it if there are too many."""
        machine = client_address[0]
        with self._count:
            is_full = self._connections.total() >= MOST_CONNECTIONS
            is_full = is_full or self._connections[machine] >= MOST_OF_ONE
            if not is_full:
                self._connections[machine] += 1
        if is_full:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection, and count it until it is closed."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._count:
                self._connections[client_address[0]] -= 1
                self._connections += Counter()  # without those that have none

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks is no matter of the user."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one connection."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = PATIENCE

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        if not self._is_allowed():
            return
        if path == "/" and not query:
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", self.server.page)
        elif path == "/state" and (match := re.fullmatch(r"from=(\d{1,9})", query, re.ASCII)):
            state = {**self.server.state(int(match[1])), "session": self.server.session}
            content = json.dumps(state, allow_nan=False).encode()
            self._answer(HTTPStatus.OK, "application/json", content)
        else:
            self._refuse(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not self._is_allowed():
            return
        inbox, length = self.server.inbox, self.headers.get("Content-Length", "")
        if inbox is None:
            self._refuse(HTTPStatus.METHOD_NOT_ALLOWED)
        elif self.path not in ("/", "/data"):
            self._refuse(HTTPStatus.NOT_FOUND)
        elif not re.fullmatch(r"\d{1,9}", length, re.ASCII):
            self._refuse(HTTPStatus.LENGTH_REQUIRED)
        elif int(length) > LARGEST_MESSAGE:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        else:
            body = self.rfile.read(int(length))
            if len(body) < int(length):
                self.close_connection = True
            elif inbox.put(body, len(body)):
                self._answer(HTTPStatus.OK, "text/plain", b"ok\n")
            else:
                self._refuse(HTTPStatus.SERVICE_UNAVAILABLE)

    def _is_allowed(self) -> bool:
        """Whether a request may be answered, by its headers. A browser names the site whose page
        sends a message, and no site but this one may."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if self.server.is_known(host) and origin in (None, f"http://{host}"):
            return True
        self._refuse(HTTPStatus.FORBIDDEN)
        return False

    def _answer(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", self.server.policy)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cache-Control", "no-store")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)

    def _refuse(self, status: HTTPStatus) -> None:
        """Answer with the words of the standard for a status, and close the connection, of which a
        body may not have been read."""
        self.close_connection = True
        self._answer(status, "text/plain", f"{status.phrase}\n".encode())

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request that is malformed, or of another method."""
        status = HTTPStatus(code)
        other = status == HTTPStatus.NOT_IMPLEMENTED
        self._refuse(HTTPStatus.METHOD_NOT_ALLOWED if other else status)

    def version_string(self) -> str:
        """The name of the server, without versions."""
        return "gnio"

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not shown."""


def no_state(_: int) -> dict[str, Any]:
    """What the page shows before anything is known."""
    return {"state": "waiting", "waiting": "gnio is starting", "points": [], "next": 0}


def listen(text: str, name: str, inbox: Inbox | None = None) -> PageServer:
    """The server of PORT, which only this machine reaches, or of ADDRESS:PORT; `name` is what the
    user wrote. Raises `InputError`."""
    host, _, port = text.rpartition(":")
    try:
        host = str(ipaddress.ip_address(host.strip("[]") or LOCAL))
        is_port = port.isascii() and port.isdecimal() and 0 < int(port[:6]) < 2**16
    except ValueError:
        is_port = False
    if not is_port or ":" in host:
        remedy = "write 8000, for this machine alone, or 0.0.0.0:8000, for the network"
        raise InputError(name, "names no port", remedy)
    try:
        return PageServer(host, int(port), inbox)
    except OSError as error:
        problem = f"cannot listen there ({error.strerror or error})"
        raise InputError(name, problem, "choose another port or address") from None


def _hash(text: bytes) -> str:
    digest = base64.b64encode(hashlib.sha256(text).digest()).decode()
    return f"'sha256-{digest}'"


def _address_here() -> str:
    """The address of this machine in its network. No packet is sent for it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return LOCAL
