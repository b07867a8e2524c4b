"""Measures the paper's tables on any scenes."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Sequence
from pathlib import Path

from lab.tables.cells import TABLE_FILES
from lab.tables.making import Refiners, Tools
from lab.tables.means import Group
from lab.tables.measuring import Measuring
from lab.tables.outputs import write_tables
from lab.tables.scene import OpenedScene, TableOptions, TableScene
from lab.tables.ways import PROTOCOL
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import logger
from pointsplat_ns.io.runs import Run, may_be_run, name_of, open_run
from pointsplat_ns.io.scene import read_scene
from pointsplat_ns.io.source import source_file
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_photos, dataset_views, has_masks
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.tradeoff.journal import check_journal_folder
from pointsplat_ns.tradeoff.judging import JudgedViews


def measure_tables(
    scenes: Sequence[str | Path],
    folder: str | Path,
    *,
    keeps: Sequence[float] = PROTOCOL.shares,
    refiners: Sequence[str | Path] = (),
    groups: Sequence[str] = (),
    only: Sequence[str] = (),
    views: int = 10,
    side: int = 640,
    scoring_views: int = 40,
    fine_tune: int = 300,
    splat_transform: str | None = None,
    data: str | Path | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[Group]:
    """Measure the paper's Tables 1 to 4 and Figure 4 on any scenes, with our methods and splat-transform beside.

    Each cell, one scene made smaller in one way, is saved as soon as it is measured: the same call goes on after an
    interruption. The tables are of all scenes in the folder, also those of earlier calls. Rows whose weights or program
    are not at hand say so.

    Args:
        scenes: Splatfacto runs, whose held-out photos are then used where they are found; or files of scenes.
        folder: where cells and tables go.
        keeps: shares of the Gaussians in Tables 1 and 2.
        refiners: weights for the rows with a network, as for :func:`~pointsplat_ns.load_refiner`; each row takes those
            whose metadata name its network and pruning.
        groups: NAME=SCENE,SCENE...; means are taken over groups. By default scenes of Replica and of ScanNet++ are a
            group each, and the others are "scenes".
        only: names or patterns of cells, such as ``fox/merge/10%``, to measure again, and no others.
        views: largest number of held-out views of a scene.
        side: largest side of all images, pixels; photos are reduced.
        scoring_views: largest number of training poses that LightGaussian and PUP-3DGS score from.
        fine_tune: steps of fine-tuning, against at most 60 training photos.
        splat_transform: the program; by default the one on PATH, if any.
        data: folder above the data of the runs, or that of one, where it is no longer where the runs say. A run whose
            data is not found is measured without photos, which is logged.
        force: start over.
        progress: True shows a bar; a function is called with what is being done and the share done of it.

    Returns:
        The scenes of the folder in groups, with all cells.

    Raises:
        SceneError: if a scene or the folder is not usable, or the folder holds cells of other scenes, views or another
            machine.
        DataError: if there is no view.
        WeightsError: if weights are none.
        PointSplatError: if two scenes have the same name, nothing matches ``only``, or a number means nothing.
        KeyboardInterrupt: after the tables of what was measured were written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::200][:300], f"{folder}/room.ply")
        ...     [group] = measure_tables(
        ...         [f"{folder}/room.ply"], f"{folder}/tables", only=["room/paper/10%"], views=2, side=64
        ...     )
        >>> group.name, group.mean("paper", 0.1, frozenset({"room"})).gaussians
        ('scenes', 30.0)
    """
    folder = Path(folder)
    options = TableOptions(views, side, scoring_views, fine_tune)
    shares = tuple(dict.fromkeys(keeps))
    if not all(0 < share < 1 for share in shares):
        raise PointSplatError(f"keeps are {', '.join(f'{share:g}' for share in shares)}; expected shares such as 0.1")
    if not scenes:
        raise PointSplatError("no scene is named; expected Splatfacto runs, or files of scenes")
    opened = [_table_scene(Path(path), data) for path in scenes]
    opened = _grouped(opened, groups)
    journals = [folder / scene.name / TABLE_FILES.cells for scene in opened]
    check_journal_folder(folder, f"*/{TABLE_FILES.cells}", TABLE_FILES.results, force, journals)
    tools = Tools(options, Refiners([Path(path) for path in refiners]), splat_transform)
    with progress_bar(progress) as report:
        measuring = Measuring(opened, folder, shares, tools, only, report)
        try:
            measuring.run()
        except (KeyboardInterrupt, SystemExit):
            if any(folder.glob(f"*/{TABLE_FILES.cells}")):
                write_tables(folder, shares, measuring.missing)
            raise
        return write_tables(folder, shares, measuring.missing)


def _grouped(scenes: Sequence[TableScene], groups: Sequence[str]) -> list[TableScene]:
    """Scenes with the groups that the user wants; a PointSplatError if a group is not understood, or names an unknown
    scene."""
    wanted: dict[str, str] = {}
    for text in groups:
        name, equals, members = text.partition("=")
        if not (name.strip() and equals and members.strip()):
            raise PointSplatError(f"group {text!r}: expected NAME=SCENE,SCENE, such as rooms=room201,room202")
        wanted |= {member.strip(): name.strip() for member in members.split(",")}
    unknown = sorted(set(wanted) - {scene.name for scene in scenes})
    if unknown:
        names = ", ".join(scene.name for scene in scenes)
        raise PointSplatError(f"groups name {', '.join(unknown)}; expected some of the scenes {names}")
    return [dataclasses.replace(scene, group=wanted.get(scene.name)) for scene in scenes]


def _table_scene(path: Path, data: str | Path | None) -> TableScene:
    """A scene, of which nothing is read but the hash of its file and, of a run, its settings."""
    dataset = _dataset(path, data) if may_be_run(path) else ""
    opened = functools.partial(_open, path, data)
    return TableScene(name_of(path), path, source_file(path).sha256, dataset, None, opened)


def _dataset(path: Path, data: str | Path | None) -> str:
    """The paper's dataset that a run belongs to; empty if none, or its data is gone."""
    try:
        return paper_dataset(open_run(path, data=data))
    except SceneError:
        return ""


