"""Options of a request, for the command line and the Python API alike.

``tyro`` turns each field into an option of a command; the docstring below a field is its help.
Options hold what the user wrote. Derived values are parsed once: :meth:`ReductionOptions.check`,
called before a scene is read, raises what is wrong with them. This module imports torch only then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Suppress, arg
from tyro.constructors import PrimitiveConstructorSpec

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.pipeline.repair_budget import Effort, PhotoBudget, RepairBudget

if TYPE_CHECKING:
    import torch

    from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
    from pointsplat_ns.pruning import Keep, Method
    from pointsplat_ns.scene.gaussians import Gaussians, Traits
    from pointsplat_ns.view_sampling.upright import Up

NO_POSES = "none"
"""In place of a file of cameras: views are sampled, whatever lies beside the scene."""

KEPT_AUTO = 0.3
"""Largest loss of PSNR in held-out photos of ``--photos --keep auto``, dB."""

Bands = Literal["all", "auto", "0", "1", "2", "3"]


def default_device() -> torch.device:
    """CUDA if available, else the CPU."""
    import torch

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _as_written(metavar: str) -> PrimitiveConstructorSpec:
    """How tyro reads an option that the package parses itself: as the text that was written."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )


def parse_path(text: str) -> Path:
    """The path that was written. Raises ValueError if it is empty, which would be the current
    folder: that of a script whose variable is not set."""
    if not text:
        raise ValueError("an empty path; expected a name, or . for the current folder")
    return Path(text)


def _photos(words: list[str]) -> Path | bool:
    if len(words) > 1 or words == [""]:
        raise ValueError("expected a folder of photos, or nothing for those of a run")
    return Path(words[0]) if words else True


Budget = Annotated[Any, _as_written("BUDGET")]
"""A ratio, count, size or PSNR, as text or parsed (:data:`~pointsplat_ns.pruning.Keep`)."""

Poses = Annotated[
    Path | str | None,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: parse_path(words[0]),
        is_instance=lambda value: value is None or isinstance(value, (Path, str)),
        str_from_instance=lambda value: [str(value)],
    ),
]
"""A file of cameras, a run, or :data:`NO_POSES`."""

Resolution = Annotated[tuple[int, int] | str | None, _as_written("WxH")]

Photos = Annotated[
    Path | str | bool,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[FOLDER]",
        instance_from_str=_photos,
        is_instance=lambda value: isinstance(value, (bool, Path, str)),
        str_from_instance=lambda value: ["none"] if value is False else [str(value)],
    ),
]
"""Whether to use the photos of a run, or the folder of other photos."""


@dataclass(frozen=True)
class ViewOptions:
    """Where renders look from, and how large they are."""

    poses: Poses = None
    """A file of cameras of the scene: cameras.json of 3DGS, transforms.json of nerfstudio, or the
    folder of a COLMAP project. By default the views of its dataset, or of such a file beside the
    scene or above it, or sampled ones; none always samples them."""
    resolution: Resolution = None
    """Size of the pictures that people look at, pixels. Decisions by rendering are made at this
    size. By default the size of the photos, if there are any, else 1920x1080."""
    up: Annotated[str | None, arg(metavar="AXIS")] = None
    """The axis that is up in the scene: x, y, z, -x, -y or -z, for sampled views; by default the
    file's own, or an estimate. Write --up=-y for a negative axis."""
    data: Path | str | None = None
    """Folder of the run's photos and poses, or one above it, if it is no longer where the run says.
    In a folder of scenes, a run whose data is not found gets sampled views, which its note says."""

    @cached_property
    def size(self) -> tuple[int, int] | None:
        """``resolution``, parsed. Raises PointSplatError if it is not a size."""
        if self.resolution is None:
            return None
        from pointsplat_ns.rendering.comparison.sizes import parse_resolution

        return parse_resolution(self.resolution)

    @cached_property
    def upward(self) -> Up | None:
        """``up``, parsed. Raises PointSplatError if it is not an axis."""
        if self.up is None:
            return None
        from pointsplat_ns.view_sampling.upright import up_named

        return up_named(self.up)

    @property
    def sampled(self) -> bool:
        """Whether views are sampled, whatever lies beside the scene."""
        return self.poses is not None and str(self.poses) == NO_POSES

    def check(self) -> None:
        """Raise a PointSplatError if an option is not valid."""
        _ = self.size, self.upward


