"""Measures the paper's tables on any scenes: a cell is one scene made smaller in one way."""

from __future__ import annotations

import fnmatch
import functools
import logging
import shlex
import subprocess
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any

import torch
import tyro

import pointsplat_ns
from lab.common.compare import lpips_or_none, metrics_of
from lab.common.results import Row
from lab.tables.cells import Tables
from lab.tables.figure import distributions
from lab.tables.layout import write_tables
from lab.tables.making import Maker, Refiners, Tools
from lab.tables.scenes import OpenedScene, Options, open_scene, paper_dataset
from lab.tables.ways import PROTOCOL, WAYS, Way, cell_key
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import source_file
from pointsplat_ns.scene.runs import may_be_run, name_of, open_run
from pointsplat_ns.scene.views import View
from pointsplat_ns.system.files import logger, need_folder
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.tools.tradeoff.measuring import machine_text

ROUNDS = 3
"""Number of timed frames of each view; the fastest counts."""


class Judge:
    """Measures smaller scenes in the held-out views of one scene, whose renders are made once."""

    @torch.no_grad()
    def __init__(self, scene: OpenedScene):
        self.scene = scene
        self.reference = DenseReference(scene.dense, scene.held_out.views)
        self.lpips = lpips_or_none(True)

    @torch.no_grad()
    def figures(self, small: Gaussians) -> Row:
        """PSNR, SSIM and LPIPS against renders of the dense scene and against photos, and
        milliseconds of a frame."""
        views = self.scene.held_out.views
        photos = self.scene.held_out.photos
        images = [render(small, view) for view in views]
        against = {"against_dense": self._means(images, self.reference.renders)}
        against["against_photos"] = None if photos is None else self._means(images, photos)
        psnr = min(self.reference.closeness_of(images).psnr, MOST_PSNR)
        against["against_dense"]["psnr"] = None if small is self.scene.dense else psnr
        frame_ms = 1e3 * median(min(_seconds(small, view) for _ in range(ROUNDS)) for view in views)
        return {**against, "frame_ms": frame_ms}

    def _means(self, images: Sequence[torch.Tensor], targets: Sequence[torch.Tensor]) -> Row:
        found = [
            metrics_of(image, target.to(image), self.lpips)
            for image, target in zip(images, targets, strict=True)
        ]
        return {"lpips": None} | {
            name: fmean(metrics[name] for metrics in found) for name in found[0]
        }


def _seconds(scene: Gaussians, view: View) -> float:
    start = time.perf_counter()
    render(scene, view)
    return time.perf_counter() - start


def measured(
    scene: OpenedScene, output: Path, way: Way, share: float, maker: Maker, judge: Judge
) -> Row:
    """The cell of a scene, a way and a share of its Gaussians. ``point`` has its figures, and the
    command that measures it again."""
    name = maker.name
    tools = maker.tools
    made, seconds = maker.make(way, share)
    small = made[0]
    figures = [judge.figures(each) for each in made]
    key = cell_key(name, way, share)
    size = ply_bytes(len(small), small.sh_degree)
    words = [str(scene.path), "-o", str(output), "--only", key, *tools.words(way, share, name)]
    point = {
        "key": key,
        "label": way.label,
        "command": shlex.join(["python", "-m", "lab.tables", *words]),
    }
    point |= {
        "share": share,
        "gaussians": len(small),
        "sh_degree": small.sh_degree,
        "bytes": size,
        "seconds": seconds,
    }
    opacities, volumes = distributions(small) if way in WAYS.figure_4 else (None, None)
    cell: Row = {"way": way.name, "point": point | _mean(figures)}
    cell["psnr"] = [
        (found["against_photos"] or found["against_dense"])["psnr"] for found in figures
    ]
    cell |= {
        "made_with": tools.made_with(way, share, name),
        "seed": PROTOCOL.seed,
        "commit": source_commit(),
    }
    return cell | {"version": pointsplat_ns.__version__, "opacities": opacities, "volumes": volumes}


