"""Makes levels of detail: merges a scene to ever fewer Gaussians in one pass, and measures each
level.

Each level is merged from the previous one, so levels are nested: every Gaussian has one parent in
the next coarser level. A repair moves the Gaussians of a level, but not their parents.
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
from pointsplat_ns.scene.formats.gltf import SPZ_INSIDE
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
    assignment: Tensor
    """[N] int64, index in ``scene`` for each Gaussian of the dense scene; -1 if dropped."""
    dropped: int
    """Number of Gaussians of the dense scene missing from this level, because they are too faint to
    draw."""
    quality: Quality | None
    """Quality against the dense scene; None if there is no view."""
    seconds: float
    """Duration of merging from the previous level, and of the repair."""
    repair: StageResult | None = None
    """Repair of the level, accepted or not; None if there was none."""

    def facts(self, whole: int) -> dict[str, Any]:
        """Entry of the level in the manifest; ``whole`` is the number of Gaussians of the dense
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
    """Levels of detail of a scene: a sequence of :class:`Level`, the finest first.

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
    """N drawable Gaussians of the dense scene, with all SH bands."""
    levels: tuple[Level, ...]
    """The levels, the finest first."""
    views: Views | None
    """Views that decide at which distance a level suffices; None if there are none."""
    origin: ViewOrigin | None
    """Origin of the views."""
    source: SourceFile | None
    """File of the dense scene; None for Gaussians in memory."""
    notes: tuple[str, ...]
    """Lines of text: origin of the views, cut SH bands, repairs, errors of the comparison."""
    judge: Judge | None
    """Judge of the levels; None if there are no views."""

    @property
    def scenes(self) -> list[Gaussians]:
        """The scene of each level."""
        return [level.scene for level in self]

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended a repair early; later levels are not repaired."""
        return any(level.repair is not None and level.repair.interrupted for level in self)

    @property
    def parents(self) -> list[Tensor]:
        """Parents of all levels but the last: index (M,) int64 in the next level for each Gaussian;
        -1 if it is dropped."""
        all_parents = []
        for finer, coarser in zip(self.levels, self.levels[1:], strict=False):
            parents = torch.full(
                (len(finer.scene),), -1, dtype=torch.int64, device=finer.assignment.device
            )
            present = finer.assignment >= 0
            parents[finer.assignment[present]] = coarser.assignment[present]
            all_parents.append(parents)
        return all_parents

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
            SceneError: if the folder is not usable, or contains a file that must not be
                overwritten.
        """
        dense = self.dense
        file = self.source
        views = self.views
        boxes = {"all": (dense.means.amin(dim=0), dense.means.amax(dim=0))}
        if (content := content_box(dense)) is not None:
            boxes["content"] = content
        about_views = None
        if views is not None:
            about_views = {
                "count": len(views),
                "origin": origin_text(self.origin),
                "width": views.width,
                "height": views.height,
                "other_sizes": [size[:2] for size in views.image_sizes()[1:]],
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
        about = {"source": source, "bounds": bounds, "views": about_views}
        write_levels(folder, self.scenes, about, [level.facts(len(dense)) for level in self], force)

    def pixel_sizes(self) -> list[float]:
        """Scene units per pixel at which each level suffices; without views, the typical size of
        its Gaussians."""
        near = [level.quality.psnr for level in self if level.quality is not None]
        sizes = None
        if self.views is not None:
            sizes = pixel_sizes(
                self.dense, DenseReference(self.dense, self.views), self.scenes, near
            )
        return sizes or [float(typical_sizes(scene.to("cpu")).median()) for scene in self.scenes]


@dataclass(frozen=True)
class LevelOutput:
    """Path and form of the output of levels."""

    path: Path
    """A folder; for the form "paged" a file."""
    form: Literal["folder", "stream", "tiles", "paged"]
    """A folder with a PLY per level, a streamed SOG, 3D Tiles, or a RAD file."""
    at: str | None
    """Place of the scene on the Earth, for tiles."""
    up: str | None
    force: bool
    spz_version: int = SPZ_INSIDE
    """Version of the SPZ in tiles."""

    @classmethod
    def of(
        cls,
        path: str | Path | None,
        stream: bool,
        tiles: bool,
        at: str | None,
        up: str | None,
        force: bool,
        spz_version: int | None = None,
    ) -> LevelOutput | None:
        """The output from options of :func:`pointsplat_ns.lod`; None if nothing is written. Raises
        PointSplatError if options contradict each other."""
        if stream and tiles or at is not None and not tiles:
            raise PointSplatError(
                "expected either a stream or 3D Tiles; a place on the Earth needs tiles"
            )
        if spz_version not in (None, 2, 3) or spz_version is not None and not tiles:
            raise PointSplatError(
                f"SPZ version {spz_version} of levels; expected 3 or 2, which CesiumJS reads, and "
                "3D Tiles"
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
            SPZ_INSIDE if spz_version is None else spz_version,
        )

    def check(self, count: int) -> None:
        """Check that ``count`` levels can be written. Raises SceneError."""
        if self.form == "paged":
            return need_writable(self.path, self.force)
        written = {"folder": level_names(count), "tiles": [TILESET], "stream": [STREAM_META]}
        need_folder(self.path)
        if not self.force:
            claim(self.path)
        check_folder(self.path, written[self.form], self.force)

    def write(self, levels: Levels, progress: Progress) -> Levels:
        """Write levels. Levels of a stream are then judged as stored in its files."""
        self.check(len(levels))  # again, because a file may have appeared meanwhile
        if self.form == "folder":
            levels.save(self.path, self.force)
        elif self.form == "paged":
            write_paged(self.path, levels.scenes, levels.parents, progress)
        elif self.form == "tiles":
            about, matrix = placed(levels.scenes, levels.dense, self.at, self.up)
            parents = [of.cpu() for of in levels.parents]
            sizes = levels.pixel_sizes()
            write_tiles(
                self.path,
                about,
                parents,
                sizes,
                matrix,
                progress,
                force=self.force,
                spz_version=self.spz_version,
            )
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
    """Text and budget of each level, checked as far as possible without the scene.

    Budgets are ratios, percentages, counts and sizes, as for ``keep``. A single text may contain
    several, separated by spaces. Raises BudgetError if there is none, or a level is not a budget or
    needs a search."""
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
    """Number of Gaussians of each level of a scene of ``n``, descending. Raises BudgetError if a
    level does not fit the scene, or two levels have the same number."""
    texts: dict[int, str] = {}
    for text, budget in levels:
        try:
            count = resolve_keep(n, budget, sh_degree, traits)
        except BudgetError as error:
            raise BudgetError(f"level {text}: {error}") from error
        if count in texts:
            raise BudgetError(
                f"levels {texts[count]} and {text} both mean {count} of {n} Gaussians; expected "
                "different counts"
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
    """Make levels of detail in one pass, and measure each level.

    Args:
        dense: N Gaussians. Undrawable ones are dropped first, and their number is logged.
        levels: levels from :func:`parse_levels`, in any order.
        options: SH bands of every level.
        views: source of views for comparison; merging uses known views too.
        source: the file of ``dense``, for the manifest.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        budget: length of the repair of each level. Levels are merged from unrepaired ones.

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
        notes = (*notes, f"errors of the levels are not measured: {error}")
    if views.origin is not None:
        notes = (f"views: {origin_text(views.origin)}", *notes)
    repair = Repair(budget)
    repairing = judge is not None and not budget.empty
    dense_on_device = dense.to(default_device()) if repairing else dense
    comparison = Comparison(dense_on_device, views) if repairing else None
    made: list[Level] = []
    start = time.perf_counter()
    for merged in merge_levels(
        cut.scene, counts, functools.partial(progress, "merging"), views.for_merging()
    ):
        name = f"level {len(made)}"
        scene = merged.scene
        repaired = None
        if comparison is not None and len(scene) < len(cut.scene):
            before = comparison.reference.closeness(scene.to(dense_on_device.device))
            merge = StageResult("merge", scene, before)
            if repair.applies(merge):
                context = Context(
                    dense=dense_on_device,
                    views=views,
                    comparison=comparison,
                    progress=within(name, progress),
                )
                repaired = repair.run(merge, context)
                scene = repaired.scene if repaired.accepted else scene
                notes = (*notes, f"{name}: {stage_text(repaired)}")
                comparison = None if repaired.interrupted else comparison
        seconds = time.perf_counter() - start
        progress(f"judging {name} of {len(counts) - 1}", 0.0)
        quality = None if judge is None else judge.quality(scene)
        dropped = int((merged.assignment < 0).sum())
        made.append(
            Level(
                scene=scene,
                assignment=merged.assignment,
                dropped=dropped,
                quality=quality,
                seconds=seconds,
                repair=repaired,
            )
        )
        start = time.perf_counter()
    return Levels(
        dense=dense,
        levels=tuple(made),
        views=compared,
        origin=views.origin,
        source=source,
        notes=notes,
        judge=judge,
    )
