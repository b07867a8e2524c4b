"""Measures the cells of tables one after the other, and writes each as soon as it is measured."""

from __future__ import annotations

import fnmatch
import functools
import logging
import math
import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch

import pointsplat_ns
from lab.tables.cells import About, Cell, CellJournal, distributions, identity
from lab.tables.making import Maker, Tools
from lab.tables.scene import OpenedScene, TableScene
from lab.tables.ways import PROTOCOL, WAYS, Way, cell_key
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.pruning import need_usable, ply_bytes
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.judging import Judge, Judged
from pointsplat_ns.tradeoff.machine import machine_text
from pointsplat_ns.tradeoff.measuring import MadeScene, point_of
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import DENSE

logger = logging.getLogger("pointsplat_ns")


class Measuring:
    """Measures the missing cells of some scenes, of different names.

    ``shares`` are those of Table 1. ``only`` are patterns of keys, such as ``fox/merge/10%`` or ``*/merge/*``; if
    given, only matching cells are measured, also those with a measurement. Raises SceneError if the folder holds cells
    of other scenes, views or another machine, or a damaged journal, and PointSplatError if two scenes have one name, or
    no cell matches ``only``.
    """

    def __init__(
        self,
        scenes: Sequence[TableScene],
        folder: Path,
        shares: Sequence[float],
        tools: Tools,
        only: Sequence[str],
        progress: Progress,
    ):
        self.progress, self._again = progress, bool(only)
        _need_different_names(scenes)
        machine = machine_text(torch.device("cpu"))
        self._work = [_SceneWork(scene, folder, tools, machine) for scene in scenes]
        self._cells = [
            (work, way, share)
            for work in self._work
            for way, share in WAYS.cells(shares)
            if not only or any(fnmatch.fnmatchcase(work.key(way, share), pattern) for pattern in only)
        ]
        if not self._cells:
            raise PointSplatError(
                f"{', '.join(only)}: no such cell; expected a name such as fox/merge/10%, or a pattern"
            )
        self.missing: dict[str, str] = {}
        """Reasons for missing cells, by key."""

    def run(self) -> None:
        """Measure all cells. A cell that cannot be made is left out, with the reason in :attr:`missing`. After Ctrl-C,
        measured cells are on disk."""
        wanted = []
        for work, way, share in self._cells:
            if why := work.missing(way, share):
                self.missing[work.key(way, share)] = why
            elif self._again or not work.has(way, share):
                wanted.append((work, way, share))
        try:
            for done, (work, way, share) in enumerate(wanted):
                for other in self._work:
                    if other is not work:
                        other.close()
                self._measure(work, way, share, done, len(wanted))
        finally:
            for work in self._work:
                work.close()

    def _measure(self, work: _SceneWork, way: Way, share: float, done: int, of: int) -> None:
        furthest = 0.0

        def show(what: str, part: float) -> None:
            # Making a scene has several tasks that each start at 0; the total must not fall.
            nonlocal furthest
            furthest = max(furthest, 0.7 * part if what else 0.7 + 0.3 * part)
            self.progress("measuring", (done + furthest) / of)

        key = work.key(way, share)
        before = work.journal.cells.get((way.name, share))
        try:
            cell = work.measure(way, share, show)
        except PointSplatError as error:  # other cells continue
            self.missing[key] = str(error)
            logger.warning("%s: left out: %s", key, error)
            return
        again = "" if before is None else f"; {_difference(before, cell)}"
        logger.info("%s: %s%s (%d of %d)", key, _figures(cell.point), again, done + 1, of)


