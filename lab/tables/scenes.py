"""The scenes of the tables: what they are, and the views and photos that they are judged by."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.common.compare import dataset_photos
from lab.tables.ways import PROTOCOL
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.scene.discovery import find_runs
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.runs import (
    RUN_FILES,
    Run,
    may_be_run,
    name_of,
    open_run,
    scene_name,
)
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.files import logger


@dataclass(frozen=True)
class Options:
    """What measurements depend on beside the scene. Raises PointSplatError if an option is below
    1."""

    views: int | None = None
    """Largest number of held-out views of a scene; None for all."""
    side: int | None = None
    """Longer side of the images for judging, fine-tuning and scoring, at most, pixels; None for
    full size."""
    scoring_views: int | None = None
    """Largest number of training poses for the scores of LightGaussian and PUP-3DGS; None for
    all."""
    fine_tune: int = 5_000
    """Steps of fine-tuning after each pruning; by default those of both publications."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value is not None and value < 1:
                raise PointSplatError(f"{name.replace('_', ' ')}: {value}; expected at least 1")

    @property
    def words(self) -> list[str]:
        """The options that are not defaults, as words of the command."""
        usual = asdict(Options())
        changed = {name: value for name, value in asdict(self).items() if value != usual[name]}
        return [
            word
            for name, value in changed.items()
            for word in (f"--{name.replace('_', '-')}", str(value))
        ]


ALL = 1 << 30
"""More photos than any dataset has."""

SAMPLED = 10, 60
"""Numbers of sampled views to judge, and to score and fine-tune, a scene without photos."""


@dataclass(frozen=True)
class Pictures:
    """Views, and the photos (H, W, 3) that show the same, if there are some."""

    views: Views
    photos: list[Tensor] | None = None

    def resized(self, side: int | None) -> Pictures:
        """The same with at most ``side`` pixels on the longer side, None for any; photos are
        averaged over the areas of pixels."""
        views = self.views if side is None else self.views.resized(side)
        if self.photos is None or views is self.views:
            return Pictures(views, self.photos)
        size = (views.height, views.width)
        areas = (
            torch.nn.functional.interpolate(photo.permute(2, 0, 1)[None], size, mode="area")
            for photo in self.photos
        )
        return Pictures(views, [photo[0].permute(1, 2, 0) for photo in areas])


@dataclass(frozen=True)
class OpenedScene:
    """The data of a scene."""

    given: Path
    """The path as it was named, such as the folder of an experiment."""
    path: Path
    """The run, or the file."""
    data: Path | None
    """Folder of its photos, if it is no longer where the run says."""
    dense: Gaussians
    held_out: Pictures
    """Views to judge scenes in, with held-out photos where there are some."""
    training: Pictures
    """Views of scores and fine-tuning, with training photos where there are some."""
    origin: str
    """Origin of the views."""
    differs: tuple[str, ...]
    """Differences from the paper's protocol."""


def scenes_at(path: Path) -> dict[str, Path]:
    """Names and paths of the scenes at a path: a run, a file, or a folder above runs, of which the
    newest of each experiment count. A folder of one experiment keeps its path."""
    if path.is_dir() and not (path / RUN_FILES.config).is_file():
        with suppress(SceneError):  # no run below it: a folder that is a scene, or none
            runs = find_runs(path)
            return {scene_name(run): path if len(runs) == 1 else run.folder for run in runs}
    return {name_of(path): path}


def run_or_file(path: Path) -> Path:
    """The newest run at or below a path of :func:`scenes_at`, or the path."""
    if path.is_dir() and not (path / RUN_FILES.config).is_file():
        with suppress(SceneError):
            return find_runs(path)[0].folder
    return path


def open_scene(given: Path, data: Path | None, options: Options) -> OpenedScene:
    """Read a scene, its views, and its photos if there are any. Raises SceneError if no Gaussian
    can be drawn."""
    path = run_or_file(given)
    dense = read_scene(path)
    need_usable(dense)
    if may_be_run(path):
        try:
            whole = Pictures(*dataset_photos(path, "test", options.views or ALL, data))
            held_out = whole.resized(options.side)
            training = Pictures(*dataset_photos(path, "train", ALL, data)).resized(options.side)
            size = held_out.views.width, whole.views.width
            differs = differences(
                open_run(path, data=data), dense.sh_degree, len(held_out.views), size
            )
            origin = "held-out photos"
            return OpenedScene(given, path, data, dense, held_out, training, origin, differs)
        except (SceneError, DataError) as error:
            logger.warning("%s: no photos to compare with: %s", path, error)
    judging, training_views = SAMPLED
    views = ps.sample_views(dense, options.views or judging, seed=1)
    held_out = Pictures(views).resized(options.side)
    training = Pictures(ps.sample_views(dense, training_views)).resized(options.side)
    return OpenedScene(
        given, path, data, dense, held_out, training, "sampled views", ("no held-out photos",)
    )


def differences(run: Run, sh_degree: int, seen: int, widths: tuple[int, int]) -> tuple[str, ...]:
    """Differences of a scene's measurement from the paper's protocol: SH degree 3, 15,000
    Splatfacto steps, judged by all held-out photos in their full size.

    Args:
        run: with its data.
        sh_degree: of the scene.
        seen: number of held-out photos that it is judged by.
        widths: of these, and of the photos as nerfstudio gives them, pixels.
    """
    found = []
    photos = run_photos(run.folder, "test", run.data)
    if seen < len(photos):
        found.append(f"{seen} of {len(photos)} held-out photos")
    scale = run.datamanager_fields.get("camera_res_scale_factor", 1.0)
    scale /= run.dataparser_fields.get("downscale_factor") or 1
    if widths[0] < widths[1]:
        found.append(f"photos reduced to {widths[0]} of {widths[1]} pixels in width")
    elif scale != 1.0:
        found.append(f"photos reduced to {scale:g} of their width")
    if sh_degree != 3:
        found.append(f"SH degree {sh_degree}")
    if run.step + 1 < PROTOCOL.dense_steps:
        found.append(f"{run.step + 1:,} of {PROTOCOL.dense_steps:,} Splatfacto steps")
    if photos[0].mask is not None:
        found.append("masks are not applied")
    return tuple(found)


def paper_dataset(run: Run) -> str:
    """The dataset of the paper that a run, opened with its data, was trained on: "Replica" or
    "ScanNet++"; empty if it is another, or its data is gone."""
    parser = run.dataparser_class.rpartition(".")[2]
    name = run.data.name
    # The scenes of NICE-SLAM's Replica, which the paper follows; neither it nor the released code
    # says which three it tests on.
    if parser == "ReplicaDataParserConfig" and re.fullmatch(r"room[0-2]|office[0-4]", name):
        try:
            scene = load_replica(run.data)
        except DataError:
            return ""
        size = (scene.params.width, scene.params.height)
        # The rooms that this package makes may have the same names, but not this size and number.
        return "Replica" if size == (1200, 680) and len(scene) == 2000 else ""
    # By the dataset's own files, or by the COLMAP model among them, as the paper's authors read it.
    parsers = {
        "SeededScanNetppDataParserConfig",
        "ScanNetppDataParserConfig",
        "ColmapDataParserConfig",
    }
    folders = (run.data, *run.data.parents) if parser == "ColmapDataParserConfig" else (run.data,)
    if parser in parsers and any(
        re.fullmatch(r"[0-9a-f]{10}", folder.name) and (folder / "dslr").is_dir()
        for folder in folders[:4]
    ):
        return "ScanNet++"
    return ""
