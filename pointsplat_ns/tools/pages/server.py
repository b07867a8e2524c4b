"""The web server of the viewer: fixed routes, for pages that it served itself.

Nothing of a request is a path. Pages of other sites, and names that resolve to this machine, are
refused. Connections are bounded in number and in time, so that clients who are slow, or many, do
not keep others away.
"""

from __future__ import annotations

import http
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any, Protocol, cast
from urllib.parse import parse_qsl, urlsplit

from pointsplat_ns.errors import PointSplatError

LOCAL = ("localhost", "127.0.0.1", "::1")
"""Names of this machine."""


@dataclass(frozen=True)
class Limits:
    """Bounds of connections."""

    connections: int = 64
    """Largest number that is open. A browser has up to 6 to a page."""
    of_one_address: int = 32
    """Largest number that is open to one address, so that others have some."""
    head_seconds: float = 5.0
    """Time for the first lines of a request, s."""
    idle_seconds: float = 30.0
    """Time without a byte of a body or an answer, s."""
    bytes_a_second: float = 50_000.0
    """Least rate of bodies and answers, after ``idle_seconds``."""


LIMITS = Limits()


@dataclass
class _Connection:
    """An open connection."""

    address: str
    begun: float
    deadline: float | None
    """When it is cut; None while its answer is made."""
    in_head: bool = True


@dataclass(frozen=True)
class Request:
    """A request to a route."""

    options: Mapping[str, str]  # what follows "?" in its address
    length: int  # of its body, bytes
    body: Body  # reads are empty if the client sends less than it said


class Body(Protocol):
    """The body of a request."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, at most ``size``."""
        ...


@dataclass(frozen=True)
class Answer:
    """What a route answers."""

    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    status: http.HTTPStatus = http.HTTPStatus.OK
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Route:
    """A path of the server."""

    answer: Callable[[Request], Answer]
    largest: int = 0  # body, bytes; 0 for requests without one, which get pages


