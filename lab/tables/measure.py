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
from typing import Annotated, Any, Literal

import torch
import tyro

import pointsplat_ns
from lab.common.compare import metrics_of
from lab.common.results import Row
from lab.tables.cells import Tables
from lab.tables.figure import distributions
from lab.tables.fine_tune import PUBLISHED_STEPS
from lab.tables.layout import write_tables
from lab.tables.make_scene import Maker, Refiners, Tools
from lab.tables.scenes import (
    OpenedScene,
    Options,
    open_scene,
    paper_dataset,
    run_or_file,
    scenes_at,
)
from lab.tables.ways import PROTOCOL, WAYS, Way, cell_key
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.rendering import rasterization, render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import source_file
from pointsplat_ns.scene.runs import may_be_run, open_run
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.files import logger, need_folder
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.tools.tradeoff.measuring import machine_text

ROUNDS = 3
"""Number of timed frames of each view; the fastest counts."""

TORCH = 2, 2
"""Numbers of views and of rounds in which frames are timed without compiled kernels, which take
several times as long."""

Net = Literal["alex", "vgg"]

LPIPS = {"alex": "lpips", "vgg": "lpips_vgg"}
"""Names of LPIPS in cells, by its network."""


def networks_at_hand(nets: Sequence[Net]) -> dict[str, Lpips]:
    """LPIPS by its name in cells, of the networks whose weights are at hand; says which are
    not."""
    found = {}
    for net in nets:
        try:
            found[LPIPS[net]] = load_lpips(net, download=False)
        except LpipsUnavailable as error:
            logger.warning("no LPIPS by %s: %s", net, error)
    return found


class Judge:
    """Measures smaller scenes in the held-out views of one scene, whose renders are made once.

    Args:
        scene: with its views and photos.
        lpips: LPIPS by its name in cells.
    """

    @torch.no_grad()
    def __init__(self, scene: OpenedScene, lpips: dict[str, Lpips]):
        self.scene = scene
        self.reference = DenseReference(scene.dense, scene.held_out.views)
        self.lpips = lpips

    @torch.no_grad()
    def figures(self, small: Gaussians, timed: bool) -> Row:
        """PSNR, SSIM and LPIPS against renders of the dense scene and against photos (LPIPS only
        against photos, where there are some), fill, and milliseconds of a frame; with ``timed``
        also of one that torch alone draws."""
        views = self.scene.held_out.views
        photos = self.scene.held_out.photos
        images = [render(small, view) for view in views]
        nets = self.lpips if photos is None else {}
        against = {"against_dense": _means(images, self.reference.renders, nets)}
        against["against_photos"] = None if photos is None else _means(images, photos, self.lpips)
        psnr = min(self.reference.closeness_of(images).psnr, MOST_PSNR)
        against["against_dense"]["psnr"] = None if small is self.scene.dense else psnr
        return {
            **against,
            "fill": fill(small, views),
            "frame_ms": _frame_ms(small, views, ROUNDS, compiled=True),
            "frame_ms_torch": _frame_ms(small, views.spread(TORCH[0]), TORCH[1], compiled=False)
            if timed
            else None,
        }


def _means(
    images: Sequence[torch.Tensor], targets: Sequence[torch.Tensor], nets: dict[str, Lpips]
) -> Row:
    """Means over views of PSNR, SSIM and LPIPS; None for LPIPS without its network."""
    found = []
    for image, target in zip(images, targets, strict=True):
        close = metrics_of(image, target.to(image), None)
        for name, net in nets.items():
            close[name] = float(net(image, target.to(image)))
        found.append(close)
    return dict.fromkeys(LPIPS.values()) | {
        name: fmean(metrics[name] for metrics in found) for name in found[0]
    }


def _frame_ms(scene: Gaussians, views: Views, rounds: int, compiled: bool) -> float:
    """CPU milliseconds of a frame: the median over views of the fastest of some rounds."""

    def fastest(view: View) -> float:
        return min(_seconds(scene, view, compiled) for _ in range(rounds))

    return 1e3 * median(map(fastest, views))


def _seconds(scene: Gaussians, view: View, compiled: bool) -> float:
    """CPU seconds of a picture, which others on the machine do not stretch, by compiled kernels
    where there are some, or by torch alone."""
    start = time.process_time()
    if compiled:
        render(scene, view)
    else:
        rasterization(
            *(scene.means, scene.quats, scene.stds, scene.alphas, scene.sh),
            viewmats=view.viewmat[None],
            Ks=view.K[None],
            width=view.width,
            height=view.height,
            sh_degree=scene.sh_degree,
            compiled=False,
        )
    return time.process_time() - start


