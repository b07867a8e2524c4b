"""viser's web server with its security holes closed.

viser 0.2.7 serves any file for a path with ``..``, accepts connections from any page of the same browser, gives every
client a public address on request, reports each visit to a statistics service, and hangs where it cannot listen.
"""

from __future__ import annotations

import contextlib
import http
import io
import socket
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any

import viser
import websockets.server as websockets_server

from pointsplat_ns.errors import PointSplatError

_SERVER: Any = websockets_server
"""The module whose ``serve`` viser calls."""

POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob:; worker-src 'self' blob:; "
    "frame-ancestors 'none'"
)
"""Content security policy: the page loads from this server alone."""


class Server(viser.ViserServer):
    """viser's server without public addresses."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Tell clients that there is no public address."""
        for client in self.get_clients().values():
            client.add_notification("Not shared", "This viewer has no public address; see its option --host.")


def start_server(host: str, port: int, label: str) -> Server:
    """Serve on the first free port from ``port`` on; 0 takes any.

    Raises:
        PointSplatError: if no port is free, or viser cannot be guarded.
    """
    port = free_port(host, port)
    local = ("localhost", "127.0.0.1", "::1")
    hosts = (*local, host) if host in local else None
    with _guarded(hosts) as served, contextlib.redirect_stdout(io.StringIO()):  # viser prints its own lines
        server = Server(host=host, port=port, label=label, verbose=False)
    if not served:
        server.stop()
        raise PointSplatError(f"viser {version('viser')} cannot be made safe; expected viser 0.2.7")
    return server


def free_port(host: str, port: int) -> int:
    """The first free port from ``port`` on.

    Raises:
        PointSplatError: if no port is free, or the host is not an address of this machine.
    """
    if not 0 <= port < 65536:
        raise PointSplatError(f"port {port}; expected 0 to 65535")
    last = min(port + 20, 65536) if port else 1  # number of ports to try
    failed = ""
    for candidate in range(port, last):
        try:
            kind, *_, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.socket(kind, socket.SOCK_STREAM) as found:
                found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                found.bind(address)
                return found.getsockname()[1]
        except OSError as error:
            failed = error.strerror or str(error)
    raise PointSplatError(f"cannot listen on {host}, port {port} to {last - 1} ({failed}); expected another --port")


def refusal(path: str, headers: Mapping[str, str], hosts: tuple[str, ...] | None) -> http.HTTPStatus | None:
    """The status of a refused request; None if it is served.

    Args:
        path: path of the request.
        headers: headers of the request.
        hosts: accepted names of the server; None for any.
    """
    target = path.partition("?")[0]
    parts = target.split("/")
    if parts[0] or ".." in parts or "" in parts[1:-1] or any(sign in target for sign in "\\:\0"):
        return http.HTTPStatus.NOT_FOUND
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    name = asked[1 : asked.find("]")] if asked.startswith("[") else asked.partition(":")[0]
    if hosts is not None and name not in hosts:  # a foreign page whose name resolves to this server
        return http.HTTPStatus.FORBIDDEN
    if origin is not None and origin.partition("://")[2] != asked:  # a foreign page
        return http.HTTPStatus.FORBIDDEN
    return None


@contextlib.contextmanager
def _guarded(hosts: tuple[str, ...] | None) -> Iterator[list[bool]]:
    """Make servers that start in this context refuse requests by :func:`refusal`. The list gets an entry for each."""
    plain, served = _SERVER.serve, []

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        async def guarded(path: str, headers: Any) -> Any:
            status = refusal(path, headers, hosts)
            if status is not None:
                return status, {}, b""
            answer = await process_request(path, headers)
            return answer and (answer[0], {**answer[1], "Content-Security-Policy": POLICY}, answer[2])

        served.append(True)
        return plain(handler, host, port, process_request=guarded, **options)

    _SERVER.serve = serve
    try:
        yield served
    finally:
        _SERVER.serve = plain