class Server(ThreadingHTTPServer):
    """Answers requests to routes, on threads of its own, until it is closed. ``port`` is the first
    to try; 0 takes any free port. Raises PointSplatError if no port is free, or the host is not an
    address of this machine."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(
        self, host: str, port: int, routes: Mapping[str, Route], limits: Limits | None = None
    ):
        limits = limits or LIMITS
        if not 0 <= port < 65536:
            raise PointSplatError(f"port {port}; expected 0 to 65535")
        self.routes = routes
        self.limits = limits
        self._open: dict[Any, _Connection] = {}
        self._lock = threading.Lock()
        self.hosts = LOCAL if host in LOCAL else None
        """Accepted names of the server; None for any."""
        last = min(port + 20, 65536) if port else 1  # number of ports to try
        failed = ""
        for candidate in range(port, last):
            try:
                found = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
                self.address_family = found[0]
                super().__init__(cast(Any, found[4][:2]), _Handler)
                break
            except OSError as error:
                failed = error.strerror or str(error)
        else:
            raise PointSplatError(
                f"cannot listen on {host}, port {port} to {last - 1} ({failed}); expected another "
                "--port"
            )
        name = "127.0.0.1" if host in ("", "0.0.0.0") else host
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{self.server_port}"
        """Address of the page."""
        threading.Thread(target=self.serve_forever, name="serving", daemon=True).start()

    def server_bind(self) -> None:
        """Bind without a look-up of the machine's name, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_name = str(self.server_address[0])
        self.server_port = int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection. If there are too many, the one that has taken longest for its head
        gives way; if none is in its head, the new one is closed."""
        address = str(client_address[0])
        now = time.monotonic()
        with self._lock:
            every = list(self._open.items())
            of_address = [each for each in every if each[1].address == address]
            rivals = []
            if len(of_address) >= self.limits.of_one_address:
                rivals = of_address
            elif len(every) >= self.limits.connections:
                rivals = every
            waiting = [each for each in rivals if each[1].in_head]
            if waiting:
                self._cut(min(waiting, key=lambda each: each[1].begun)[0])
            refused = bool(rivals) and not waiting
            if not refused:
                self._open[request] = _Connection(address, now, now + self.limits.head_seconds)
        if refused:
            self.shutdown_request(request)
        else:
            super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Cut connections whose time is over; called twice a second."""
        now = time.monotonic()
        with self._lock:
            for request, connection in list(self._open.items()):
                if connection.deadline is not None and now > connection.deadline:
                    self._cut(request)

    def _cut(self, request: Any) -> None:
        """End a connection: what its thread waits for fails, and it closes it."""
        self._open.pop(request, None)
        with suppress(OSError):  # the client has gone
            request.shutdown(socket.SHUT_RDWR)

    def expect(self, request: Any, size: int | None) -> None:
        """Give a connection, whose head is complete, the time for ``size`` bytes; any time while an
        answer is made, if None."""
        limits = self.limits
        seconds = 0 if size is None else limits.idle_seconds + size / limits.bytes_a_second
        with self._lock:
            connection = self._open.get(request)
            if connection is not None:
                connection.in_head = False
                connection.deadline = None if size is None else time.monotonic() + seconds

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a client that has gone."""


def refusal(
    method: str, headers: Mapping[str, str], hosts: tuple[str, ...] | None
) -> http.HTTPStatus | None:
    """The status of a request that is refused for its sender; None if it is served. Browsers name
    the origin of each POST. ``hosts`` are accepted names of the server; None for any."""
    asked = headers.get("Host", "")
    origin = headers.get("Origin")
    name = asked[1 : asked.find("]")] if asked.startswith("[") else asked.partition(":")[0]
    if hosts is not None and name not in hosts:  # a foreign page whose name resolves to this server
        return http.HTTPStatus.FORBIDDEN
    if origin != f"http://{asked}" and not (origin is None and method == "GET"):  # a foreign page
        return http.HTTPStatus.FORBIDDEN
    return None


class _Body:
    """The body of a request, which has its time until it is complete."""

    def __init__(self, handler: _Handler, length: int):
        self._handler = handler
        self._left = length
        handler.expect(length or None)

    def read(self, size: int, /) -> bytes:
        data = self._handler.rfile.read(min(size, self._left))
        self._left -= len(data)
        if self._left <= 0 or not data:
            self._handler.expect(None)
        return data


class _Handler(BaseHTTPRequestHandler):
    """Answers one request, and closes its connection."""

    server_version = "pointsplat"
    sys_version = ""

    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(cast(Server, self.server).limits.idle_seconds)

    def log_message(self, *_: object) -> None:
        """Requests are not logged."""

    def expect(self, size: int | None) -> None:
        """See :meth:`Server.expect`."""
        cast(Server, self.server).expect(self.connection, size)

    def do_GET(self) -> None:
        answer = self._answer()
        self.send_response(answer.status)
        headers = {
            "Content-Type": answer.kind,
            "Content-Length": str(len(answer.body)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            **answer.headers,
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.expect(len(answer.body))
        self.end_headers()
        for start in range(0, len(answer.body), 1 << 20):  # the time limit holds for each piece
            self.wfile.write(answer.body[start : start + (1 << 20)])

    do_POST = do_GET

    def _answer(self) -> Answer:
        server = cast(Server, self.server)
        refused = refusal(
            self.command,
            {name.title(): value for name, value in self.headers.items()},
            server.hosts,
        )
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
        if len(length) > 18 or int(length) > route.largest:
            text = f"{length[:18]} bytes; expected at most {route.largest:,}"
            return Answer(text.encode(), status=http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            return route.answer(Request(options, int(length), _Body(self, int(length))))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            # A body that no page of this server sends.
            return Answer(status=http.HTTPStatus.BAD_REQUEST)
