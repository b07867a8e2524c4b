"""Levels of detail: a scene merged to ever fewer Gaussians in one pass, with the error of each
level.

Each level is merged from the level before, so levels are nested: every Gaussian has one parent in
the next coarser level. A repair moves the Gaussians of a level, and keeps their parents.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, DataError, PointSplatError
from pointsplat_ns.geometry.earth import Place
from pointsplat_ns.pipeline.acceptance import Comparison
from pointsplat_ns.pipeline.options import ReductionOptions, default_device
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.quality import Judge, Quality
from pointsplat_ns.pipeline.repair_budget import RepairBudget
from pointsplat_ns.pipeline.report import StageResult
from pointsplat_ns.pipeline.stages import Context, Repair
from pointsplat_ns.pipeline.view_provider import ViewOrigin, ViewProvider
from pointsplat_ns.pruning import Keep, found_by_trying, need_usable, parse_keep, resolve_keep
from pointsplat_ns.pruning.merging import merge_levels
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.formats.capacity import typical_sizes
from pointsplat_ns.scene.formats.sog_stream import STREAM_META, read_sog_stream
from pointsplat_ns.scene.gaussians import Gaussians, Traits
from pointsplat_ns.scene.reading import SourceFile
from pointsplat_ns.scene.usable import keep_usable
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.files import need_folder, need_writable
from pointsplat_ns.system.outputs import claim
from pointsplat_ns.system.progress import Progress, within
from pointsplat_ns.tools.levels.folder import check_folder, level_names, write_levels
from pointsplat_ns.tools.levels.level_errors import pixel_sizes
from pointsplat_ns.tools.levels.paged import write_paged
from pointsplat_ns.tools.levels.stream import write_stream
from pointsplat_ns.tools.levels.tiles_3d import TILESET, placed, write_tiles
from pointsplat_ns.tools.wording import origin_text, quality_text, sh_text, stage_text
from pointsplat_ns.view_sampling.content import content_box


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail."""

    scene: Gaussians
    """K Gaussians."""
    assignment: (
        Tensor  # [N] int64, index in ``scene`` for each Gaussian of the dense scene; -1 if dropped
    )
    dropped: int
    """Number of Gaussians of the dense scene without a place in this level, because they are too
    faint to be drawn."""
    quality: Quality | None
    """How close its renders are to the dense scene's; None if there is no view."""
    seconds: float
    """Duration of merging from the level before, and of the repair."""
    repair: StageResult | None = None
    """The repair of the level, kept or not; None if there was none."""

    def facts(self, whole: int) -> dict[str, Any]:
        """The manifest's entry of the level; ``whole`` is the number of Gaussians of the dense
        scene."""
        near = self.quality
        return {
            "count": len(self.scene),
            "share": len(self.scene) / whole,
            "sh_degree": self.scene.sh_degree,
            "dropped": self.dropped,
            "repaired": self.repair is not None and self.repair.accepted,
            "psnr": near and near.psnr,
            "worst_psnr": near and near.worst,
            "ssim": near and near.ssim,
            "quality": near and quality_text(near),
        }


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels of detail of a scene. ``len``, indices and iteration give each :class:`Level`, the
    finest first.

    Example:
        >>> import pointsplat_ns as ps
        >>> levels = ps.lod(ps.example_room()[::20], ["50%", "10%"])
        >>> [len(level.scene) for level in levels]
        [1572, 314]
        >>> whole = levels[1].assignment  # index in the second level, for each Gaussian of the dense scene
        >>> len(whole), int(whole.max())
        (3143, 313)
    """

    dense: Gaussians
    """The N Gaussians of the dense scene with all SH bands, without undrawable ones."""
    levels: tuple[Level, ...]
    """The finest first."""
    views: Views | None
    """The views that tell from which distance on a level shows enough; None if there are none."""
    origin: ViewOrigin | None
    """Where the views came from."""
    source: SourceFile | None
    """The file of the dense scene; None if it was given as Gaussians."""
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, origin of the views, why nothing was compared."""
    judge: Judge | None
    """Judges the levels; None if there are no views."""

    @property
    def scenes(self) -> list[Gaussians]:
        """The scene of each level."""
        return [level.scene for level in self]

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended a repair early; levels after it are not repaired."""
        return any(level.repair is not None and level.repair.interrupted for level in self)

    @property
    def parents(self) -> list[Tensor]:
        """For each level but the last, the index (M,) int64 in the next of the parent of each
        Gaussian; -1 if it is dropped."""
        found = []
        for finer, coarser in zip(self.levels, self.levels[1:], strict=False):
            parents = torch.full(
                (len(finer.scene),), -1, dtype=torch.int64, device=finer.assignment.device
            )
            kept = finer.assignment >= 0
            parents[finer.assignment[kept]] = coarser.assignment[kept]
            found.append(parents)
        return found

    def __len__(self) -> int:
        return len(self.levels)

    def __getitem__(self, index: int) -> Level:
        return self.levels[index]

    def __iter__(self) -> Iterator[Level]:
        return iter(self.levels)

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write every level and the manifest to a folder, as ``pointsplat lod`` does.

        Args:
            folder: created if it is missing.
            force: overwrite existing files.

        Raises:
            SceneError: if the folder cannot be used, or holds a file that must not be overwritten.
        """
        dense = self.dense
        file = self.source
        of = self.views
        boxes = {"all": (dense.means.amin(dim=0), dense.means.amax(dim=0))}
        if (content := content_box(dense)) is not None:
            boxes["content"] = content
        views = None
        if of is not None:
            views = {
                "count": len(of),
                "origin": origin_text(self.origin),
                "width": of.width,
                "height": of.height,
            }
        source = {
            "file": file and file.name,
            "bytes": file and file.bytes,
            "sha256": file and file.sha256,
            "count": len(dense),
            "sh_degree": dense.sh_degree,
        }
        bounds = {
            name: {"min": low.tolist(), "max": high.tolist()} for name, (low, high) in boxes.items()
        }
        about = {"source": source, "bounds": bounds, "views": views}
        write_levels(folder, self.scenes, about, [level.facts(len(dense)) for level in self], force)

    def pixel_sizes(self) -> list[float]:
        """Scene units a pixel from which on each level shows enough; without views, the typical
        size of its Gaussians."""
        near = [level.quality.psnr for level in self if level.quality is not None]
        found = None
        if self.views is not None:
            found = pixel_sizes(
                self.dense, DenseReference(self.dense, self.views), self.scenes, near
            )
        return found or [float(typical_sizes(scene.to("cpu")).median()) for scene in self.scenes]