@dataclass(frozen=True)
class ReductionOptions:
    """How many Gaussians are kept, and which.

    Example:
        >>> ReductionOptions("30%", sh="1").count_of(1000, sh_degree=1)
        300
    """

    keep: Budget = "0.3"
    """Size of the result: a ratio (0.3), a percentage (30%), a count (50000 or 50k), the size of
    the file (12MB or 800kB; for .spz and .sog the count is searched for, which takes two or three
    times as long), or auto:35, the smallest scene whose renders reach 35 dB PSNR against those of
    the dense scene (auto alone means 35)."""
    by: str = "merge"
    """The method. merge replaces neighbours by one Gaussian each and is usually best; every other
    method keeps Gaussians as they are: coverage (empties no region), paper (eq. 3), authors (the
    formula of its released code), opacity, random; lightgaussian and pup score by views of the
    scene."""
    opacity_weight: float | None = None
    """Lambda of paper and authors: the weight of opacity; by default the paper's 0.3."""
    sh: Bands = "all"
    """SH bands to keep: all, up to a degree, or auto, the lowest degree whose renders reach 40
    dB."""
    clean: bool = False
    """First remove Gaussians that cannot be drawn or seen; --keep refers to the scene as read."""
    target_format: Suppress[str] = ".ply"
    """Suffix of the format of the result, which a size or a PSNR in ``keep`` is for if it names
    none."""

    @cached_property
    def budget(self) -> Keep:
        """``keep``, parsed. Raises BudgetError if it is not a budget."""
        from pointsplat_ns.pruning import parse_keep

        return (
            parse_keep(self.keep, self.target_format) if isinstance(self.keep, str) else self.keep
        )

    @cached_property
    def method(self) -> Method:
        """The method ``by``. Raises PointSplatError if it is unknown, or has no opacity weight."""
        from pointsplat_ns.pruning import method_named

        return method_named(self.by, self.opacity_weight)

    def check(self) -> None:
        """Raise a PointSplatError if an option is not valid, or does not fit another."""
        _ = self.method, self.budget
        if self.sh not in ("all", "auto", "0", "1", "2", "3"):
            raise PointSplatError(f"sh is {self.sh!r}; expected all, auto or a degree from 0 to 3")

    def count_of(self, n: int, sh_degree: int, traits: Traits | None = None) -> int | None:
        """Number of Gaussians to keep of ``n``, which depends on the SH degree and traits of the
        result where it has to fit a file; None if it needs a search (a PSNR, or the size of a
        compressed file). Raises BudgetError if the budget does not fit the scene."""
        from pointsplat_ns.pruning import found_by_trying, resolve_keep
        from pointsplat_ns.scene.gaussians import PLAIN

        if found_by_trying(self.budget):
            return None
        return resolve_keep(n, self.budget, sh_degree, PLAIN if traits is None else traits)


@dataclass(frozen=True)
class PruneOptions(ViewOptions, ReductionOptions):
    """Options of :func:`pointsplat_ns.prune`."""

    photos: Photos = False
    """Also print PSNR in held-out photos: of the dataset of a run, or every eighth photo, by name,
    in FOLDER. Nothing is trained. Its poses, those of --poses or of a file of cameras there, above
    it or beside the scene, are then the views."""

    def check(self) -> None:
        ViewOptions.check(self)
        ReductionOptions.check(self)


