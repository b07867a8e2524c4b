"""Requests that any program may send to a server of the package."""

import http.client

from pointsplat_ns.pages.server import Served


def answer(viewer: Served, method: str, path: str, body: bytes | None = None, **headers: str):
    """What the server says to a request that any program may send: status, body and headers."""
    host = viewer.url.removeprefix("http://")
    connection = http.client.HTTPConnection(host, timeout=30)
    connection.putrequest(method, path, skip_host="Host" in headers)
    length = {} if body is None or "Content_Length" in headers else {"Content-Length": str(len(body))}
    for name, value in {**length, **headers}.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders(body)
    response = connection.getresponse()
    return response.status, response.read(), dict(response.getheaders())
