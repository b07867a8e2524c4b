"""Serves a streamed SOG with the page beside it: the files that are there when it begins, and nothing else.

The folder may be a stranger's. Its page and scripts are served only if they are those that this package writes; of the
stream only regular files inside the folder.
"""

from __future__ import annotations

import functools
import logging
from dataclasses import replace
from http import HTTPStatus
from pathlib import Path
from urllib.parse import quote

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import open_inside
from pointsplat_ns.io.formats import STREAM_META
from pointsplat_ns.io.formats.sog_stream import stream_parts
from pointsplat_ns.pages.server import Answer, Route, Served, Server
from pointsplat_ns.pages.stream_page import own_page, page_files

logger = logging.getLogger("pointsplat_ns")


class PageServer(Served):
    """Serves the folder of a stream with its page. ``port`` is the first to try; 0 takes any free port.

    Raises SceneError if there is no such page or the stream is damaged, and PointSplatError if no port is free.
    """

    def __init__(self, folder: Path, host: str, port: int):
        page = own_page(folder)
        if not page:
            raise SceneError(f"{folder}: has no page; expected a folder that `pointsplat lod --stream --html` wrote")
        routes = {"/favicon.ico": Route(lambda _: Answer(status=HTTPStatus.NO_CONTENT))}
        for name, data in page.items():
            routes["/" if name == "index.html" else f"/{name}"] = _route(name, Answer(data))
        for file in stream_parts(folder / STREAM_META):
            name = file.relative_to(folder).as_posix()
            routes["/" + quote(name)] = _route(name, Answer(file=functools.partial(open_inside, folder, file)))
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
    if not (folder / STREAM_META).is_file() or not page_files(folder):
        return False
    if own_page(folder):
        return True
    logger.warning("%s: its page is not the one that this version writes, so it is not served; the scene is", folder)
    return False


def _route(name: str, answer: Answer) -> Route:
    """The route of a file. Where it is not in memory, it is opened when it is asked for."""
    text = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".txt": "text/plain"}
    other = {".json": "application/json", ".webp": "image/webp"}
    suffix = Path(name).suffix
    kind = f"{text[suffix]}; charset=utf-8" if suffix in text else other.get(suffix, "application/octet-stream")
    policy = "sandbox; default-src 'none'"  # data, should a browser open it as a page
    if suffix == ".html":  # nothing comes from elsewhere, whatever the page's address asks for
        policy = (
            "default-src 'self' data: blob:; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:; "
            "style-src 'self' 'unsafe-inline'; base-uri 'self'; form-action 'none'"
        )
    filled = replace(answer, kind=kind, headers={"Content-Security-Policy": policy})
    return Route(lambda _: filled)