class _SceneWork:
    """One scene, read for its first measurement."""

    def __init__(self, scene: TableScene, folder: Path, tools: Tools, machine: str):
        self.scene, self.folder, self.tools, self.machine = scene, folder, tools, machine
        self.journal = CellJournal(folder, scene.name)
        self.identity = identity(scene, tools.options, machine)
        self.journal.check(self.identity)
        if scene.group is not None:
            self.journal.regroup(scene.group)

    def key(self, way: Way, share: float) -> str:
        return cell_key(self.scene.name, way, share)

    def missing(self, way: Way, share: float) -> str:
        return self.tools.missing(way, share, self.scene.name)

    def has(self, way: Way, share: float) -> bool:
        """Whether a measurable cell was measured with the same weights, program and steps."""
        cell = self.journal.cells.get((way.name, share))
        return cell is not None and cell.made_with == self.tools.made_with(way, share, self.scene.name)

    @cached_property
    def _opened(self) -> tuple[OpenedScene, Maker, Judge]:
        opened = self.scene.open(self.tools.options)
        need_usable(opened.dense)
        judge = Judge(opened.dense, opened.held_out)
        if judge.no_lpips:
            logger.warning("%s: %s", self.scene.name, judge.no_lpips)
        return opened, Maker(opened, self.scene.name, self.tools), judge

    def close(self) -> None:
        """Free the memory of the opened scene."""
        if "_opened" in vars(self):
            self._opened[1].close()
            del self._opened

    def measure(self, way: Way, share: float, show: Progress) -> Cell:
        """Measure a cell and write it."""
        _, maker, judge = self._opened
        made = maker.make(way, share, show)
        judged = judge.judge(made.scene, lambda part: show("", part))
        if way.name == DENSE:
            judged = replace(judged, against_dense=replace(judged.against_dense, psnr=math.inf))
        opacities, volumes = distributions(made.scene, way.name, share)
        cell = Cell(
            way=way.name,
            point=self._point(way, share, made, judged),
            made_with=self.tools.made_with(way, share, self.scene.name),
            seed=PROTOCOL.seed,
            version=pointsplat_ns.__version__,
            commit=source_commit(),
            opacities=opacities,
            volumes=volumes,
        )
        self.journal.add(cell, self._about, self.identity)
        return cell

    @property
    def _about(self) -> About:
        held_out = self._opened[0].held_out
        known = self.journal.about.group if self.journal.about is not None else self.scene.dataset or "scenes"
        return About(
            name=self.scene.name,
            path=str(self.scene.path),
            dataset=self.scene.dataset,
            group=known if self.scene.group is None else self.scene.group,
            origin=held_out.origin,
            machine=self.machine,
            views=len(held_out.views),
            width=held_out.views.width,
            height=held_out.views.height,
            differs="; ".join(self._opened[0].differs),
        )

    def _point(self, way: Way, share: float, made: MadeScene, judged: Judged) -> Point:
        command = ["python", "-m", "lab.tables", str(self.scene.path), "-o", str(self.folder)]
        command += ["--only", self.key(way, share), *self.tools.words(way, share, self.scene.name)]
        repairs = {"fine-tuned": way.fine_tuned, "refiner": way.network is not None}
        return point_of(
            made,
            judged,
            key=self.key(way, share),
            label=way.label,
            command=shlex.join(command),
            by=way.by or way.name,
            share=share,
            repair=next((name for name, used in repairs.items() if used), way.repair),
            bytes=ply_bytes(len(made.scene), made.scene.sh_degree),
        )


def _need_different_names(scenes: Sequence[TableScene]) -> None:
    by_name: dict[str, Path] = {}
    for scene in scenes:
        other = by_name.setdefault(scene.name, scene.path)
        if other is not scene.path:
            raise PointSplatError(
                f"{other} and {scene.path}: both are called {scene.name}; leave one out, or use another folder for it"
            )


def _figures(point: Point) -> str:
    words = (
        [] if math.isinf(point.against_dense.psnr) else [f"{point.against_dense.psnr:.2f} dB against the dense scene"]
    )
    words += [f"{point.against_photos.psnr:.2f} dB against photos"] if point.against_photos is not None else []
    return ", ".join([*words, f"{point.gaussians:,} Gaussians", f"made in {point.seconds:.1f} s"])


def _difference(before: Cell, now: Cell) -> str:
    """Text on the difference of a repeated measurement."""
    same = ("against_dense", "against_photos", "gaussians")
    if all(getattr(before.point, name) == getattr(now.point, name) for name in same):
        return "the same quality as before"
    if before.made_with != now.made_with:
        return f"before, it was made with {before.made_with}"
    return f"before, it was {_figures(before.point)}"


@functools.cache
def source_commit() -> str:
    """The git commit of the package's source, 12 digits, with ``+`` where the package was changed since; empty if it
    runs from no checkout, as when installed.

    Example:
        >>> source_commit() == "" or len(source_commit().rstrip("+")) == 12
        True
    """
    # Whose checkout it is matters: an installed package may lie within somebody else's.
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:
        return ""
    commit, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain", "--", ".")
    if not commit or changes is None:
        return ""
    return commit.strip()[:12] + ("+" if changes.strip() else "")


def _git(*words: str) -> str | None:
    """Output of a git command in the package's folder; None if it fails or is not there."""
    try:
        command = ["git", "-C", str(Path(pointsplat_ns.__file__).parent), *words]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20.0)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
