"""Serves the page beside a streamed SOG: the files that are there when it begins, and nothing else."""

from __future__ import annotations

from http import HTTPStatus
from pathlib import Path
from urllib.parse import quote

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.formats import STREAM_META
from pointsplat_ns.io.formats.sog_stream import stream_parts
from pointsplat_ns.pages.stream_page import page_files
from pointsplat_ns.viewing.server import Answer, Route, Served, Server


class PageServer(Served):
    """Serves the folder of a stream with its page. ``port`` is the first to try; 0 takes any free port.

    Raises SceneError if there is no such page or the stream is damaged, and PointSplatError if no port is free.
    """

    def __init__(self, folder: Path, host: str, port: int):
        page = page_files(folder)
        if not page:
            raise SceneError(f"{folder}: has no page; expected a folder that `pointsplat lod --stream --html` wrote")
        routes = {"/": _route(page[0]), "/favicon.ico": Route(lambda _: Answer(status=HTTPStatus.NO_CONTENT))}
        for file in (*page[1:], *stream_parts(folder / STREAM_META)):
            routes["/" + quote(file.relative_to(folder).as_posix())] = _route(file)
        self._server = Server(host, port, routes)
        self.url = self._server.url

    @property
    def origin(self) -> str:
        """Text on the origin of the first view."""
        return "the view that its page was made with; the browser draws"

    def close(self) -> None:
        """End the server. A second call does nothing."""
        if self._server.fileno() >= 0:
            self._server.close()


def is_stream_with_page(folder: Path) -> bool:
    """Whether a folder has a streamed SOG and the page that was written beside it."""
    return (folder / STREAM_META).is_file() and bool(page_files(folder))


def _route(file: Path) -> Route:
    """The route of a file, which is opened when it is asked for."""
    text = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".txt": "text/plain"}
    other = {".json": "application/json", ".webp": "image/webp"}
    kind = other.get(file.suffix, "application/octet-stream")
    if file.suffix in text:
        kind = f"{text[file.suffix]}; charset=utf-8"
    headers = {}
    if file.suffix == ".html":  # nothing comes from elsewhere, whatever the page's address asks for
        headers["Content-Security-Policy"] = (
            "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
            "style-src 'self' 'unsafe-inline'; base-uri 'self'; form-action 'none'"
        )
    return Route(lambda _: Answer(kind=kind, headers=headers, file=file))
