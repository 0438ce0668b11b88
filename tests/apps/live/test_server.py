"""The server of the page: what it answers, and what nobody can do."""

import http.client
import json
import socket
import threading
import time

import pytest

from gnio_jax.apps.live import server as servers
from gnio_jax.apps.live.inbox import Inbox
from gnio_jax.apps.live.server import listen
from gnio_jax.errors import InputError
from tests.support.phones import post


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def serving():
    """A server and its address, with an inbox or without one."""
    open_ones = []

    def serve(host="127.0.0.1", inbox=None):
        server = listen(f"{host}:{free_port()}", "http", inbox)
        server.run()
        open_ones.append(server)
        return server, ("127.0.0.1", server.server_address[1])

    yield serve
    for server in open_ones:
        server.close()


def response(address, method="GET", path="/", **headers):
    """(status, headers, content) of a request."""
    connection = http.client.HTTPConnection(*address, timeout=20)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def raw(address, request):
    """All that is answered to some bytes."""
    with socket.create_connection(address, timeout=20) as connection:
        connection.sendall(request)
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
    return answer


def test_the_page_and_its_state_are_all_there_is_to_see(serving):
    server, address = serving()
    server.state = lambda first: {"first": first}
    status, headers, page = response(address)
    assert status == 200 and page == server.page and b"gnio live" in page
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy and policy.count("sha256-") == 2
    assert headers["X-Content-Type-Options"] == "nosniff" and headers["Server"] == "gnio"
    assert headers["Cache-Control"] == "no-store"
    status, headers, content = response(address, path="/state?from=12")
    assert status == 200
    assert json.loads(content) == {"first": 12, "session": server.session}
    assert serving()[0].session != server.session
    assert headers["Content-Type"] == "application/json"


def test_the_page_loads_nothing_from_elsewhere(serving):
    server, _ = serving()
    for word in (b"http:", b"https:", b"//", b"@import", b"url(", b"innerHTML", b"eval("):
        assert word not in server.page.replace(b"// ", b"")


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/state", 404),
        ("GET", "/state?from=-1", 404),
        ("GET", "/state?from=1&x=<script>", 404),
        ("GET", "/../etc/passwd", 404),
        ("GET", "//evil.example/", 404),
        ("GET", "/page.html", 404),
        ("GET", "/?x=<script>alert(1)</script>", 404),
        ("POST", "/", 405),
        ("HEAD", "/", 405),
        ("PUT", "/", 405),
        ("DELETE", "/data", 405),
        ("OPTIONS", "/data", 405),
        ("<script>", "/", 405),
    ],
)
def test_other_requests_are_refused_without_their_words(serving, method, path, status):
    _, address = serving()
    code, headers, content = response(address, method, path)
    assert code == status and b"script" not in content and len(content) < 40
    assert "default-src 'none'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    "request_line",
    [b"\r\n\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x00<b>\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n",
     b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n", b"GET /" + b"x" * 70_000 + b"\r\n\r\n"],
)  # fmt: skip
def test_a_request_that_is_none_is_no_error_of_the_server(serving, request_line):
    _, address = serving()
    answer = raw(address, request_line)
    assert b"Traceback" not in answer and b"<b>" not in answer and b"xxx" not in answer
    assert response(address)[0] == 200


@pytest.mark.parametrize(
    ("bound", "host", "status"),
    [
        ("127.0.0.1", "127.0.0.1:{port}", 200),
        ("127.0.0.1", "localhost:{port}", 200),
        ("127.0.0.1", "localhost", 200),
        ("127.0.0.1", "[::1]:{port}", 200),
        ("127.0.0.1", "192.168.0.10:{port}", 403),
        ("127.0.0.1", "evil.example:{port}", 403),
        ("127.0.0.1", "localhost.evil.example", 403),
        ("127.0.0.1", "", 403),
        ("0.0.0.0", "192.168.0.10:{port}", 200),
        ("0.0.0.0", "evil.example:{port}", 403),
    ],
)
def test_only_addresses_of_this_machine_are_answered(serving, bound, host, status):
    """A page of another site whose name leads here (DNS rebinding) sees nothing."""
    _, address = serving(bound)
    assert response(address, Host=host.format(port=address[1]))[0] == status


