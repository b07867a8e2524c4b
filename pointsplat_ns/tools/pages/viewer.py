"""The viewer: a page that draws a scene in the browser, and a server for other shares of it."""

from __future__ import annotations

import json
import shlex
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from http import HTTPStatus
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.scene.formats import FORMATS
from pointsplat_ns.system.files import one_line
from pointsplat_ns.system.memory import share_freed_memory
from pointsplat_ns.tools.pages.flight import FLIGHT_SCRIPTS, FlightFrame
from pointsplat_ns.tools.pages.html import page
from pointsplat_ns.tools.pages.server import Answer, Request, Route, Server
from pointsplat_ns.tools.pages.slider_scenes import Level, ViewedScene
from pointsplat_ns.tools.wording import file_state_text, missing_text, origin_text
from pointsplat_ns.view_sampling.upright import Up

READABLE_NAMES = (
    *(kind.suffix for kind in FORMATS if kind.read and kind.suffix.startswith(".")),
    ".pt",
)
"""Suffixes of files that may be dropped."""

LARGEST_FILE = 4_000_000_000
"""Maximum size of a dropped file, bytes."""


class _Stage:
    """The shown scenes and their common views."""

    def __init__(self, scenes: Sequence[ViewedScene], up: Up | None, number: int, drops: bool):
        self.scenes = scenes
        self.number = number
        first = scenes[0]
        known = first.source.known(VIEW_COUNTS.opening)
        self.frame = FlightFrame.of(
            first.scene, known, first.source.sampler.up if up is None and known is None else up
        )
        found = (
            f"the view that shows most, up is {self.frame.up}{missing_text(first.source.missing)}"
        )
        self.origin = found if known is None else origin_text(first.source.origin)
        shown = [{"name": viewed.name, "amount": ""} for viewed in scenes]
        if len(scenes) == 1:
            shown.append({"name": "all of it", "amount": ""})
        data = {**self.frame.data(shown), "stage": number, "kept": [100] * len(scenes)}
        self.html = _live_page(" and ".join(viewed.name for viewed in scenes), data, drops)

    def state(self, index: int, percent: int, level: Level, whole: bool) -> dict[str, Any]:
        """Text of the page on a level, with the command that makes it; ``whole`` if the level is
        final."""
        viewed = self.scenes[index]
        command = ""
        amount = f"{len(viewed.scene):,} Gaussians"
        if percent < 100:
            amount = f"{len(level.scene):,} of {amount}, {level.how}" + (
                "" if whole else ", merging ..."
            )
            if viewed.path is not None:
                command = shlex.join(
                    ["pointsplat", "prune", str(viewed.path), "--keep", f"{percent}%"]
                )
        return {"amount": amount, "command": command, "how": level.how, "whole": whole}

    def notes(self) -> list[str]:
        """Notes on files of the scenes that have changed, or are gone, since they were read."""
        states = [(viewed.name, viewed.file.state()) for viewed in self.scenes if viewed.file]
        return [*filter(None, (file_state_text(name, state) for name, state in states))]

    def close(self, timeout: float) -> None:
        """Stop merging, and wait for at most ``timeout`` seconds."""
        for viewed in self.scenes:
            viewed.close(timeout)