def measured(
    scene: OpenedScene, output: Path, way: Way, share: float, maker: Maker, judge: Judge
) -> Row:
    """The cell of a scene, a way and a share of its Gaussians. ``point`` has its figures, and the
    command that measures it again."""
    name = maker.name
    tools = maker.tools
    made = maker.make(way, share)
    small = made.scenes[0]
    timed = way == WAYS.dense or way in WAYS.table_2
    start = time.process_time()
    figures = [judge.figures(each, timed) for each in made.scenes]
    judged = time.process_time() - start
    key = cell_key(name, way, share)
    size = ply_bytes(len(small), small.sh_degree)
    words = [str(scene.given), "-o", str(output), "--only", key, *tools.words(way, share, name)]
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
        "seconds": made.seconds,
        "judged": judged / len(figures),
    }
    opacities, volumes = distributions(small) if way in WAYS.figure_4 else (None, None)
    cell: Row = {"way": way.name, "point": point | _mean(figures)}
    cell["curve"] = made.curve
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
    views: int | None = None,
    side: int | None = None,
    scoring_views: int | None = None,
    fine_tune: int = PUBLISHED_STEPS,
    lpips: tuple[Net, ...] = ("alex", "vgg"),
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
        scenes: Splatfacto runs (folders, folders above them, or config.yml), whose held-out photos
            are then used where they are found; or files of scenes.
        output: folder for tables.json with all cells, tables.md and figure4.png.
        keeps: shares of the Gaussians in Tables 1 and 2.
        refiners: weights for the rows with a network: .safetensors files, runs, folders above runs
            at any depth, of which the newest of each name count, or "shipped", those that ship for
            selections. Each row takes those with fitting metadata; of those that differ by their
            seed, the mean.
        groups: NAME=SCENE,SCENE...; means are taken over groups.
        only: names or patterns of cells, such as fox/merge/10%. Only these are measured, also if
            they were before.
        views: largest number of held-out views of a scene; by default all.
        side: largest side of all images, pixels; photos are reduced. By default full size.
        scoring_views: largest number of training poses for the scores of LightGaussian and
            PUP-3DGS; by default all.
        fine_tune: steps of fine-tuning after each pruning; by default those of the publications.
        lpips: networks of LPIPS whose weights are at hand. By VGG it takes ten times as long as all
            else of a cell without fine-tuning.
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
    named = [pair for path in scenes for pair in scenes_at(Path(path)).items()]
    paths = dict(named)
    if len(paths) < len(named):
        raise PointSplatError(
            "two scenes have one name; expected different ones, found "
            f"{', '.join(map(str, scenes))}"
        )
    tools = Tools(options, Refiners(refiners), splat_transform)
    need_folder(output)
    tables = Tables.read(output, force)
    for name, path in paths.items():
        tables.enter(name, _about(name, path, data, options), _groups(groups, paths).get(name))
    tables.missing = {}
    networks = networks_at_hand(lpips)
    wanted = _wanted(tables, paths, keeps, tools, only, networks)
    try:
        for name, cells in tracked(wanted.items(), "measuring", len(wanted)):
            judge = Judge(open_scene(paths[name], data, options), networks)
            _measure(tables, output, name, judge, cells, tools)
    finally:
        write_tables(tables, output, keeps)
    print(f"{output}: tables.md, tables.json and figure4.png")
    return tables


def _measure(
    tables: Tables,
    output: Path,
    name: str,
    judge: Judge,
    cells: list[tuple[Way, float]],
    tools: Tools,
) -> None:
    """Measure cells of a scene and write each. A cell that cannot be made is left out, with the
    reason."""
    scene = judge.scene
    shown = scene.held_out.views
    about = {
        "views": len(shown),
        "width": shown.width,
        "height": shown.height,
        "origin": scene.origin,
    }
    tables.scenes[name] |= about | {"differs": "; ".join(scene.differs)}
    maker = Maker(scene, name, tools)
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


def _about(name: str, path: Path, data: Path | None, options: Options) -> Row:
    """Facts on a scene, of which nothing is read but the hash of its file and, of a run, its
    settings."""
    dataset = ""
    run = run_or_file(path)
    if may_be_run(run):
        try:
            dataset = paper_dataset(open_run(run, data=data))
        except SceneError:  # its data is gone
            pass
    machine = machine_text(torch.device("cpu"))
    about: Row = {"name": name, "path": str(path), "dataset": dataset, "machine": machine}
    asked = {name: value for name, value in asdict(options).items() if name != "fine_tune"}
    return about | {"of": {"file": source_file(run).sha256, "machine": machine, **asked}}


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
    networks: dict[str, Lpips],
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
            elif (
                only
                or known is None
                or _outdated(known, tools.made_with(way, share, name), networks)
            ):
                wanted.setdefault(name, []).append((way, share))
    if not named:
        raise PointSplatError(
            f"{', '.join(only)}: no such cell; expected a name such as fox/merge/10%, or a pattern"
        )
    return wanted


def _outdated(cell: Row, made_with: str, networks: dict[str, Lpips]) -> bool:
    """Whether a cell was made with other tools, or lacks LPIPS by a network at hand."""
    point = cell["point"]
    found = point["against_photos"] or point["against_dense"]
    return cell["made_with"] != made_with or any(found.get(name) is None for name in networks)


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
