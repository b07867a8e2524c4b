"""The viewer answers who it is for, and nobody else."""

from __future__ import annotations

import asyncio
import http.client
import socket
import time
from collections.abc import Iterator
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.viewing.schedule import Step
from pointsplat_ns.viewing.server import free_port, refusal
from pointsplat_ns.viewing.viewer import Viewer

SECONDS = 60
"""How long a test waits for what shall come; it takes a fraction of one."""

HOSTS = ("localhost", "127.0.0.1", "::1")


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with ps.open_viewer(ball(300), port=0) as opened:
        yield opened


def answer(viewer: Viewer, path: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    """What the server says to a request that no browser would send."""
    host = viewer.url.removeprefix("http://")
    connection = http.client.HTTPConnection(host, timeout=30)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    return response.status, response.read(), dict(response.getheaders())


def test_page_is_served_and_asks_nobody_else(viewer):
    status, body, headers = answer(viewer, "/")
    assert status == 200 and b"<html" in body
    policy = headers["Content-Security-Policy"]
    assert "default-src 'self'" in policy and "http" not in policy and "*" not in policy


@pytest.mark.parametrize(
    "path", ["/../__init__.py", "/assets/../../../_viser.py", "/../../../../../../../../etc/passwd"]
)
def test_no_other_files_are_served(path, viewer):
    status, body, _ = answer(viewer, path)
    assert status == 404 and body == b""


def test_pages_elsewhere_are_refused(viewer):
    here = viewer.url.removeprefix("http://")
    socket_of = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
    assert answer(viewer, "/", Origin="http://evil.example", **socket_of, **key)[0] == 403
    assert answer(viewer, "/", Host="evil.example:80")[0] == 403
    assert answer(viewer, "/", Origin=viewer.url, Host=here)[0] == 200


@pytest.mark.parametrize(
    ("path", "headers", "refused"),
    [
        ("/", {"Host": "localhost:7007"}, None),
        ("/assets/index.js?a=..:", {"Host": "[::1]:7007"}, None),
        ("/", {"Host": "127.0.0.1:7007", "Origin": "http://127.0.0.1:7007"}, None),
        ("/", {"Host": "127.0.0.1:7007", "Origin": "http://127.0.0.1:8000"}, 403),
        ("/", {"Host": "127.0.0.1:7007", "Origin": "null"}, 403),
        ("/", {"Host": "rebound.example:7007", "Origin": "http://rebound.example:7007"}, 403),
        ("/", {}, 403),
        ("//etc/passwd", {"Host": "localhost"}, 404),
        ("etc/passwd", {"Host": "localhost"}, 404),
        ("/..\\..\\secret", {"Host": "localhost"}, 404),
        ("/C:/secret", {"Host": "localhost"}, 404),
    ],
)
def test_who_is_refused(path, headers, refused):
    assert refusal(path, headers, HOSTS) == refused


def test_server_for_a_network_may_be_called_by_any_name():
    assert refusal("/", {"Host": "studio.example:7007"}, None) is None
    assert refusal("/", {"Host": "studio.example:7007", "Origin": "http://other.example"}, None) == 403


def test_nobody_gets_a_public_address(viewer):
    assert viewer._server.request_share_url() is None and viewer._server._share_tunnel is None


def test_next_free_port_is_taken():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) < port + 20
        with ps.open_viewer(ball(300), port=port) as viewer:
            assert int(viewer.url.rpartition(":")[2]) > port and answer(viewer, "/")[0] == 200


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 7007), ("no such host", 7007), ("127.0.0.1", 70000)])
def test_places_that_cannot_be_listened_on_are_refused_in_one_line(host, port):
    with pytest.raises(ps.PointSplatError, match="expected") as raised:
        free_port(host, port)
    assert "\n" not in str(raised.value)


def test_a_page_that_has_gone_is_not_kept(viewer):
    server = viewer._server._websock_server
    loop = server._broadcast_buffer.event_loop

    async def sending() -> int:
        return sum("_message_producer" in str(task.get_coro()) for task in asyncio.all_tasks())

    def waiting() -> int:
        return asyncio.run_coroutine_threadsafe(sending(), loop).result(SECONDS)

    before = waiting()
    for _ in range(3):
        with connect(viewer.url.replace("http", "ws"), max_size=None) as page:
            camera = ViewerCameraMessage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -4.0), 1.0, 1.0, (0.0,) * 3, (0.0, 0.0, 1.0))
            page.send(msgspec.msgpack.encode(camera.as_serializable_dict()))  # before it, viser tells of no page
            while b"BackgroundImageMessage" not in page.recv(timeout=SECONDS):
                pass
            assert waiting() > before
    end = time.monotonic() + SECONDS
    while waiting() > before and time.monotonic() < end:
        time.sleep(0.05)
    assert waiting() == before


@pytest.fixture()
def painted(viewer):
    """A page that is looked at, and what paints on it: gives the function that shows a picture, and what was shown."""
    shown, made = [], {}

    class Page:
        client_id = 77
        camera = scene = gui = SimpleNamespace(
            add_markdown=lambda text: SimpleNamespace(content=text), on_update=lambda look: None,
            set_background_image=lambda *_, jpeg_quality, **__: shown.append(jpeg_quality),
        )  # fmt: skip

    page = Page()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pointsplat_ns.viewing.viewer.Painter", lambda show: made.setdefault("show", show))
        patch.setattr(viewer, "_put", lambda client: None)
        patch.setattr(viewer, "_look", lambda client: None)
        viewer._connected(page)
    viewer._painters.pop(page.client_id)
    yield page, made["show"], shown
    viewer._notes.pop(page.client_id, None)


def test_a_picture_that_is_done_when_its_page_has_gone_goes_nowhere(viewer, painted):
    page, show, shown = painted
    viewer._disconnected(page)
    show(np.zeros((2, 2, 3), np.uint8), Step(None, 1, 2, 1.0, False, True), 0.1)
    assert len(shown) == 1 and page.client_id not in viewer._notes


def test_a_whole_picture_of_a_moving_camera_is_sent_and_named_as_a_whole_one(viewer, painted):
    page, show, shown = painted
    said = []
    for moving, whole in ((True, False), (True, True), (False, True)):
        show(np.zeros((2, 2, 3), np.uint8), Step(None, 1, 2, 1.0, moving, whole), 0.1)
        said.append(viewer._notes[page.client_id].content)
    assert said == ["moving: 2 x 2, 100 ms a frame", *["2 x 2, 100 ms a frame"] * 2]
    assert shown[0] < shown[1] == shown[2]
