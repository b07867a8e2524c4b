"""The viewer: viser's page, with pictures by this package's rasterizer."""

from __future__ import annotations

import logging
import math
import shlex
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.geometry.quaternions import rotation_matrices
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.settings import DEFAULTS
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.rasterizer import render_depth
from pointsplat_ns.system.memory import share_freed_memory
from pointsplat_ns.viewing.painter import Camera, Painter, PictureRequest
from pointsplat_ns.viewing.schedule import Step
from pointsplat_ns.viewing.selection import ReducedScene, Selection
from pointsplat_ns.viewing.server import start_server
from pointsplat_ns.viewing.trajectories import up_of
from pointsplat_ns.views import RasterizeMode, View, Views


@dataclass(frozen=True, eq=False)
class ViewedScene:
    """A scene for the viewer."""

    name: str
    path: Path | None
    """Path of the scene; None if it was given as Gaussians."""
    scene: Gaussians
    source: ViewSource
    """Source of views."""
    mode: RasterizeMode
    """Rasterize mode of its training."""


class Viewer:
    """Shows one or two scenes in the browser, until it is closed; also the context of a ``with`` block.

    Args:
        scenes: one or two scenes, both in the same frame.
        host: the address to listen on.
        port: the first port to try; 0 takes any free port.
        up: (3,) up direction of length 1; by default from the views of the first scene.

    Raises:
        DataError: if there are no views.
        PointSplatError: if no port is free.
    """

    def __init__(self, scenes: Sequence[ViewedScene], host: str, port: int, up: Tensor | None = None):
        share_freed_memory()  # each page has a drawing thread
        first = scenes[0]
        self._scenes = scenes
        self._starts = first.source.views(12)
        self.origin = first.source.origin
        """Text on the origin of the first view."""
        self._up = up_of(self._starts) if up is None else up
        self._small = thinned(first.scene, DEFAULTS.probe_count)
        self._painters: dict[int, Painter] = {}
        self._notes: dict[int, Any] = {}
        self._at = 0
        self._closed = False
        # websockets logs a traceback for each page that is closed before it has loaded.
        logging.getLogger("websockets").setLevel(logging.CRITICAL + 1)
        self._server = start_server(host, port, "pointsplat")
        self._selections: list[Selection] = []
        for viewed in scenes:
            self._selections.append(Selection(viewed.scene, viewed.source, self._changed))
        self._build()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self._server.get_host()
        host = "127.0.0.1" if host in ("", "0.0.0.0") else host
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    def wait(self) -> None:
        """Wait until Ctrl-C."""
        threading.Event().wait()

    def close(self) -> None:
        """End the server and all drawing. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        for painter in list(self._painters.values()):
            painter.close()
        for selection in self._selections:
            selection.close()
        self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _build(self) -> None:
        """The panel beside the picture."""
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False)  # viser 0.2.7 needs its share button to work
        self._server.scene.set_up_direction(self._up.numpy())
        self._budgets = []
        for viewed, selection in zip(self._scenes, self._selections, strict=True):
            gui.add_markdown(f"**{_code(viewed.name)}**")
            slider = gui.add_slider("Kept, %", 1, 100, 1, 100, hint="share of this scene's Gaussians")
            slider.on_update(_chooser(selection))
            self._budgets.append(gui.add_markdown(""))
        two = len(self._scenes) == 2
        hint = "left of the line the first scene" if two else "left of the line the kept Gaussians, right of it all"
        self._line = gui.add_slider("Wipe, %", 0, 100, 1, 50 if two else 100, hint=hint)
        self._line.on_update(lambda _: self._redraw())
        self._side = gui.add_slider("Pixels", 240, 1920, 80, 960, hint="longer side of the picture at rest")
        self._side.on_update(lambda _: self._redraw())
        gui.add_button("Next view").on_click(lambda event: self._next(event.client))
        gui.add_button("This view, level").on_click(lambda event: self._put(event.client))
        gui.add_button("Turn over", hint="if the scene is upside down").on_click(lambda event: self._turn(event.client))
        self._describe()

    def _describe(self) -> None:
        """Write text on the current part of each scene, with the command that makes it."""
        for viewed, selection, note in zip(self._scenes, self._selections, self._budgets, strict=True):
            current, whole = selection.current, len(selection.scene)
            lines = [f"{len(current.scene):,} of {whole:,} Gaussians, {current.how}"]
            if selection.status:
                lines.append(selection.status)
            elif viewed.path is not None and selection.percent < 100:
                command = ["pointsplat", "prune", str(viewed.path), "--keep", f"{selection.percent}%"]
                lines.append(_code(shlex.join(command)))
            note.content = "  \n".join(lines)

    def _changed(self, picture: bool) -> None:
        """Handle a new scene or status of a selection. A new status alone must not restart pictures."""
        self._describe()
        if picture:
            self._redraw()

    def _redraw(self) -> None:
        for client in self._server.get_clients().values():
            self._look(client)

    def _connected(self, client: Any) -> None:
        self._notes[client.client_id] = client.gui.add_markdown("drawing")

        def show(pixels: np.ndarray, step: Step[PictureRequest], seconds: float) -> None:
            preview = step.moving and not step.whole
            client.scene.set_background_image(pixels, format="jpeg", jpeg_quality=75 if preview else 95)
            size = f"{pixels.shape[1]} x {pixels.shape[0]}"
            share = "" if step.share == 1 else f", {step.share:.0%} of the Gaussians"
            state = "moving: " if preview else ""
            note = self._notes.get(client.client_id)
            if note is not None:  # the page is still open
                note.content = f"{state}{size}, {1000 * seconds:.0f} ms a frame{share}"

        self._painters[client.client_id] = Painter(show)
        self._put(client)
        client.camera.on_update(lambda _: self._look(client))
        self._look(client)

    def _disconnected(self, client: Any) -> None:
        painter = self._painters.pop(client.client_id, None)
        self._notes.pop(client.client_id, None)
        if painter is not None:
            painter.schedule.close()  # without waiting, because this is the server's thread
        later = threading.Timer(1.0, self._forget_gone)  # s until its socket is closed
        later.daemon = True
        later.start()

    def _forget_gone(self) -> None:
        """Send text to all pages: viser 0.2.7 keeps a closed page and its socket until sending fails."""
        with suppress(RuntimeError):  # the server may end meanwhile
            if not self._closed:
                self._describe()

    def _look(self, client: Any) -> None:
        """Request the picture of a client's camera."""
        painter = self._painters.get(client.client_id)
        if painter is None:
            return
        start, camera = self._starts[self._at], client.camera
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation_matrices(torch.tensor(np.asarray(camera.wxyz, np.float64))[None])[0]
        pose[:3, 3] = torch.tensor(np.asarray(camera.position, np.float64))
        drawn = Camera(
            invert_rigid(pose[None])[0], float(camera.fov), float(camera.aspect), start.background, start.near_plane
        )
        first = self._selections[0]
        second: ReducedScene | None = self._selections[1].current if len(self._selections) == 2 else first.whole
        modes = self._scenes[0].mode, self._scenes[-1].mode
        request = PictureRequest(drawn, first.current, second, self._line.value / 100, modes)
        painter.schedule.submit(request, int(self._side.value))

    def _next(self, client: Any) -> None:
        self._at = (self._at + 1) % len(self._starts)
        self._put(client)

    def _turn(self, client: Any) -> None:
        self._up = -self._up
        self._server.scene.set_up_direction(self._up.numpy())
        self._put(client)

    def _put(self, client: Any) -> None:
        """Move a client's camera to the current view, upright."""
        view = self._starts[self._at]
        place, ahead = self._pose(view)
        with client.atomic():
            client.camera.fov = 2 * math.atan(0.5 * view.height / float(view.K[1, 1]))
            client.camera.up_direction = self._up.numpy()
            client.camera.position = place.numpy()
            client.camera.look_at = (place + ahead).numpy()

    def _pose(self, view: View) -> tuple[Tensor, Tensor]:
        """The position (3,) of a view, and the vector (3,) to the centre of its content, about which the camera
        turns."""
        pose = invert_rigid(view.viewmat[None].double())[0]
        one = Views(view.viewmat[None], view.K[None], view.width, view.height, view.background).resized(48)[0]
        depth, alpha = render_depth(self._small, one)
        covered = depth[alpha > 0.5]
        distance = float(covered.median()) if len(covered) else 1.0
        return pose[:3, 3], pose[:3, 2] * max(distance, 10 * view.near_plane)


def _chooser(selection: Selection) -> Callable[[Any], None]:
    """Callback of a budget's slider."""

    def choose(event: Any) -> None:
        selection.choose(event.target.value)

    return choose


def _code(text: str) -> str:
    """A text as Markdown code: the page would run text in braces."""
    return "`" + "".join(sign if sign.isprintable() and sign != "`" else "?" for sign in text) + "`"
