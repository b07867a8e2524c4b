"""The web server of the viewer: fixed routes, for pages that it served itself.

Nothing of a request is a path. Pages of other sites, and names that resolve to this machine, are
refused.
"""

from __future__ import annotations

import http
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any, BinaryIO, cast
from urllib.parse import parse_qsl, urlsplit

from pointsplat_ns.errors import PointSplatError

LOCAL = ("localhost", "127.0.0.1", "::1")
"""Names of this machine."""


@dataclass(frozen=True)
class Request:
    """A request to a route."""

    options: Mapping[str, str]  # what follows "?" in its address
    length: int  # of its body, bytes
    body: BinaryIO  # reads are empty if the client sends less than it said


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

    def __init__(self, host: str, port: int, routes: Mapping[str, Route]):
        if not 0 <= port < 65536:
            raise PointSplatError(f"port {port}; expected 0 to 65535")
        self.routes = routes
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


class _Handler(BaseHTTPRequestHandler):
    """Answers one request, and closes its connection."""

    timeout = 30  # s without a byte from a client
    server_version = "pointsplat"
    sys_version = ""

    def log_message(self, *_: object) -> None:
        """Requests are not logged."""

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
        if int(length) > route.largest:
            text = f"{int(length):,} bytes; expected at most {route.largest:,}"
            return Answer(text.encode(), status=http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        try:
            return route.answer(Request(options, int(length), cast(BinaryIO, self.rfile)))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            # A body that no page of this server sends.
            return Answer(status=http.HTTPStatus.BAD_REQUEST)
