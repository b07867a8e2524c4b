"""``pointsplat demo``: a scene to try commands with."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import written_size
from pointsplat_ns.system.terminal import say


def demo(output: options.Output = None, force: options.Force = False) -> None:
    """Write the scene that ships, a furnished room.

    Args:
        output: the file to write, of any format as for prune; by default room.ply in this folder.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.system.outputs import unnamed

    path = output or unnamed(Path("room.ply"))
    scene = ps.example_room()
    options.check_outputs(path, force)
    ps.save(scene, path, overwrite=True)
    say(f"{path}: {len(scene):,} Gaussians, {written_size(path)}")