class Viewer(AbstractContextManager["Viewer"]):
    """Shows one or two scenes of the same frame in the browser, until it is closed; usable in a
    ``with`` block.

    Without scenes, the page opens a dropped file with ``read``, from its path and name. ``port`` is
    the first port to try; 0 takes any free port. By default, up comes from the first scene's known
    views, or is estimated. Raises SceneError if no Gaussian of a scene can be drawn, DataError if
    none of the first scene is visible, and PointSplatError if no port is free.
    """

    def __init__(
        self,
        scenes: Sequence[ViewedScene],
        host: str,
        port: int,
        up: Up | None = None,
        read: Callable[[Path, str], ViewedScene] | None = None,
    ):
        share_freed_memory()  # every request has its own thread
        self._up = up
        self._read = read
        self._working = threading.Lock()
        self._dropping = threading.Lock()
        self._stage: _Stage | None = None
        routes = {
            "/": Route(self._page),
            "/scene": Route(self._scene, 1_024),
            "/watch": Route(self._watch),
        }
        if read is not None:
            routes["/drop"] = Route(self._drop, LARGEST_FILE)
        if scenes:
            self._show(scenes)
        self._server = Server(host, port, routes)
        self.url = self._server.url
        """Address of the page."""

    @property
    def origin(self) -> str:
        """Text on the origin of the first view; empty without scenes."""
        return "" if self._stage is None else self._stage.origin

    def wait(self) -> None:
        """Wait until Ctrl-C."""
        while True:  # this thread handles signals of other threads when it wakes
            time.sleep(0.5)

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the server and all work. A second call does nothing."""
        if self._server.fileno() < 0:
            return
        self._server.shutdown()
        self._server.server_close()
        # A thread inside torch at exit would abort the program. So wait for it, and never release
        # these locks.
        for lock in (self._working, self._dropping):
            lock.acquire(timeout=5.0)  # s
        if self._stage is not None:
            self._stage.close(5.0)

    def _show(self, scenes: Sequence[ViewedScene]) -> None:
        number = 1 if self._stage is None else self._stage.number + 1
        before = self._stage
        self._stage = _Stage(scenes, self._up, number, self._read is not None)
        if before is not None:
            before.close(0.0)

    def _page(self, request: Request) -> Answer:
        html = _live_page("Open a scene", None, True) if self._stage is None else self._stage.html
        return Answer(html, "text/html; charset=utf-8")

    def _scene(self, request: Request) -> Answer:
        """A scene at a share, as SPZ unless the page has it already. A page with a preliminary
        level waits for the final one. A page of earlier scenes is told to reload."""
        wanted = json.loads(request.body.read(request.length))
        stage = self._stage
        if stage is None or wanted["stage"] != stage.number:
            return Answer(status=HTTPStatus.CONFLICT)
        index = int(wanted["scene"])
        percent = round(wanted["percent"])
        have = str(wanted["have"])
        percent = min(max(percent, 1), 100)
        viewed = dict(enumerate(stage.scenes))[index]
        if not have:
            viewed.stop()
        level = (viewed.merged(percent) if have else None) or viewed.at(percent)
        whole = viewed.ready(percent) is level
        headers = {"X-State": json.dumps(stage.state(index, percent, level, whole))}
        if level.how == have or not wanted["spz"]:
            return Answer(status=HTTPStatus.NO_CONTENT, headers=headers)
        with self._working:
            # Level 1 of gzip takes half the time of 6, for 5 % more bytes, mostly on the same
            # machine.
            level.spz = level.spz or stage.frame.encoded(level.scene, viewed.name, level=1)
        return Answer(level.spz, "application/octet-stream", headers=headers)

    def _watch(self, request: Request) -> Answer:
        """The number of the stage, and notes on files of its scenes that are not as they were
        read."""
        stage = self._stage
        notes = [] if stage is None else stage.notes()
        content = {"stage": 0 if stage is None else stage.number, "notes": notes}
        return Answer(json.dumps(content).encode(), "application/json")

    def _drop(self, request: Request) -> Answer:
        """Show the scene of a dropped file. The client's file name is only displayed, never used as
        a path; only its suffix counts, if it is one of :data:`READABLE_NAMES`."""
        assert self._read is not None
        given = request.options["name"]
        name = "".join(
            sign if sign.isprintable() else "?"
            for sign in given.replace("\\", "/").rpartition("/")[2]
        )[:80]
        suffix = next((suffix for suffix in READABLE_NAMES if given.lower().endswith(suffix)), "")
        with self._dropping, tempfile.TemporaryDirectory(prefix="pointsplat-drop-") as folder:
            path = Path(folder) / f"scene{suffix}"
            try:
                _receive(request, path, suffix)
                self._show([self._read(path, name)])
                return Answer(status=HTTPStatus.NO_CONTENT)
            except PointSplatError as error:
                refused = str(error).replace(str(path), name)
            except (OSError, MemoryError) as error:
                refused = f"the file cannot be read here ({one_line(error)})"
        return Answer(refused.encode("utf-8", "replace"), status=HTTPStatus.UNPROCESSABLE_ENTITY)


def _live_page(title: str, flight: dict[str, Any] | None, drops: bool) -> bytes:
    """The page, which loads scenes from this server; without a flight it only accepts a file."""
    scripts = (
        *((*FLIGHT_SCRIPTS, "live.js", "scene.js") if flight else ()),
        *(("drop.js",) if drops else ()),
    )
    return page(
        "scene.html",
        scripts,
        ("worker-src blob:", "connect-src 'self'"),
        title=title,
        flight=flight,
        live=True,
        drops=READABLE_NAMES if drops else (),
        notes=(),
        missing="",
    )


def _receive(request: Request, path: Path, suffix: str) -> None:
    """Write the body of a request to a file. Raises SceneError if the suffix is not of a scene, the
    file is empty, or there is no room for it, and ValueError if the client sends less than
    declared."""
    if not suffix:
        raise SceneError(f"{path}: not a scene; expected a file of {', '.join(READABLE_NAMES)}")
    if request.length == 0:
        raise SceneError(f"{path}: an empty file; expected a scene")
    if shutil.disk_usage(path.parent).free < 1.1 * request.length:
        raise SceneError(f"{path}: {request.length / 1e6:.0f} MB; the disk here has less room")
    left = request.length
    with path.open("wb") as stream:
        while left:
            data = request.body.read(min(1 << 20, left))
            if not data:
                raise ValueError("the body is cut off")
            stream.write(data)
            left -= len(data)