def _mean(found: Sequence[Any]) -> Any:
    """The mean over networks of figures, which are numbers or rows of them; None where there is
    none."""
    if isinstance(found[0], dict):
        return {name: _mean([figures[name] for figures in found]) for name in found[0]}
    return None if found[0] is None else fmean(found)


def measure_tables(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    keeps: tuple[float, ...] = PROTOCOL.shares,
    refiners: tuple[Path, ...] = (),
    groups: tuple[str, ...] = (),
    only: tuple[str, ...] = (),
    views: int = 10,
    side: int = 640,
    scoring_views: int = 40,
    fine_tune: int = 300,
    splat_transform: str | None = None,
    data: Path | None = None,
    force: bool = False,
) -> tyro.conf.Suppress[Tables]:
    """Measure the paper's Tables 1 to 4 and Figure 4 on any scenes, with our methods and
    splat-transform beside.

    Each cell, one scene made smaller in one way, is saved as soon as it is measured: the same
    command resumes after an interruption. The tables are of all scenes in the folder, also those of
    earlier commands.

    Args:
        scenes: Splatfacto runs (folders or config.yml), whose held-out photos are then used where
            they are found; or files of scenes.
        output: folder for tables.json with all cells, tables.md and figure4.png.
        keeps: shares of the Gaussians in Tables 1 and 2.
        refiners: weights for the rows with a network: runs, .safetensors files, or folders above
            runs. Each row takes those with fitting metadata; of those that differ by their seed,
            the mean.
        groups: NAME=SCENE,SCENE...; means are taken over groups.
        only: names or patterns of cells, such as fox/merge/10%. Only these are measured, also if
            they were before.
        views: largest number of held-out views of a scene.
        side: largest side of all images, pixels; photos are reduced.
        scoring_views: largest number of training poses for the scores of LightGaussian and
            PUP-3DGS.
        fine_tune: steps of fine-tuning, against at most 60 training photos.
        splat_transform: path of the program; by default the one on PATH.
        data: folder above the data of the runs, or that of one, where it is no longer where the
            runs say; a run whose data is not found is measured without photos, with a warning.
        force: start over with the given scenes.
    """
    logging.basicConfig(format="%(message)s")
    logger.setLevel(logging.INFO)
    options = Options(views, side, scoring_views, fine_tune)
    if not all(0 < share < 1 for share in keeps):
        raise PointSplatError(
            f"keeps are {', '.join(f'{share:g}' for share in keeps)}; expected shares such as 0.1"
        )
    if not scenes:
        raise PointSplatError("no scene is named; expected Splatfacto runs, or files of scenes")
    paths = {name_of(Path(path)): Path(path) for path in scenes}
    if len(paths) < len(scenes):
        raise PointSplatError(
            "two scenes have one name; expected different ones, found "
            f"{', '.join(map(str, scenes))}"
        )
    tools = Tools(options, Refiners(refiners), splat_transform)
    need_folder(output)
    tables = Tables.read(output, force)
    for name, path in paths.items():
        tables.enter(name, _about(path, data, options), _groups(groups, paths).get(name))
    tables.missing = {}
    wanted = _wanted(tables, paths, keeps, tools, only)
    try:
        for name, cells in tracked(wanted.items(), "measuring", len(wanted)):
            _measure(tables, output, name, open_scene(paths[name], data, options), cells, tools)
    finally:
        write_tables(tables, output, keeps)
    print(f"{output}: tables.md, tables.json and figure4.png")
    return tables


