"""The viewer answers its own pages, and nobody else."""

import html
import http.client
import json
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.tools.pages import viewer as viewing
from pointsplat_ns.tools.pages.server import LIMITS, LOCAL, Answer, Limits, Route, Server, refusal
from pointsplat_ns.tools.pages.viewer import Viewer

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with ps.open_viewer(ball(300), port=0) as opened:
        yield opened


@pytest.fixture()
def empty() -> Iterator[Viewer]:
    with ps.open_viewer(port=0) as opened:
        yield opened


def answer(viewer: Viewer, method: str, path: str, body: bytes | None = None, **headers: str):
    """What the viewer says to a request that any program may send: status, body and headers."""
    connection = http.client.HTTPConnection(viewer.url.removeprefix("http://"), timeout=30)
    connection.putrequest(method, path, skip_host="Host" in headers)
    length = (
        {} if body is None or "Content_Length" in headers else {"Content-Length": str(len(body))}
    )
    for name, value in {**length, **headers}.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders(body)
    response = connection.getresponse()
    return response.status, response.read(), dict(response.getheaders())


def post(viewer: Viewer, path: str, body: bytes, **headers: str):
    """A request as the viewer's own page sends it."""
    return answer(viewer, "POST", path, body, **{"Origin": viewer.url, **headers})


def scene_at(
    viewer: Viewer, percent: int, have: str = "", **values: Any
) -> tuple[int, bytes, dict[str, Any]]:
    """The answer to a page that asks for its only scene at a share."""
    asked = {**ASKED, "percent": percent, "have": have, **values}
    status, body, headers = post(viewer, "/scene", json.dumps(asked).encode())
    return status, body, json.loads(headers["X-State"])


def test_page_is_served_and_asks_nobody_else(viewer):
    status, body, headers = answer(viewer, "GET", "/")
    policy = html.unescape(body.decode())
    assert "default-src 'none'" in policy
    assert status == 200 and b"<html" in body and "connect-src 'self'" in policy
    assert b"http://" not in body and b"https://" not in body
    assert (
        headers["X-Frame-Options"] == "DENY"
        and headers["Cross-Origin-Resource-Policy"] == "same-origin"
    )


@pytest.mark.parametrize(
    ("method", "headers", "refused"),
    [
        ("GET", {"Host": "localhost:7007"}, None),
        ("GET", {"Host": "[::1]:7007"}, None),
        ("POST", {"Host": "127.0.0.1:7007", "Origin": "http://127.0.0.1:7007"}, None),
        ("POST", {"Host": "127.0.0.1:7007", "Origin": "http://127.0.0.1:8000"}, 403),
        ("POST", {"Host": "127.0.0.1:7007", "Origin": "null"}, 403),
        ("POST", {"Host": "127.0.0.1:7007"}, 403),
        ("GET", {"Host": "127.0.0.1:7007", "Origin": "http://evil.example"}, 403),
        ("GET", {"Host": "rebound.example:7007", "Origin": "http://rebound.example:7007"}, 403),
        ("GET", {}, 403),
    ],
)
def test_who_is_refused(method, headers, refused):
    assert refusal(method, headers, LOCAL) == refused


def test_pages_elsewhere_move_no_camera_and_drop_no_scene(viewer, empty):
    for opened, path in ((viewer, "/scene"), (empty, "/drop?name=a.ply")):
        for origin in ({"Origin": "http://evil.example"}, {}):
            assert answer(opened, "POST", path, b"{}", **origin)[0] == 403
        assert answer(opened, "GET", path)[0] == 405


ASKED = {"stage": 1, "scene": 0, "percent": 50, "have": "", "spz": True}
WRONG = [{"scene": 1}, {"scene": -1}, {"percent": "x"}, {"percent": math.inf}]
BODIES = [b"", b"[]", b"{", b"\xff", b'{"stage": 1}', b"[" * 1000]


@pytest.mark.parametrize(
    "body", [*BODIES, *(json.dumps({**ASKED, **wrong}).encode() for wrong in WRONG)]
)
def test_what_no_page_sends_is_refused_and_harms_nothing(body, viewer):
    assert post(viewer, "/scene", body)[0] == 400
    assert scene_at(viewer, 100)[0] == 200
    assert post(viewer, "/scene", json.dumps({**ASKED, "stage": 2}).encode())[0] == 409, (
        "another scene is shown"
    )


