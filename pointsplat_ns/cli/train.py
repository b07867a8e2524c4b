"""``pointsplat train``: a scene of a given number of Gaussians from posed photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def train(
    capture: tyro.conf.Positional[Path],
    keep: int | None = None,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs"),
    steps: int = 7000,
    scale: float = 1.0,
) -> None:
    """Train a scene from posed photos, with a given number of Gaussians.

    This is `ns-train splatfacto-cpu` with the dataparser that the files of the capture ask for; that command has many
    more options. Ctrl-C ends it after the step at hand and saves it.

    Args:
        capture: folder with transforms.json of ns-process-data, a COLMAP model, dslr of ScanNet++, or traj.txt of
            Replica as NICE-SLAM lays it out.
        keep: number of Gaussians: 50000, 50k; by default as many as Splatfacto makes.
        output: folder for runs. Each is a folder below it, named by capture, method and time.
        steps: number of training steps.
        scale: factor on the width and height of the photos: 0.5 leaves a quarter of the pixels.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.errors import need

    if keep is not None and keep < 1:
        raise ps.BudgetError(f"--keep {keep}: expected a number of Gaussians, at least 1")
    need("nerfstudio", "training a scene")
    from pointsplat_ns.nerfstudio_plugin.captures import train_capture

    run, count = train_capture(capture, keep, output, steps, scale)
    print(f"{run}: a run of {count:,} Gaussians")
