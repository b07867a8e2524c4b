"""The poses of a run's dataset."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.third_party_warnings import import_nerfstudio
from pointsplat_ns.views import Views


def dataset_views(path: Path | str, split: Literal["train", "test"] = "train") -> Views:
    """The poses of a Splatfacto run's dataset, in the frame and at the resolution that it was trained in.

    Needs nerfstudio, which takes a few seconds to import.

    Args:
        path: the run's folder, ``config.yml`` or checkpoint.
        split: "train" for the poses of the training photos, "test" for those of the held-out photos.

    Returns:
        C views on the CPU, with the background colour that the run is evaluated with.

    Raises:
        SceneError: if ``path`` is not a run, or the run's data is missing.
        DataError: if the poses are not usable, or the split has none.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.dataset_views("outputs/kitchen/splatfacto/2026-01-01_120000", "test")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.SceneError: outputs/kitchen/splatfacto/2026-01-01_120000: no such file or folder; \
expected a nerfstudio run
    """
    from pointsplat_ns.io.runs import open_run, scene_name

    run = open_run(path)  # before nerfstudio is imported, which takes seconds
    import_nerfstudio()

    from pointsplat_ns.nerfstudio_plugin.cameras import views_of_cameras
    from pointsplat_ns.nerfstudio_plugin.memory_cache import MemoryCache
    from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene

    scene = TrainedScene(scene_name(run), run, MemoryCache(0))
    frames = scene.train_frames if split == "train" else scene.eval_frames
    cameras = frames.dataset.cameras
    if len(cameras) == 0:
        raise DataError(f"{run.data}: no pose in the {split} split; expected at least one")
    try:
        views = views_of_cameras(cameras, scene.background, scene.rasterize_mode)
    except DataError as error:
        raise DataError(f"{run.data}: {error}") from error
    return dataclasses.replace(views, viewmats=views.viewmats.detach().cpu(), Ks=views.Ks.detach().cpu())