def _measure(
    tables: Tables,
    output: Path,
    name: str,
    scene: OpenedScene,
    cells: list[tuple[Way, float]],
    tools: Tools,
) -> None:
    """Measure cells of a scene and write each. A cell that cannot be made is left out, with the
    reason."""
    shown = scene.held_out.views
    about = {
        "views": len(shown),
        "width": shown.width,
        "height": shown.height,
        "origin": scene.origin,
    }
    tables.scenes[name] |= about | {"differs": "; ".join(scene.differs)}
    maker = Maker(scene, name, tools)
    judge = Judge(scene)
    for way, share in cells:
        key = cell_key(name, way, share)
        try:
            cell = measured(scene, output, way, share, maker, judge)
        except PointSplatError as error:  # other cells continue
            tables.missing[key] = str(error)
            logger.warning("%s: left out: %s", key, error)
            continue
        tables.cells[key] = cell
        tables.save(output)
        point = cell["point"]
        psnr = {
            name: found["psnr"]
            for name in ("dense", "photos")
            if (found := point[f"against_{name}"])
        }
        text = ", ".join(
            f"{value:.2f} dB against {what}" for what, value in psnr.items() if value is not None
        )
        logger.info(
            "%s: %s, %d Gaussians, %.1f s",
            key,
            text or "dense",
            point["gaussians"],
            point["seconds"],
        )


def _about(path: Path, data: Path | None, options: Options) -> Row:
    """Facts on a scene, of which nothing is read but the hash of its file and, of a run, its
    settings."""
    dataset = ""
    if may_be_run(path):
        try:
            dataset = paper_dataset(open_run(path, data=data))
        except SceneError:  # its data is gone
            pass
    machine = machine_text(torch.device("cpu"))
    about: Row = {"name": name_of(path), "path": str(path), "dataset": dataset, "machine": machine}
    asked = {name: value for name, value in asdict(options).items() if name != "fine_tune"}
    return about | {"of": {"file": source_file(path).sha256, "machine": machine, **asked}}


def _groups(groups: Sequence[str], names: dict[str, Path]) -> dict[str, str]:
    """The group of each scene that is named in one; a PointSplatError if a group is not understood,
    or names an unknown scene."""
    found: dict[str, str] = {}
    for text in groups:
        name, equals, members = text.partition("=")
        if not (name.strip() and equals and members.strip()):
            raise PointSplatError(
                f"group {text!r}: expected NAME=SCENE,SCENE, such as rooms=room201,room202"
            )
        found |= {member.strip(): name.strip() for member in members.split(",")}
    if unknown := sorted(found.keys() - names):
        raise PointSplatError(
            f"groups name {', '.join(unknown)}; expected some of the scenes {', '.join(names)}"
        )
    return found


def _wanted(
    tables: Tables,
    names: dict[str, Path],
    keeps: Sequence[float],
    tools: Tools,
    only: Sequence[str],
) -> dict[str, list[tuple[Way, float]]]:
    """The cells to measure, by scene: those that ``only`` names, or that lack a measurement with
    the same tools. What cannot be measured is noted with the reason. Raises PointSplatError if
    ``only`` names none."""
    wanted: dict[str, list[tuple[Way, float]]] = {}
    named = 0
    for name in names:
        for way, share in WAYS.cells(keeps):
            key = cell_key(name, way, share)
            if only and not any(fnmatch.fnmatchcase(key, pattern) for pattern in only):
                continue
            named += 1
            known = tables.cells.get(key)
            if why := tools.missing(way, share, name):
                tables.missing[key] = why
            elif only or known is None or known["made_with"] != tools.made_with(way, share, name):
                wanted.setdefault(name, []).append((way, share))
    if not named:
        raise PointSplatError(
            f"{', '.join(only)}: no such cell; expected a name such as fox/merge/10%, or a pattern"
        )
    return wanted


@functools.cache
def source_commit() -> str:
    """The git commit of the package's source, 12 digits, with ``+`` where the package was changed
    since; empty if it is not known."""
    git = ["git", "-C", str(Path(pointsplat_ns.__file__).parent)]
    try:
        found = [
            subprocess.run(
                [*git, *words], capture_output=True, text=True, timeout=20.0, check=True
            ).stdout.strip()
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--", "."))
        ]
    except (OSError, subprocess.SubprocessError):
        return ""
    return found[0][:12] + ("+" if found[1] else "")
