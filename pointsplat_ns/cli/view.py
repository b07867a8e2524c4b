"""``pointsplat view``: scenes in the browser."""

from __future__ import annotations

from pathlib import Path

import tyro

from pointsplat_ns.cli.scene_options import Data, Poses, check_poses


def view(
    scene: tyro.conf.Positional[Path | None] = None,
    other: tyro.conf.Positional[Path | None] = None,
    poses: Poses = None,
    up: str | None = None,
    data: Data = None,
    host: str = "127.0.0.1",
    port: int = 7007,
) -> None:
    """Look at a scene in the browser, or at two from the same camera. A slider keeps less of the Gaussians, merged as
    `prune` does. The browser draws; one without WebGL 2 shows pictures that this machine's processor draws. Ctrl-C ends
    it.

    Args:
        scene: a file of any format, a checkpoint, or a run (its folder or config.yml); by default the page
            takes a file that is dropped on it.
        other: a second scene in the same frame, to compare with; by default the first is compared with all of itself.
        poses: a file of cameras of the first scene, to open with. By default one that lies beside the scene or above
            it, or the poses of a run's dataset; none samples views instead.
        up: the axis that is up in the scene: x, y, z, -x, -y or -z; by default the file's own, or an estimate. Write
            --up=-y for a negative axis.
        data: folder of the first scene's photos and poses, or one above it, if it is no longer where the run says.
        host: the address to listen on; by default only this machine has access. With another address, every machine
            that reaches it has access.
        port: the first port to try; 0 takes any free port.
    """
    import pointsplat_ns as ps

    check_poses(poses)
    with ps.open_viewer(scene, other, views=poses, up=up, data=data, host=host, port=port) as viewer:
        print(f"{viewer.url}: open it in a browser; Ctrl-C ends it")
        print(f"it begins at {viewer.origin}" if viewer.origin else "drop a scene on the page", flush=True)
        viewer.wait()
