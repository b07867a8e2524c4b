"""``pointsplat view``: view scenes in the browser."""

from __future__ import annotations

from pathlib import Path

import tyro

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.system.terminal import say


def view(
    scene: tyro.conf.Positional[Path | None] = None,
    other: tyro.conf.Positional[Path | None] = None,
    poses: options.Poses = None,
    up: options.Up = None,
    data: options.Data = None,
    host: str = "127.0.0.1",
    port: int = 7007,
) -> None:
    """View a scene in the browser, or two from the same camera. A slider reduces the number of
    Gaussians, merged as by `prune`. The browser renders with WebGL 2. Ctrl-C ends the viewer.

    Args:
        scene: a file of any format, a checkpoint, or a run (its folder or config.yml); by default
            the page opens a dropped file.
        other: a second scene in the same frame, to compare with; by default all Gaussians of the
            first.
        host: address to listen on; by default only this machine has access. With another address,
            every machine in reach has access.
        port: first port to try; 0 takes any free port.
    """
    options.need_scenes(scene, other)
    import pointsplat_ns as ps

    options.check_poses(poses)
    with ps.open_viewer(
        scene, other, views=poses, up=up, data=data, host=host, port=port
    ) as viewer:
        say(f"{viewer.url}: open it in a browser; Ctrl-C ends it")
        say(
            f"it begins at {viewer.origin}" if viewer.origin else "drop a scene on the page",
            flush=True,
        )
        viewer.wait()