def _open(path: Path, data: str | Path | None, options: TableOptions) -> OpenedScene:
    """Read a scene, its views, and its photos if there are any."""
    dense = read_scene(path)

    def new_views() -> ViewSource:
        return ViewSource(dense, run=path, dataset_views=functools.partial(dataset_views, data=data))

    held_out, training = _looked_at(path, data, options) or _sampled(new_views(), options)
    judged = held_out.resized(options.side)
    differs = _differences(path, data, dense, held_out, judged)
    return OpenedScene(dense, judged, training.resized(options.side), new_views, differs)


def _differences(
    path: Path, data: str | Path | None, dense: Gaussians, held_out: JudgedViews, judged: JudgedViews
) -> tuple[str, ...]:
    """Differences of a scene's measurement from the paper's protocol: SH degree 3, 15,000 Splatfacto steps, judged by
    all held-out photos in their full size. ``held_out`` are the views before they are resized to the ``judged`` ones.
    """
    if held_out.photos is None:
        return ("no held-out photos",)
    run, found = open_run(path, data=data), []
    everything = len(dataset_views(path, "test", data))
    if len(held_out.views) < everything:
        found.append(f"{len(held_out.views)} of {everything} held-out photos")
    scale = run.datamanager_fields.get("camera_res_scale_factor", 1.0)
    scale /= run.dataparser_fields.get("downscale_factor") or 1
    if judged.views.width < held_out.views.width:
        found.append(f"photos reduced to {judged.views.width} of {held_out.views.width} pixels in width")
    elif scale != 1.0:
        found.append(f"photos reduced to {scale:g} of their width")
    if dense.sh_degree != 3:
        found.append(f"SH degree {dense.sh_degree}")
    if run.step + 1 < PROTOCOL.dense_steps:
        found.append(f"{run.step + 1:,} of {PROTOCOL.dense_steps:,} Splatfacto steps")
    if has_masks(path, "test", data):
        found.append("masks are not applied")
    return tuple(found)


def _looked_at(path: Path, data: str | Path | None, options: TableOptions) -> tuple[JudgedViews, JudgedViews] | None:
    """Held-out photos, and photos to train on; None if there are none."""
    if not may_be_run(path):
        return None
    try:
        held_out = JudgedViews(*dataset_photos(path, "test", options.views, data), "held-out photos")
        training = dataset_photos(path, "train", options.training_views, data)
        return held_out, JudgedViews(*training, "training photos")
    except (SceneError, DataError) as error:
        logger.warning("%s: no photos to compare with: %s", path, error)
        return None


def _sampled(source: ViewSource, options: TableOptions) -> tuple[JudgedViews, JudgedViews]:
    """Views alone, to judge in and to train on."""
    held_out = JudgedViews.compared(source, options.views)
    return held_out, JudgedViews(source.views(options.training_views), None, source.origin)


def paper_dataset(run: Run) -> str:
    """The dataset of the paper that a run, opened with its data, was trained on: "Replica" or "ScanNet++"; empty if it
    is another, or its data is gone."""
    parser, name = run.dataparser_class.rpartition(".")[2], run.data.name
    # The scenes of NICE-SLAM's Replica, which the paper follows; it does not say which three it tests on.
    if parser == "ReplicaDataParserConfig" and re.fullmatch(r"room[0-2]|office[0-4]", name):
        try:
            scene = load_replica(run.data, check_sizes=False)
        except DataError:
            return ""
        size = (scene.params.width, scene.params.height)
        # Drawn rooms (lab/rooms) may have the same names, but not this size and number.
        return "Replica" if size == (1200, 680) and len(scene) == 2000 else ""
    # By the dataset's own files, or by the COLMAP model among them, as the paper's authors read it.
    parsers = {"SeededScanNetppDataParserConfig", "ScanNetppDataParserConfig", "ColmapDataParserConfig"}
    folders = (run.data, *run.data.parents) if parser == "ColmapDataParserConfig" else (run.data,)
    if parser in parsers and any(
        re.fullmatch(r"[0-9a-f]{10}", folder.name) and (folder / "dslr").is_dir() for folder in folders[:4]
    ):
        return "ScanNet++"
    return ""
