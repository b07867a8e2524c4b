"""The viewer: a page in the browser, with pictures by this package's rasterizer."""

from __future__ import annotations

import json
import math
import shlex
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pages.html import page
from pointsplat_ns.system.memory import share_freed_memory
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.viewing.painter import PictureRequest, ViewerCamera, Watcher
from pointsplat_ns.viewing.selection import Selection
from pointsplat_ns.viewing.server import READABLE_NAMES, Answer, Request, Route, Served, Server, received


@dataclass(frozen=True)
class ViewerSettings:
    """Limits of the viewer."""

    most_pages: int = 8
    """Largest number of open pages; the one that was heard of least recently gives way."""
    wait_seconds: float = 20.0
    """Longest wait of a page's request for the next picture."""
    end_seconds: float = 5.0
    """Longest wait for each thing that is being drawn, merged or read when the viewer is closed."""
    largest_side: int = 4096
    """Largest longer side of a picture, pixels."""
    largest_file: int = 4_000_000_000
    """Largest file that may be dropped, bytes."""


VIEWER = ViewerSettings()


@dataclass(frozen=True, eq=False)
class ViewedScene:
    """A scene for the viewer."""

    name: str
    path: Path | None
    """Path of the scene; None if it has none."""
    scene: Gaussians
    source: ViewSource
    """Source of views."""
    levels: Sequence[Gaussians] = ()
    """Smaller scenes that are there already, as of :class:`Selection`."""


class _Stage:
    """The scenes that are shown, from where, and at which budgets."""

    def __init__(
        self, scenes: Sequence[ViewedScene], up: Up | None, number: int, changed: Callable[[], None], drops: bool
    ):
        self.scenes, self.number = scenes, number
        self.made = 0
        """Number of times that another part of a scene was chosen or made, which pages then ask to see."""
        first = scenes[0]
        known = first.source.known(VIEW_COUNTS.opening)
        self.frame = FlightFrame.of(first.scene, known, first.source.up if up is None and known is None else up)
        found = f"the view that shows most, up is {self.frame.up}{first.source.missing}"
        self.origin = found if known is None else first.source.origin
        self._tell = changed
        self.selections = [
            Selection(viewed.scene, viewed.source, self._changed, levels=viewed.levels) for viewed in scenes
        ]
        pair = [{"name": viewed.name, "amount": ""} for viewed in scenes]
        if len(scenes) == 1:
            pair.append({"name": "all of it", "amount": ""})
        data = {**self.frame.data(pair), "stage": number, "kept": [100] * len(scenes)}
        title, scripts = " and ".join(viewed.name for viewed in scenes), ("camera.js", "flight.js", "view.js")
        html = page("view.html", scripts, connects=True, title=title, flight=data, drops=drops, data={"flight": data})
        self.html = html.encode("utf-8")

    def _changed(self, picture: bool) -> None:
        self.made += picture
        self._tell()

    def request(self, wanted: dict[str, Any]) -> tuple[PictureRequest, int]:
        """What a page asked for, and the longer side of the picture, pixels. Errors are those of Python if it is not
        what the page of this server sends."""
        camera, views = wanted["camera"], self.frame.views
        width, height = (min(max(int(wanted[name]), 1), VIEWER.largest_side) for name in ("width", "height"))
        eye, right, down, ahead = (_vector(camera[name]) for name in ("eye", "right", "down", "ahead"))
        turn = torch.stack([right, down, ahead])
        if not bool(((turn @ turn.T - torch.eye(3, **DOUBLES)).abs() < 1e-3).all()):
            raise ValueError("no rotation")
        place = eye * (self.frame.size / UNITS) + self.frame.centre
        viewmat = torch.eye(4, **DOUBLES)
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ place
        share = math.tan(0.5 * min(max(float(camera["fov"]), 0.01), 3.1)) * height / max(width, height)
        near = views.near_plane * self.frame.size / UNITS
        drawn = ViewerCamera(viewmat, 2 * math.atan(share), width / height, views.background, near)
        kept = wanted["kept"]
        for selection, percent in zip(self.selections, kept, strict=True):
            if int(percent) != selection.percent:
                selection.choose(int(percent))
        first = self.selections[0]
        two = len(self.selections) == 2
        second = self.selections[1].current if two else first.whole
        wipe = min(max(float(wanted["wipe"]), 0.0), 1.0)
        line = wipe if two or first.percent < 100 else 1.0
        return PictureRequest(drawn, first.current, second, line), max(width, height)

    def texts(self) -> list[dict[str, str]]:
        """Text on the current part of each scene, with the command that makes it."""
        found = []
        for viewed, selection in zip(self.scenes, self.selections, strict=True):
            current, whole = selection.current, len(selection.scene)
            amount = f"{whole:,} Gaussians"
            if selection.percent < 100:
                amount = f"{len(current.scene):,} of {whole:,} Gaussians, {selection.status or current.how}"
            command = ""
            if viewed.path is not None and selection.percent < 100:
                command = shlex.join(["pointsplat", "prune", str(viewed.path), "--keep", f"{selection.percent}%"])
            found.append({"amount": amount, "command": command})
        return found

    def close(self, timeout: float) -> None:
        """Stop merging, and wait for it at most ``timeout`` seconds."""
        for selection in self.selections:
            selection.close(timeout)


