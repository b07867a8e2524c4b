"""The web server of the viewer: fixed routes, for pages that it served itself, and scene files dropped on its page.

Nothing of a request is a path. Pages of other sites, and names that resolve to this machine, are refused.
"""

from __future__ import annotations

import http
import io
import shutil
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import parse_qsl, urlsplit

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.formats import FORMATS

READABLE_NAMES = (
    *(kind.suffix for kind in FORMATS if kind.read and kind.suffix.startswith(".")), ".pt", ".pth", ".zip",
)  # fmt: skip
"""Ends of the names of files that may be dropped."""


LOCAL = ("localhost", "127.0.0.1", "::1")
"""Names of this machine."""


@dataclass(frozen=True)
class Request:
    """A request to a route."""

    options: Mapping[str, str]
    """What follows "?" in its address."""
    length: int
    """Size of its body, bytes."""
    body: BinaryIO


@dataclass(frozen=True)
class Answer:
    """What a route answers."""

    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    status: http.HTTPStatus = http.HTTPStatus.OK
    headers: Mapping[str, str] = field(default_factory=dict)
    file: Callable[[], BinaryIO] | None = None
    """Opens a file that is sent in pieces, in place of the body, or raises OSError."""


@dataclass(frozen=True)
class Route:
    """A path of the server."""

    answer: Callable[[Request], Answer]
    largest: int = 0
    """Largest body, bytes; 0 for requests without one, which get pages."""


