"""``pointsplat demo``: write an example scene."""

from __future__ import annotations

from pathlib import Path

from pointsplat_ns.cli import scene_options as options
from pointsplat_ns.cli.printing import written_size
from pointsplat_ns.system.terminal import say


def demo(output: options.Output = None, force: options.Force = False) -> None:
    """Write the example scene, a furnished room.

    Args:
        output: file to write, of any format as for prune; by default room.ply in the current
            folder.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.system.outputs import unnamed

    path = output or unnamed(Path("room.ply"))
    scene = ps.example_room()
    options.check_outputs(path, force)
    ps.save(scene, path, overwrite=True)
    say(f"{path}: {len(scene):,} Gaussians, {written_size(path)}")