@dataclass(frozen=True)
class LevelOutput:
    """Where levels are written, and in which form. Raises PointSplatError if options do not fit
    each other."""

    path: Path
    """A folder; of the form "paged" a file."""
    form: Literal["folder", "stream", "tiles", "paged"]
    """A folder with a file for each level, a streamed SOG, 3D Tiles, or a RAD file."""
    at: str | None
    """Where the scene lies on the Earth, for tiles."""
    up: str | None
    force: bool

    @classmethod
    def of(
        cls,
        path: str | Path | None,
        stream: bool,
        tiles: bool,
        at: str | None,
        up: str | None,
        force: bool,
    ) -> LevelOutput | None:
        """The output of options of :func:`pointsplat_ns.lod`; None if nothing is written."""
        if stream and tiles or at is not None and not tiles:
            raise PointSplatError(
                "expected either a stream or 3D Tiles, and a place on the Earth with tiles alone"
            )
        if at is not None:
            Place.parse(at)
        if path is None:
            return None
        paged = Path(path).suffix.lower() == ".rad"
        return cls(
            Path(path),
            "stream" if stream else "tiles" if tiles else "paged" if paged else "folder",
            at,
            up,
            force,
        )

    def check(self, count: int) -> None:
        """Check that ``count`` levels can be written."""
        if self.form == "paged":
            return need_writable(self.path, self.force)
        names = {"folder": level_names(count), "tiles": [TILESET], "stream": [STREAM_META]}[
            self.form
        ]
        need_folder(self.path)
        if not self.force:
            claim(self.path)
        check_folder(self.path, names, self.force)

    def write(self, levels: Levels, progress: Progress) -> Levels:
        """Write levels; those of a stream are then judged as they are in its files."""
        self.check(len(levels))  # again: a file may have appeared meanwhile
        if self.form == "folder":
            levels.save(self.path, self.force)
        elif self.form == "paged":
            write_paged(self.path, levels.scenes, levels.parents, progress)
        elif self.form == "tiles":
            about, matrix = placed(levels.scenes, levels.dense, self.at, self.up)
            parents = [of.cpu() for of in levels.parents]
            sizes = levels.pixel_sizes()
            write_tiles(self.path, about, parents, sizes, matrix, progress, force=self.force)
        else:
            write_stream(self.path, levels.scenes, levels.parents, progress, self.force)
            if levels.judge is not None:
                read = [
                    levels.judge.quality(read_sog_stream(self.path, index))
                    for index in range(len(levels))
                ]
                judged = (
                    replace(level, quality=quality)
                    for level, quality in zip(levels, read, strict=True)
                )
                return replace(levels, levels=tuple(judged))
        return levels