def test_messages_go_into_the_inbox(serving):
    inbox = Inbox("http")
    server, address = serving(inbox=inbox)
    assert post(address, b"one", "/") == post(address, b"two", "/data") == 200
    stage = inbox.arrivals(lambda body: [body.decode()], 0.05)
    assert [arrival.refusal for arrival in stage if arrival.refusal] == ["one", "two"]
    assert post(address, b"three", "/other") == 404
    assert server.is_local


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1"])
def test_the_page_of_another_site_cannot_send(serving, origin):
    inbox = Inbox("http")
    _, address = serving(inbox=inbox)
    assert post(address, b"one", Origin=origin) == 403
    assert post(address, b"one", Origin=f"http://127.0.0.1:{address[1]}") == 200


def test_a_message_that_is_too_large_is_not_read(serving, monkeypatch):
    inbox = Inbox("http")
    _, address = serving(inbox=inbox)
    host = f"Host: 127.0.0.1:{address[1]}".encode()
    for length in (b"4000001", b"999999999999", b"-1", b"1_0", "\u0661".encode(), b""):
        request = b"POST /data HTTP/1.1\r\n%s\r\nContent-Length: %s\r\n\r\n" % (host, length)
        begin = time.monotonic()
        assert b" 200 " not in raw(address, request) and time.monotonic() - begin < 5
    chunked = b"POST /data HTTP/1.1\r\n%s\r\nTransfer-Encoding: chunked\r\n\r\n" % host
    assert b" 411 " in raw(address, chunked)
    monkeypatch.setattr(servers, "LARGEST_MESSAGE", 10)
    assert post(address, bytes(11)) == 413 and post(address, bytes(10)) == 200


def test_an_inbox_that_is_full_is_said(serving, monkeypatch):
    inbox = Inbox("http")
    _, address = serving(inbox=inbox)
    monkeypatch.setattr(inbox, "put", lambda *_: False)
    assert post(address, b"one") == 503


def test_connections_are_few_and_do_not_stay(serving, monkeypatch):
    """Those that say nothing are closed, and then there is room again."""
    monkeypatch.setattr(servers._Handler, "timeout", 1.0)
    server, address = serving()
    silent = [socket.create_connection(address, timeout=20) for _ in range(servers.MOST_OF_ONE)]
    time.sleep(0.3)
    one_more = socket.create_connection(address, timeout=20)
    assert one_more.recv(1) == b""  # closed at once
    assert all(one.recv(1) == b"" for one in silent)  # after the time for which one may be silent
    for one in (*silent, one_more):
        one.close()
    end = time.monotonic() + 10
    while server._connections.total() and time.monotonic() < end:
        time.sleep(0.05)
    assert server._connections.total() == 0 and response(address)[0] == 200


def test_a_body_that_never_ends_is_not_waited_for(serving, monkeypatch):
    monkeypatch.setattr(servers._Handler, "timeout", 0.3)
    inbox = Inbox("http")
    _, address = serving(inbox=inbox)
    host = f"Host: 127.0.0.1:{address[1]}".encode()
    raw(address, b"POST /data HTTP/1.1\r\n%s\r\nContent-Length: 100\r\n\r\nabc" % host)
    assert not inbox._waiting


def test_many_phones_at_once_lose_nothing(serving):
    inbox = Inbox("http")
    _, address = serving(inbox=inbox)
    statuses = []
    threads = [
        threading.Thread(target=lambda: statuses.extend(post(address, b"x") for _ in range(20)))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert statuses == [200] * 160 and len(inbox._waiting) == 160


@pytest.mark.parametrize(
    "text", ["", "x", "0", "65536", "1.2.3.4.5:80", "evil.example:80", "8\u0660"]
)
def test_an_address_that_is_none_is_one_line(text):
    with pytest.raises(InputError, match="names no port; write 8000"):
        listen(text, "http")


def test_a_port_that_is_taken_is_one_line(serving):
    _, address = serving()
    with pytest.raises(InputError, match=r"http:.* cannot listen there \(.*choose another port"):
        listen(str(address[1]), f"http:{address[1]}")


def test_the_address_is_one_that_a_phone_can_reach(serving):
    server, address = serving()
    assert server.address == f"http://127.0.0.1:{address[1]}/"
    server, address = serving("0.0.0.0")
    assert not server.is_local and server.address.startswith("http://")
    assert "0.0.0.0" not in server.address and server.address.endswith(f":{address[1]}/")