def test_a_dropped_scene_is_shown(empty, tmp_path):
    assert b"Drop a file here" in answer(empty, "GET", "/")[1]
    ps.save(ball(300), tmp_path / "a.sog")
    name = quote("my ball.sog")
    assert post(empty, f"/drop?name={name}", (tmp_path / "a.sog").read_bytes())[:2] == (204, b"")
    assert b"<strong>my ball.sog</strong>" in answer(empty, "GET", "/")[1]
    status, body, state = scene_at(empty, 100)
    (tmp_path / "shown.spz").write_bytes(body)
    assert status == 200 and len(ps.load(tmp_path / "shown.spz")) == 300
    assert state == {"amount": "300 Gaussians", "command": "", "how": "all", "whole": True}


HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999\nproperty float x\nend_header\n"


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.txt", b"text", "a.txt: not a scene; expected a file of .compressed.ply, .ply"),
        ("../../../etc/passwd", b"x", "passwd: not a scene"),
        ("/etc/cron.d/a.ply", b"x", "a.ply: "),
        ("a\x1b]0;pwned\x07<b>.bad", b"x", "a?]0;pwned?<b>.bad: not a scene"),
        ("a.ply", b"", "a.ply: an empty file"),
        ("a.ply", HEADER, "a.ply: "),
        ("a.sog", b"PK\x03\x04" + bytes(50), "a.sog: "),
        ("a.ckpt", b"cos\nsystem\n(S'touch pwned'\ntR.", "a.ckpt: "),
        ("a.splat", struct.pack("<8f", *[float("nan")] * 8), "no Gaussians that can be drawn"),
        ("config.yml", b"!!python/object/apply:os.system [touch pwned]", "not a scene"),
    ],
)
def test_hostile_files_are_one_line_and_nothing_stays(
    name, data, words, empty, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    status, body, headers = post(empty, f"/drop?name={quote(name)}", data)
    assert status == 422 and headers["Content-Type"].startswith("text/plain")
    assert (
        words in body.decode() and "\n" not in body.decode() and str(tmp_path) not in body.decode()
    )
    assert list(tmp_path.iterdir()) == [], "no file is left, and none was made"
    assert b"Drop a file here" in answer(empty, "GET", "/")[1]


def test_too_large_and_cut_off_files_are_refused(empty, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    status, body, _ = post(
        empty, "/drop?name=a.ply", b"x", Content_Length=str(viewing.LARGEST_FILE + 1)
    )
    assert status == 413 and b"expected at most 4,000,000,000" in body
    host, port = empty.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=30) as client:
        request = (
            f"POST /drop?name=a.ply HTTP/1.1\r\nHost: {host}:{port}\r\nOrigin: {empty.url}\r\n"
        )
        client.sendall(request.encode() + b"Content-Length: 100\r\n\r\nhalf")
        client.shutdown(socket.SHUT_WR)
        assert b" 400 " in client.recv(1000).partition(b"\r\n")[0] + b" "
    monkeypatch.setattr(viewing.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 10}))
    assert b"the disk here has less room" in post(empty, "/drop?name=a.ply", b"x" * 20)[1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("host", "port"), [("192.0.2.1", 7007), ("no such host", 7007), ("127.0.0.1", 70000)]
)
def test_places_that_cannot_be_listened_on_are_refused_in_one_line(host, port):
    with pytest.raises(ps.PointSplatError, match="expected") as raised:
        ps.open_viewer(host=host, port=port)
    assert "\n" not in str(raised.value)


def test_closing_twice_stops_merging_and_frees_the_port(endless):
    begun, ended = endless
    viewer = ps.open_viewer(ball(300), port=0)
    waiting = threading.Thread(target=scene_at, args=(viewer, 50, "chosen by coverage"))
    waiting.start()
    assert begun.wait(30)
    viewer.close()
    viewer.close()
    assert ended.is_set()
    waiting.join(10)
    assert not waiting.is_alive()
    with socket.socket() as again:
        again.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        again.bind(("127.0.0.1", int(viewer.url.rpartition(":")[2])))


def test_kept_share_comes_at_once_then_merged_with_its_command(tmp_path):
    path = Path(tmp_path / "a room.ply")
    ps.save(ps.example_room()[::20], path)
    with ps.open_viewer(path, port=0) as viewer:
        status, first, state = scene_at(viewer, 20)
        assert (
            state["amount"] == "629 of 3,143 Gaussians, chosen by coverage, merging ..."
            and not state["whole"]
        )
        assert status == 200 and state["command"] == f"pointsplat prune '{path}' --keep 20%"
        assert scene_at(viewer, 20, spz=False)[:2] == (204, b"")
        status, body, state = scene_at(viewer, 20, state["how"])
        assert status == 200 and body != first
        assert state["amount"] == "629 of 3,143 Gaussians, merged" and state["whole"]
        assert scene_at(viewer, 20, "merged")[0] == 204