class Server(ThreadingHTTPServer):
    """Answers requests to routes, on threads of its own, until it is closed. ``port`` is the first to try; 0 takes any
    free port. Raises PointSplatError if no port is free, or the host is not an address of this machine."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128
    most_connections = 64
    """Largest number of open connections, each of which has a thread: browsers have six for each page. If there are
    more, the one that has waited longest for its client gives way."""

    def __init__(self, host: str, port: int, routes: Mapping[str, Route]):
        self.routes = routes
        self._waiting: dict[socket.socket, float | None] = {}
        """Open connections, and since when they wait for a request; None while one is answered."""
        self._connecting = threading.Lock()
        self.hosts = (*LOCAL, host) if host in LOCAL else None
        """Accepted names of the server; None for any."""
        with suppress(ImportError):
            import resource  # not on Windows

            self.most_connections = min(self.most_connections, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
        self.address_family, address = _free_address(host, port)
        super().__init__(address, _Handler)
        self.url = f"http://{_named(host)}:{self.server_port}"
        """Address of the page."""
        threading.Thread(target=self.serve_forever, name="serving", daemon=True).start()

    def close(self) -> None:
        """Stop to listen."""
        self.shutdown()
        self.server_close()

    def server_bind(self) -> None:
        """Bind without a look-up of the machine's name, which may take seconds."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection on a thread of its own, or close it where all others are being answered."""
        with self._connecting:
            if len(self._waiting) >= self.most_connections:
                since = {connection: at for connection, at in self._waiting.items() if at is not None}
                if since:
                    longest = min(since, key=lambda connection: since[connection])
                    del self._waiting[longest]
                    with suppress(OSError):
                        longest.shutdown(socket.SHUT_RDWR)  # its thread then ends
            if room := len(self._waiting) < self.most_connections:
                self._waiting[request] = time.monotonic()
        if room:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def waits(self, connection: socket.socket, for_client: bool) -> None:
        """Note that a connection waits for its client from now on, or that it has a request to answer."""
        with self._connecting:
            if connection in self._waiting:
                self._waiting[connection] = time.monotonic() if for_client else None

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._connecting:
            self._waiting.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a client that has gone."""


def _named(host: str) -> str:
    host = "127.0.0.1" if host in ("", "0.0.0.0") else host
    return f"[{host}]" if ":" in host else host


def _free_address(host: str, port: int) -> tuple[socket.AddressFamily, tuple[str, int]]:
    """The family of a host, and its address with the first free port from ``port`` on."""
    if not 0 <= port < 65536:
        raise PointSplatError(f"port {port}; expected 0 to 65535")
    last = min(port + 20, 65536) if port else 1  # number of ports to try
    failed = ""
    for candidate in range(port, last):
        try:
            family, *_, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, socket.SOCK_STREAM) as found:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                found.bind(address)
                return family, found.getsockname()[:2]
        except OSError as error:
            failed = error.strerror or str(error)
    raise PointSplatError(f"cannot listen on {host}, port {port} to {last - 1} ({failed}); expected another --port")


def refusal(method: str, headers: Mapping[str, str], hosts: tuple[str, ...] | None) -> http.HTTPStatus | None:
    """The status of a request that is refused for its sender; None if it is served. Browsers name the origin of each
    POST. ``hosts`` are accepted names of the server; None for any."""
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    name = asked[1 : asked.find("]")] if asked.startswith("[") else asked.partition(":")[0]
    if hosts is not None and name not in hosts:  # a foreign page whose name resolves to this server
        return http.HTTPStatus.FORBIDDEN
    if origin != f"http://{asked}" and not (origin is None and method == "GET"):  # a foreign page
        return http.HTTPStatus.FORBIDDEN
    return None


class Served:
    """What a server shows until it is closed; also the context of a ``with`` block."""

    url: str
    """Address of the page."""

    @property
    def origin(self) -> str:
        """Text on the origin of the first view; empty without a scene."""
        return ""

    def wait(self) -> None:
        """Wait until Ctrl-C."""
        threading.Event().wait()

    def close(self) -> None:
        """End the server and all drawing. A second call does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 30  # s without a byte from a client, after which its connection is closed
    server_version, sys_version = "pointsplat", ""

    def do_GET(self) -> None:
        self._serve()

    def do_POST(self) -> None:
        self._serve()

    def log_message(self, *_: object) -> None:
        """Requests are not logged."""

    def _serve(self) -> None:
        last, self.close_connection = self.close_connection, True  # unless the whole body is read
        answer = self._answer()
        self.close_connection |= last  # as the client asked
        try:
            content = io.BytesIO(answer.body) if answer.file is None else answer.file()
        except OSError:
            answer, content = Answer(status=http.HTTPStatus.NOT_FOUND), io.BytesIO()
        with content:
            self._send(answer, content)
        cast(Server, self.server).waits(self.connection, True)

    def _send(self, answer: Answer, content: BinaryIO) -> None:
        length = content.seek(0, io.SEEK_END)
        content.seek(0)
        self.send_response(answer.status)
        headers = {
            "Content-Type": answer.kind,
            "Content-Length": str(length),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            **answer.headers,
            **({"Connection": "close"} if self.close_connection else {}),
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        while length > 0 and (piece := content.read(min(length, 1 << 20))):  # the file may have grown since
            self.wfile.write(piece)
            length -= len(piece)
        self.close_connection |= length > 0

    def _answer(self) -> Answer:
        server = cast(Server, self.server)
        refused = refusal(self.command, {name.title(): value for name, value in self.headers.items()}, server.hosts)
        if refused is not None:
            return Answer(status=refused)
        try:
            asked = urlsplit(self.path)
            options = dict(parse_qsl(asked.query, max_num_fields=8))
        except ValueError:
            return Answer(status=http.HTTPStatus.BAD_REQUEST)
        route = server.routes.get(asked.path)
        if route is None:
            return Answer(status=http.HTTPStatus.NOT_FOUND)
        if (route.largest > 0) != (self.command == "POST"):
            return Answer(status=http.HTTPStatus.METHOD_NOT_ALLOWED)
        length = self.headers.get("Content-Length", "" if route.largest else "0")
        if not length.isascii() or not length.isdigit() or "Transfer-Encoding" in self.headers:
            return Answer(status=http.HTTPStatus.LENGTH_REQUIRED)
        if int(length) > route.largest:
            text = f"{int(length):,} bytes; expected at most {route.largest:,}"
            return Answer(text.encode(), status=http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        body = _Body(self.rfile, int(length), lambda: server.waits(self.connection, False))
        try:
            answer = route.answer(Request(options, int(length), cast(BinaryIO, body)))
        except (ValueError, TypeError, KeyError, OverflowError):  # a body that no page of this server sends
            answer = Answer(status=http.HTTPStatus.BAD_REQUEST)
        self.close_connection = body.left > 0
        return answer


class _Body(io.RawIOBase):
    """A body of known size, read from a connection; ``whole`` is called when nothing of it is missing."""

    def __init__(self, stream: io.BufferedIOBase, length: int, whole: Callable[[], object]):
        self._stream, self.left, self._whole = stream, length, whole
        if length == 0:
            whole()

    def read(self, size: int = -1) -> bytes:
        """At most ``size`` bytes; empty at the end. Raises ValueError if the client sends less than it said."""
        wanted = self.left if size < 0 else min(size, self.left)
        data = self._stream.read(wanted)
        if len(data) < wanted:
            raise ValueError("the body is cut off")
        self.left -= len(data)
        if data and self.left == 0:
            self._whole()
        return data


def received(request: Request, folder: Path) -> tuple[Path, str]:
    """Write the body of a request into an empty folder: the file, and its name for people.

    The client's name (``name`` in the options) decides the end of the file's name, which has to be one of
    :data:`READABLE_NAMES`, and is shown to people. It is no path. Raises SceneError if no scene has such a name, the
    file is empty, or there is no room for it, and ValueError if the client sends less than it said.
    """
    given = request.options["name"]
    name = "".join(sign if sign.isprintable() else "?" for sign in given.replace("\\", "/").rpartition("/")[2])[:80]
    suffix = next((suffix for suffix in READABLE_NAMES if given.lower().endswith(suffix)), None)
    if suffix is None:
        raise SceneError(f"{name}: not a scene; expected a file of {', '.join(READABLE_NAMES)}")
    if request.length == 0:
        raise SceneError(f"{name}: an empty file; expected a scene")
    if shutil.disk_usage(folder).free < 1.1 * request.length:
        raise SceneError(f"{name}: {request.length / 1e6:.0f} MB; the disk here has less room")
    path = folder / f"scene{suffix}"
    with path.open("wb") as stream:
        while data := request.body.read(1 << 20):
            stream.write(data)
    return path, name