@dataclass(frozen=True)
class CompactOptions(PruneOptions):
    """Options of :func:`pointsplat_ns.compact`: a scene is pruned, refined if there is a refiner,
    and repaired.

    ``keep`` may be None, and ``by`` empty, until :meth:`completed`.
    """

    keep: Budget = None
    """Size of the result, as for prune: 0.1, 10%, 50000, 12MB, or auto:35, which is reached before
    repairs. With --photos, auto is the smallest file that loses at most 0.3 dB in held-out photos.
    By default the budget of the refiner's training; without a refiner 0.1."""
    by: str = ""
    """The method of prune; by default the method of the refiner's training; without a refiner
    merge."""
    refiner: Path | str | None = None
    """A trained network that refines the scene before the steps: a pointsplat run (its folder or
    config.yml), a .safetensors file, or shipped; by default none."""
    effort: Effort = "quick"
    """Length of the repair: no steps (instant), 192 (quick), or 1200 (thorough); up to four times
    as many for more than 20,000 Gaussians."""
    seconds: float | None = None
    """Duration of the repair, in place of --effort; by default none is set. Ctrl-C ends it earlier
    and writes the scene so far."""
    photos: Photos = False
    """In place of the repair train on photos, by 2400 steps (quick) or 12000 (thorough), or for
    --seconds. Photos in and outside of the steps say whether it helped. For a run, those of its
    dataset; for any scene, those in FOLDER, with the poses of --poses, or of a file of cameras
    there, above it or beside the scene."""
    target_db: float | None = None
    """In place of --keep, the smallest file that has at least this PSNR against renders of the
    dense scene, after all repairs; by default none is searched for."""
    most_lost: Suppress[float | None] = None
    """Largest loss of PSNR of the file in held-out photos, dB, in place of the budget; set by
    :meth:`completed`."""

    @property
    def on_photos(self) -> bool:
        """Whether the scene is trained on photos."""
        return self.photos is not False

    @cached_property
    def repair(self) -> RepairBudget:
        """Length of the repair. ``seconds`` are for the training on photos, where there is one."""
        if self.on_photos and self.seconds is not None:
            return RepairBudget()
        return RepairBudget(self.effort, self.seconds)

    @cached_property
    def photo_budget(self) -> PhotoBudget | None:
        """Length of the training on photos; None without one."""
        return PhotoBudget(self.effort, self.seconds) if self.on_photos else None

    @property
    def searched(self) -> bool:
        """Whether the count is searched for that reaches a quality after all stages."""
        return self.target_db is not None or self.most_lost is not None

    def check(self) -> None:
        if self.target_db is not None and not 0 < self.target_db < math.inf:
            raise BudgetError(
                f"--target-db is {self.target_db:g}; expected a positive number, such as 32"
            )
        if self.target_db is not None and (self.on_photos or self.keep is not None):
            other = "photos, which may differ from renders" if self.on_photos else "a budget"
            raise BudgetError(
                "--target-db finds a size by renders of the dense scene; expected it without "
                f"{other}"
            )
        _ = self.repair, self.photo_budget
        ViewOptions.check(self)

    def completed(self, refiner: TrainedRefiner | None = None) -> CompactOptions:
        """The options, checked, with ``keep`` and ``by`` of the refiner's training where none is
        named; without a refiner, a tenth and merging. Raises a PointSplatError as :meth:`check` and
        :meth:`ReductionOptions.check`."""
        from pointsplat_ns.pruning import PruneSettings, method_named

        self.check()
        usual = PruneSettings(0.1, "merge") if refiner is None else refiner.settings
        by = self.by or usual.by
        weight = self.opacity_weight
        if weight is None and method_named(by).weighs_opacity:
            weight = usual.opacity_weight
        most_lost = KEPT_AUTO if self.on_photos and self.keep == "auto" else self.most_lost
        keep = usual.keep if self.keep is None or most_lost is not None else self.keep
        done = replace(self, keep=keep, by=by, opacity_weight=weight, most_lost=most_lost)
        ReductionOptions.check(done)
        return done

    def check_sh_degree(self, dense: Gaussians, refiner: TrainedRefiner | None) -> None:
        """Raise a SceneError, before the long computations, if the SH degree after pruning is
        certain to exceed the refiner's."""
        if refiner is None:
            return
        limit = refiner.network.config.sh_degree
        certain = self.sh == "all" or (self.sh.isdigit() and int(self.sh) > limit)
        if dense.sh_degree > limit and certain:
            raise SceneError(
                f"the scene has SH degree {dense.sh_degree}; the refiner {refiner.source} was "
                f"built for at most {limit}; cut it with --sh {limit}"
            )