def test_bodies_have_a_size_that_is_said_and_not_too_large(viewer):
    assert post(viewer, "/scene", b"x" * 70_000)[0] == 413
    assert answer(viewer, "POST", "/scene", None, Origin=viewer.url)[0] == 411
    assert post(viewer, "/scene", b"x", Content_Length="-1")[0] == 411
    assert post(viewer, "/scene", b"x", Content_Length="9" * 5_000)[0] == 413
    assert post(viewer, "/scene", b"x", Transfer_Encoding="chunked")[0] == 411


@pytest.mark.parametrize(
    "path", ["/../__init__.py", "/drop", "/spz.js", "/etc/passwd", "/%2e%2e/x", "/?/../../x"]
)
def test_only_the_routes_are_served(path, viewer):
    status, body, _ = answer(viewer, "GET", path)
    assert status == (200 if path.startswith("/?") else 404) and b"root:" not in body


QUICK = Limits(head_seconds=1.0, idle_seconds=1.0, bytes_a_second=1e9)
"""Limits that end a test soon."""


@pytest.fixture()
def served(time_limit) -> Iterator[Callable[..., Server]]:
    """Makes servers of a page of 64 MB, which no socket takes at once, and of a route that reads a
    body."""
    servers: list[Server] = []
    large = bytes(1 << 26)

    def make(limits: Limits | None = None) -> Server:
        routes = {
            "/": Route(lambda request: Answer(b"page")),
            "/large": Route(lambda request: Answer(large)),
            "/body": Route(lambda request: Answer(request.body.read(request.length)), 1 << 20),
        }
        servers.append(Server("127.0.0.1", 0, routes, limits))
        return servers[-1]

    yield make
    for server in servers:
        server.shutdown()
        server.server_close()


def connected(server: Server, sent: bytes, address: str = "127.0.0.1") -> socket.socket:
    client = socket.create_connection(
        ("127.0.0.1", server.server_port), timeout=60, source_address=(address, 0)
    )
    client.sendall(sent)
    return client


def page_of(server: Server, address: str = "127.0.0.1") -> bytes:
    """What a client of an address gets who asks for the page; nothing if it is refused."""
    with connected(server, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", address) as client:
        try:
            return b"".join(iter(lambda: client.recv(1 << 16), b""))
        except ConnectionError:
            return b""


def is_closed(client: socket.socket) -> bool:
    """Whether the server has closed a connection on which it sends nothing."""
    client.setblocking(False)
    try:
        return client.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_at_most_64_connections_are_open_and_who_comes_later_is_served(served):
    server = served()
    slow = [connected(server, b"GET / HT", f"127.0.0.{2 + index % 5}") for index in range(300)]
    assert page_of(server).endswith(b"page") and page_of(server, "127.0.0.2").endswith(b"page")
    assert sum(not is_closed(client) for client in slow) <= LIMITS.connections == 64
    assert threading.active_count() < 200
    for client in slow:
        client.close()


def test_heads_that_come_byte_by_byte_end(served):
    server = served(QUICK)
    with connected(server, b"GET / HTTP/1.1\r\n") as client:
        client.settimeout(0.1)
        while True:  # the fixture ends a test that does not
            try:
                client.sendall(b"x")
                if client.recv(1) == b"":
                    break
            except TimeoutError:
                continue
            except ConnectionError:
                break


def test_one_address_that_reads_nothing_leaves_connections_to_others(served):
    server = served()
    ask = b"GET /large HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    greedy = []
    for _ in range(LIMITS.of_one_address):
        greedy.append(connected(server, ask, "127.0.0.2"))
        assert greedy[-1].recv(12) == b"HTTP/1.0 200"
    assert page_of(server, "127.0.0.2") == b""
    assert page_of(server).endswith(b"page")
    for client in greedy:
        client.close()


def test_answers_that_nobody_reads_and_bodies_that_nobody_sends_end(served):
    server = served(QUICK)
    with connected(server, b"GET /large HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") as client:
        assert client.recv(12) == b"HTTP/1.0 200"
        while server._open:
            time.sleep(0.05)
        got = b"".join(iter(lambda: _received(client), b""))
    assert len(got) < 1 << 26
    head = f"POST /body HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: {'http://127.0.0.1'}\r\n"
    with connected(server, head.encode() + b"Content-Length: 100000\r\n\r\n") as client:
        sender = threading.Thread(target=_trickled, args=(client,))
        sender.start()
        sender.join(30)
        assert not sender.is_alive()


def _received(client: socket.socket) -> bytes:
    try:
        return client.recv(1 << 20)
    except ConnectionError:
        return b""


def _trickled(client: socket.socket) -> None:
    """Send a byte ten times a second until the connection is cut."""
    try:
        while True:
            client.sendall(b"x")
            time.sleep(0.1)
    except OSError:
        pass
