"""pointsplat_ns: small, good 3D Gaussian Splatting scenes, with or without a GPU.

>>> import pointsplat_ns as ps
>>> scene = ps.example_room()                  # or ps.load("room.ply"), a checkpoint, a run
>>> small = ps.prune(scene, keep="10%")        # by="merge" is the default
>>> refined = ps.refine(small, ps.load_refiner())
>>> views = ps.sample_views(scene, 12)
>>> image = ps.render(refined, views[0])       # [H, W, 3]
>>> bool(ps.psnr(image, ps.render(scene, views[0])) > 15)
True

The names below are the whole public API. They are imported on first use, so ``import
pointsplat_ns`` costs nothing.
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

# Not imported from typing, which takes longer than the rest of this module.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from pointsplat_ns.api import (
        Compacted,
        clean,
        compact,
        example_room,
        lod,
        plot_views,
        prune,
    )
    from pointsplat_ns.errors import (
        BudgetError,
        DataError,
        MissingPackageError,
        PointSplatError,
        SceneError,
    )
    from pointsplat_ns.metrics import l1_loss, psnr, rmse_loss, ssim
    from pointsplat_ns.metrics.lpips import lpips
    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views, run_photos
    from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner, load_refiner, refine
    from pointsplat_ns.pruning.paper import paper_score, select
    from pointsplat_ns.refinement.config import RefinerConfig, refiner_preset
    from pointsplat_ns.refinement.refiner import Refiner
    from pointsplat_ns.rendering import rasterization, render
    from pointsplat_ns.scene.gaussians import Gaussians
    from pointsplat_ns.scene.reading import save
    from pointsplat_ns.scene.views import View, Views
    from pointsplat_ns.tools.comparison_plots import plot_comparison
    from pointsplat_ns.tools.filming import open_viewer, render_path
    from pointsplat_ns.tools.folder_conversion import convert_folder
    from pointsplat_ns.tools.folders import SceneResult, compact_folder
    from pointsplat_ns.tools.levels.levels import Levels
    from pointsplat_ns.tools.loading import load
    from pointsplat_ns.tools.pages.scene_page import write_page
    from pointsplat_ns.tools.placing import place
    from pointsplat_ns.tools.scene_info import SceneInfo, info
    from pointsplat_ns.tools.tradeoff.measure_table import measure_tradeoff
    from pointsplat_ns.tools.tradeoff.points import Tradeoff
    from pointsplat_ns.view_sampling.sampler import sample_views

_PUBLIC = {
    "pointsplat_ns.api": (
        "Compacted",
        "clean",
        "compact",
        "example_room",
        "lod",
        "plot_views",
        "prune",
    ),
    "pointsplat_ns.tools.levels.levels": ("Levels",),
    "pointsplat_ns.tools.comparison_plots": ("plot_comparison",),
    "pointsplat_ns.tools.loading": ("load",),
    "pointsplat_ns.tools.placing": ("place",),
    "pointsplat_ns.tools.scene_info": ("SceneInfo", "info"),
    "pointsplat_ns.pipeline.trained_refiner": ("TrainedRefiner", "load_refiner", "refine"),
    "pointsplat_ns.tools.pages.scene_page": ("write_page",),
    "pointsplat_ns.view_sampling.sampler": ("sample_views",),
    "pointsplat_ns.errors": (
        "BudgetError",
        "DataError",
        "MissingPackageError",
        "PointSplatError",
        "SceneError",
    ),
    "pointsplat_ns.tools.folder_conversion": ("convert_folder",),
    "pointsplat_ns.tools.folders": ("SceneResult", "compact_folder"),
    "pointsplat_ns.scene.gaussians": ("Gaussians",),
    "pointsplat_ns.scene.reading": ("save",),
    "pointsplat_ns.tools.filming": ("open_viewer", "render_path"),
    "pointsplat_ns.metrics": ("l1_loss", "psnr", "rmse_loss", "ssim"),
    "pointsplat_ns.metrics.lpips": ("lpips",),
    "pointsplat_ns.nerfstudio_plugin.dataset_views": ("dataset_views", "run_photos"),
    "pointsplat_ns.pruning.paper": ("paper_score", "select"),
    "pointsplat_ns.refinement.config": ("RefinerConfig", "refiner_preset"),
    "pointsplat_ns.refinement.refiner": ("Refiner",),
    "pointsplat_ns.tools.tradeoff.measure_table": ("measure_tradeoff",),
    "pointsplat_ns.rendering": ("rasterization", "render"),
    "pointsplat_ns.tools.tradeoff.points": ("Tradeoff",),
    "pointsplat_ns.scene.views": ("View", "Views"),
}
"""Public names by the module that defines them."""

_HOME = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "BudgetError",
    "Compacted",
    "DataError",
    "Gaussians",
    "Levels",
    "MissingPackageError",
    "PointSplatError",
    "Refiner",
    "RefinerConfig",
    "SceneError",
    "SceneInfo",
    "SceneResult",
    "Tradeoff",
    "TrainedRefiner",
    "View",
    "Views",
    "clean",
    "compact",
    "compact_folder",
    "convert_folder",
    "dataset_views",
    "example_room",
    "info",
    "l1_loss",
    "load",
    "load_refiner",
    "lod",
    "lpips",
    "measure_tradeoff",
    "open_viewer",
    "paper_score",
    "place",
    "plot_comparison",
    "plot_views",
    "prune",
    "psnr",
    "rasterization",
    "refine",
    "refiner_preset",
    "render",
    "render_path",
    "rmse_loss",
    "run_photos",
    "sample_views",
    "save",
    "select",
    "ssim",
    "write_page",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