class Viewer(Served):
    """Shows one or two scenes, both in the same frame, in the browser, until it is closed; also the context of a
    ``with`` block.

    Without scenes, a page takes a dropped file, which ``read`` reads with its name. ``port`` is the first to try; 0
    takes any free port. By default up is that of the first scene's known views, or estimated. Raises SceneError if no
    Gaussian of a scene can be drawn, DataError if none of the first scene is visible, and PointSplatError if no port is
    free.
    """

    def __init__(
        self,
        scenes: Sequence[ViewedScene],
        host: str,
        port: int,
        up: Up | None = None,
        read: Callable[[Path, str], ViewedScene] | None = None,
    ):
        share_freed_memory()  # each page has a drawing thread
        self._up, self._read = up, read
        self._watchers: dict[str, Watcher] = {}
        self._lock, self._looking, self._dropping = threading.Lock(), threading.Lock(), threading.Lock()
        self._stage: _Stage | None = None
        self._drop_page = b""
        routes = {
            "/": Route(self._page),
            "/look": Route(self._look, 65_536),
            "/picture": Route(self._picture, 1_024),
        }
        if read is not None:
            self._drop_page = page("drop.html", ("drop.js",), connects=True, suffixes=READABLE_NAMES).encode("utf-8")
            routes |= {
                "/drop": Route(self._drop, VIEWER.largest_file),
                "/other": Route(lambda _: _html(self._drop_page)),
            }
        if scenes:
            self._show(scenes)
        self._server = Server(host, port, routes)
        self.url = self._server.url

    @property
    def origin(self) -> str:
        """Text on the origin of the first view; empty without a scene."""
        return "" if self._stage is None else self._stage.origin

    def close(self) -> None:
        """End the server and all drawing. A second call does nothing."""
        if self._server.fileno() < 0:
            return
        self._server.close()
        # Threads that are in torch when the program ends abort it: they are waited for, and these locks are kept.
        for lock in (self._looking, self._dropping):
            lock.acquire(timeout=VIEWER.end_seconds)
        for watcher in list(self._watchers.values()):
            watcher.close(VIEWER.end_seconds)
        if self._stage is not None:
            self._stage.close(VIEWER.end_seconds)

    def _show(self, scenes: Sequence[ViewedScene]) -> None:
        number = 1 if self._stage is None else self._stage.number + 1
        stage = _Stage(scenes, self._up, number, self._changed, self._read is not None)
        with self._lock:
            before, self._stage = self._stage, stage
        if before is not None:
            before.close(0.0)

    def _changed(self) -> None:
        """Tell pages that a selection has a new text, or another part of its scene."""
        with self._lock:
            for watcher in self._watchers.values():
                watcher.tell()

    def _page(self, request: Request) -> Answer:
        return _html(self._drop_page if self._stage is None else self._stage.html)

    def _look(self, request: Request) -> Answer:
        """Take the camera, window and budgets of a page."""
        wanted = json.loads(request.body.read(request.length))
        stage = self._stage
        if stage is None or wanted["stage"] != stage.number:
            return Answer(status=HTTPStatus.CONFLICT)
        with self._looking:
            watcher = self._watcher(str(wanted["client"]))
            watcher.look(*stage.request(wanted), int(wanted["look"]))
        return Answer(status=HTTPStatus.NO_CONTENT)

    def _picture(self, request: Request) -> Answer:
        """Wait for the next picture, or the next text."""
        wanted = json.loads(request.body.read(request.length))
        stage = self._stage
        if stage is None or wanted["stage"] != stage.number:
            return Answer(status=HTTPStatus.CONFLICT)
        watcher = self._watcher(str(wanted["client"]))
        number = int(wanted["number"])
        shown, texts = watcher.next(number, int(wanted["texts"]), VIEWER.wait_seconds)
        state = {
            "number": shown.number,
            "look": shown.look,
            "texts": texts,
            "made": stage.made,
            "scenes": stage.texts(),
        }
        headers = {"X-State": json.dumps(state)}
        if shown.number == number:
            return Answer(status=HTTPStatus.NO_CONTENT, headers=headers)
        return Answer(shown.jpeg, "image/jpeg", headers=headers)

    def _watcher(self, client: str) -> Watcher:
        """What draws for a page, by the page's own name."""
        if not 16 <= len(client) <= 64:
            raise ValueError("no name of a page")
        with self._lock:
            if client not in self._watchers:
                while len(self._watchers) >= VIEWER.most_pages:
                    oldest = min(self._watchers, key=lambda name: self._watchers[name].seen)
                    self._watchers.pop(oldest).close()
                self._watchers[client] = Watcher()
            watcher = self._watchers[client]
            watcher.seen = time.monotonic()
            return watcher

    def _drop(self, request: Request) -> Answer:
        """Take a dropped file, and show its scene."""
        assert self._read is not None
        with self._dropping, tempfile.TemporaryDirectory(prefix="pointsplat-drop-") as folder:
            try:
                path, name = received(request, Path(folder))
                try:
                    self._show([self._read(path, name)])
                except PointSplatError as error:
                    return _refused(str(error).replace(str(path), name))
            except PointSplatError as error:
                return _refused(str(error))
            except (OSError, MemoryError) as error:
                return _refused(f"the file cannot be read here ({one_line(error)})")
        return Answer(status=HTTPStatus.NO_CONTENT)


def _html(page: bytes) -> Answer:
    return Answer(page, "text/html; charset=utf-8")


def _refused(text: str) -> Answer:
    return Answer(text.encode("utf-8", "replace"), status=HTTPStatus.UNPROCESSABLE_ENTITY)


def _vector(values: Any) -> torch.Tensor:
    """A vector (3,) of finite numbers, float64."""
    vector = torch.tensor([float(value) for value in values], **DOUBLES)
    if vector.shape != (3,) or not bool(vector.isfinite().all()):
        raise ValueError("no vector")
    return vector
