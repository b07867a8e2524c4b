"""Pages with viewers, served from this machine and drawn by a headless Chromium."""

from __future__ import annotations

import base64
import io
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlencode, urlsplit

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lab.viewers import packages
from lab.viewers.subject import SIZE

PAGES = Path(__file__).parent / "pages"

SECONDS = 90.0
"""How long a viewer may take for a file; on an idle machine it takes a few."""

QUIET = 1.0
"""Seconds without a change, after which a picture counts as finished: viewers sort and load levels
in the background."""

ARGUMENTS = (
    "--headless",
    "--no-sandbox",  # Chromium has none for root
    "--disable-dev-shm-usage",
    "--ignore-gpu-blocklist",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
)


class NotOpened(Exception):
    """A viewer did not open a file; says why in its own words."""


class Handler(SimpleHTTPRequestHandler):
    """Serves files below named folders, whole or in ranges, as Spark asks for."""

    protocol_version = "HTTP/1.1"
    extensions_map = {
        **SimpleHTTPRequestHandler.extensions_map,
        ".js": "text/javascript",
        ".mjs": "text/javascript",
        ".wasm": "application/wasm",
    }

    def __init__(self, roots: dict[str, Path], *args: Any):
        self.roots = roots
        super().__init__(*args)

    def do_GET(self) -> None:
        _, root, *rest = unquote(urlsplit(self.path).path).split("/")
        path = self.roots.get(root, Path("/nowhere")).joinpath(*rest)
        if ".." in rest or not path.is_file():
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        content = path.read_bytes()
        part = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        first, last = 0, len(content) - 1
        if part:
            first = int(part[1])
            last = min(int(part[2] or last), last)
        self.send_response(HTTPStatus.PARTIAL_CONTENT if part else HTTPStatus.OK)
        if part:
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Type", self.guess_type(str(path)))
        self.send_header("Content-Length", str(last + 1 - first))
        self.end_headers()
        self.wfile.write(content[first : last + 1])

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not printed."""


class Viewers:
    """A browser with the pages of all viewers."""

    def __init__(self, driver: Any, address: str):
        self.driver = driver
        self.address = address

    def picture(self, page: str, file: str, camera: dict[str, Any]) -> Tensor:
        """The picture (H, W, 3) in [0, 1] that a viewer draws of a file.

        Args:
            page: name of the page.
            file: path below the folder of files.
            camera: what the page is told.

        Raises:
            NotOpened: if the viewer fails, shows nothing or takes longer than :data:`SECONDS`.
        """
        end = self._open(page, file, camera)
        last = None
        since = time.monotonic()
        while time.monotonic() - since < QUIET or last is None or not last.any():
            if time.monotonic() > end:
                raise NotOpened(
                    "nothing is drawn" if last is None or not last.any() else "never still"
                )
            self.driver.execute_script("viewer.draw()")
            shot = Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")
            now = np.asarray(shot).copy()
            if last is None or not np.array_equal(now, last):
                last = now
                since = time.monotonic()
            if failed := self._state()["failed"]:
                raise NotOpened(failed)
        return torch.from_numpy(last).float() / 255

    def written(self, page: str, file: str) -> bytes:
        """What a page makes of a file. Raises NotOpened."""
        self._open(page, file, {})
        return base64.b64decode(self.driver.execute_script("return viewer.written"))

    def _open(self, page: str, file: str, camera: dict[str, Any]) -> float:
        """Open a page and wait until its file is open. Returns the time at which patience ends."""
        end = time.monotonic() + SECONDS
        words = urlencode({"file": f"/files/{file}", "camera": json.dumps(camera)})
        self.driver.get(f"{self.address}/pages/{page}.html?{words}")
        while not (state := self._state()) or not state["ready"]:
            if state and state["failed"]:
                raise NotOpened(state["failed"])
            if time.monotonic() > end:
                said = [entry["message"] for entry in self.driver.get_log("browser")]
                raise NotOpened(f"not open within {SECONDS:g} s {' '.join(said)[-500:]}")
            time.sleep(0.1)
        return end

    def _state(self) -> dict[str, Any] | None:
        return self.driver.execute_script(
            "return window.viewer ? {ready: viewer.ready, failed: viewer.failed} : null"
        )


@contextmanager
def viewers(files: Path) -> Iterator[Viewers]:
    """A browser of its own for files in a folder, closed at the end. Raises Missing if Chromium or
    the packages are missing."""
    roots = {"modules": packages.modules(), "pages": PAGES, "files": files}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, roots))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with packages.browser(ARGUMENTS) as driver:
            size = {"width": SIZE, "height": SIZE, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            yield Viewers(driver, f"http://127.0.0.1:{server.server_port}")
    finally:
        server.shutdown()
        server.server_close()
