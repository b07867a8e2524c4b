"""The web server of the viewer, with fixed routes for its own pages.

No part of a request becomes a path. Requests from pages of other sites, and to foreign names that
resolve to this machine, are refused. Connections are limited in number and time, so that slow or
numerous clients do not block others.
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
    """Limits of connections."""

    connections: int = 64
    """Maximum number of open connections. A browser opens up to 6 per page."""
    of_one_address: int = 32
    """Maximum number of open connections per address, so that some remain for others."""
    head_seconds: float = 5.0
    """Time limit for the head of a request, s."""
    idle_seconds: float = 30.0
    """Time limit without a byte of a body or an answer, s."""
    bytes_a_second: float = 50_000.0
    """Minimum rate of bodies and answers, after ``idle_seconds``."""


LIMITS = Limits()


@dataclass
class _Connection:
    """An open connection."""

    address: str
    begun: float
    deadline: float | None
    """Time at which it is cut; None while its answer is computed."""
    in_head: bool = True


@dataclass(frozen=True)
class Request:
    """A request to a route."""

    options: Mapping[str, str]  # query of the address
    length: int  # of its body, bytes
    body: Body  # reads are empty if the client sends less than declared


class Body(Protocol):
    """The body of a request."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, at most ``size``."""
        ...


@dataclass(frozen=True)
class Answer:
    """The answer of a route."""

    body: bytes = b""
    kind: str = "text/plain; charset=utf-8"
    status: http.HTTPStatus = http.HTTPStatus.OK
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Route:
    """A path of the server."""

    answer: Callable[[Request], Answer]
    largest: int = 0  # maximum body of a POST, bytes; 0 for GET


class Server(ThreadingHTTPServer):
    """Answers requests to routes, on its own threads, until it is closed. ``port`` is the first
    port to try; 0 takes any free port. Raises PointSplatError if no port is free, or the host is
    not an address of this machine."""

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
        """Bind without looking up the machine's name, which may take seconds."""
        TCPServer.server_bind(self)
        self.server_name = str(self.server_address[0])
        self.server_port = int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection. If there are too many, the oldest connection without a complete head
        is cut. If there is none, the new connection is closed."""
        address = str(client_address[0])
        now = time.monotonic()
        with self._lock:
            every = list(self._open.items())
            of_address = [entry for entry in every if entry[1].address == address]
            rivals = []
            if len(of_address) >= self.limits.of_one_address:
                rivals = of_address
            elif len(every) >= self.limits.connections:
                rivals = every
            waiting = [entry for entry in rivals if entry[1].in_head]
            if waiting:
                self._cut(min(waiting, key=lambda entry: entry[1].begun)[0])
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
        """Cut connections past their time limit; called twice per second."""
        now = time.monotonic()
        with self._lock:
            for request, connection in list(self._open.items()):
                if connection.deadline is not None and now > connection.deadline:
                    self._cut(request)

    def _cut(self, request: Any) -> None:
        """End a connection: its thread gets an error and closes it."""
        self._open.pop(request, None)
        with suppress(OSError):  # the client has disconnected
            request.shutdown(socket.SHUT_RDWR)

    def expect(self, request: Any, size: int | None) -> None:
        """Set the time limit of a connection with a complete head, for ``size`` bytes; None sets no
        limit, while an answer is computed."""
        limits = self.limits
        seconds = 0 if size is None else limits.idle_seconds + size / limits.bytes_a_second
        with self._lock:
            connection = self._open.get(request)
            if connection is not None:
                connection.in_head = False
                connection.deadline = None if size is None else time.monotonic() + seconds

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors of a disconnected client."""


def refusal(
    method: str, headers: Mapping[str, str], hosts: tuple[str, ...] | None
) -> http.HTTPStatus | None:
    """The status of a request refused for its origin; None if it is served. Browsers send the
    origin of every POST. ``hosts`` are the accepted names of the server; None for any."""
    asked = headers.get("Host", "")
    origin = headers.get("Origin")
    name = asked[1 : asked.find("]")] if asked.startswith("[") else asked.partition(":")[0]
    if hosts is not None and name not in hosts:  # a foreign page whose name resolves to this server
        return http.HTTPStatus.FORBIDDEN
    if origin != f"http://{asked}" and not (origin is None and method == "GET"):  # a foreign page
        return http.HTTPStatus.FORBIDDEN
    return None


class _Body:
    """The body of a request, with a time limit until it is complete."""

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
        for start in range(0, len(answer.body), 1 << 20):  # the time limit applies to each piece
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
            # No page of this server sends such a body.
            return Answer(status=http.HTTPStatus.BAD_REQUEST)