def parse_levels(levels: Sequence[Keep | str] | str) -> list[tuple[str, Keep]]:
    """The text and the budget of each level, checked as far as that is possible without the scene:
    ratios, percentages, counts and sizes as for ``keep``; a text may hold several, separated by
    spaces. Raises BudgetError if there is none, or a level is not a budget or needs a search."""
    levels = levels.split() if isinstance(levels, str) else levels
    if not levels:
        raise BudgetError("no level given; expected at least one, such as 50%")
    parsed: list[tuple[str, Keep]] = []
    for level in levels:
        text = str(level)
        try:
            budget = parse_keep(level) if isinstance(level, str) else level
        except BudgetError as error:
            raise BudgetError(f"level {text}: {error}") from error
        if found_by_trying(budget):
            raise BudgetError(
                f"level {text}: expected a ratio (0.3), a percentage (30%), a count (50000) or a "
                "size (12MB)"
            )
        parsed.append((text, budget))
    return parsed


def level_counts(
    levels: list[tuple[str, Keep]], n: int, sh_degree: int, traits: Traits
) -> list[int]:
    """The number of Gaussians of each level of a scene of ``n``, descending. Raises BudgetError if
    a level does not fit the scene, or two levels have the same number."""
    texts: dict[int, str] = {}
    for text, budget in levels:
        try:
            count = resolve_keep(n, budget, sh_degree, traits)
        except BudgetError as error:
            raise BudgetError(f"level {text}: {error}") from error
        if count in texts:
            raise BudgetError(
                f"levels {texts[count]} and {text} both mean {count} of {n} Gaussians; leave one "
                "out"
            )
        texts[count] = text
    return sorted(texts, reverse=True)


def make_levels(
    dense: Gaussians,
    levels: list[tuple[str, Keep]],
    options: ReductionOptions,
    views: ViewProvider,
    source: SourceFile | None,
    progress: Progress,
    budget: RepairBudget,
) -> Levels:
    """Make levels of detail in one pass, and measure each level as soon as it is made.

    Args:
        dense: N Gaussians. Undrawable ones are left out first, and their number is logged.
        levels: of :func:`parse_levels`; in any order.
        options: for all Gaussians; their SH bands are those of every level.
        views: source of the views to compare renders in; merging uses them too where they are
            known.
        source: the file of ``dense``, for the manifest.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        budget: of the repair of each level. Levels are merged from unrepaired ones.

    Raises:
        BudgetError: if a level does not fit the scene, or two levels have the same number of
            Gaussians.
        SceneError: if no Gaussian can be drawn.
        DataError: if the SH bands need views and there are none.
    """
    need_usable(dense)
    dense = keep_usable(dense, "the dense scene")
    progress("rendering the dense scene", 0.0)
    cut = prune_scene(dense, options, views)
    counts = level_counts(levels, len(dense), cut.scene.sh_degree, dense.traits)
    notes: tuple[str, ...] = () if cut.sh is None else (sh_text(cut.sh),)
    compared = None
    judge = None
    try:
        judge = Judge(dense, views)
        compared = views.compared()
    except DataError as error:
        notes = (*notes, f"the levels' errors are not measured: {error}")
    if views.origin is not None:
        notes = (f"views: {origin_text(views.origin)}", *notes)
    repair = Repair(budget)
    repairing = judge is not None and not budget.empty
    at_work = dense.to(default_device()) if repairing else dense
    comparison = Comparison(at_work, views) if repairing else None
    made: list[Level] = []
    start = time.perf_counter()
    for merged in merge_levels(
        cut.scene, counts, functools.partial(progress, "merging"), views.for_merging()
    ):
        which = f"level {len(made)}"
        scene = merged.scene
        repaired = None
        if comparison is not None and len(scene) < len(cut.scene):
            before = comparison.reference.closeness(scene.to(at_work.device))
            merge = StageResult("merge", scene, before)
            if repair.applies(merge):
                context = Context(at_work, views, comparison, progress=within(which, progress))
                repaired = repair.run(merge, context)
                scene = repaired.scene if repaired.accepted else scene
                notes = (*notes, f"{which}: {stage_text(repaired)}")
                comparison = None if repaired.interrupted else comparison
        seconds = time.perf_counter() - start
        progress(f"judging {which} of {len(counts) - 1}", 0.0)
        quality = None if judge is None else judge.quality(scene)
        dropped = int((merged.assignment < 0).sum())
        made.append(Level(scene, merged.assignment, dropped, quality, seconds, repaired))
        start = time.perf_counter()
    return Levels(dense, tuple(made), compared, views.origin, source, notes, judge)
