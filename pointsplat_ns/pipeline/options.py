"""Options of a request, shared by the command line and the Python API.

``tyro`` turns every field into an option of a command; the docstring below a field is its help.
Fields keep the user's text. Derived values are parsed once: :meth:`ReductionOptions.check` runs
before a scene is read and raises an error for an invalid option. Only then does this module import
torch.
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
    from pointsplat_ns.scene.formats import Format
    from pointsplat_ns.scene.gaussians import Gaussians, Traits
    from pointsplat_ns.view_sampling.upright import Up

NO_POSES = "none"
"""Value of ``poses`` that always samples views, even with a camera file beside the scene."""

AUTO_PHOTO_LOSS = 0.3
"""Maximum loss of PSNR in held-out photos with ``--photos --keep auto``, dB."""

Bands = Literal["all", "auto", "0", "1", "2", "3"]


SpzVersion = Literal[4, 3, 2]
"""Versions of SPZ that are written."""


def default_device() -> torch.device:
    """CUDA if available, else the CPU."""
    import torch

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _verbatim(metavar: str) -> PrimitiveConstructorSpec:
    """Spec for tyro that passes an option on as text, which the package parses itself."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )


def parse_path(text: str) -> Path:
    """Path from text. Raises ValueError if it is empty: ``Path("")`` is the current folder, and an
    unset variable in a script gives an empty argument."""
    if not text:
        raise ValueError("an empty path; expected a name, or . for the current folder")
    return Path(text)


def _photos(words: list[str]) -> Path | bool:
    if len(words) > 1 or words == [""]:
        raise ValueError("expected a folder of photos, or no value for the photos of a run")
    return Path(words[0]) if words else True


Budget = Annotated[Any, _verbatim("BUDGET")]
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
"""A camera file, a run, or :data:`NO_POSES`."""

Resolution = Annotated[tuple[int, int] | str | None, _verbatim("WxH")]

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
"""Whether to use the photos of the run, or a folder of photos."""


@dataclass(frozen=True)
class ViewOptions:
    """Cameras and size of renders."""

    poses: Poses = None
    """Camera file of the scene: cameras.json of 3DGS, transforms.json of nerfstudio, or the folder
    of a COLMAP project. By default the views of the scene's dataset, else of a camera file beside
    the scene or above it, else sampled views; none always samples views."""
    resolution: Resolution = None
    """Size at which people view the scene, pixels. Decisions by rendering use this size. By default
    the size of the photos, if there are any, else 1920x1080."""
    up: Annotated[str | None, arg(metavar="AXIS")] = None
    """Up axis of the scene for sampled views: x, y, z, -x, -y or -z; by default declared by the
    file, or estimated. Write --up=-y for a negative axis."""
    data: Path | str | None = None
    """Folder of the run's photos and poses, or a folder above it, if the data has moved since
    training. In a folder of scenes, a run without data gets sampled views and a note."""

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
        """Whether views are always sampled, even with a camera file beside the scene."""
        return self.poses is not None and str(self.poses) == NO_POSES

    def check(self) -> None:
        """Raise a PointSplatError if an option is invalid."""
        _ = self.size, self.upward


@dataclass(frozen=True)
class ReductionOptions:
    """Size of the result, and the method that selects its Gaussians.

    Example:
        >>> ReductionOptions("30%", sh="1").count_of(1000, sh_degree=1)
        300
    """

    keep: Budget = "0.3"
    """Size of the result: a ratio (0.3), a percentage (30%), a count (50000 or 50k), a file size
    (12MB or 800kB; .spz and .sog need a search, which takes two or three times as long), or
    auto:35, the smallest scene whose renders reach 35 dB PSNR against the dense scene (auto alone
    means 35)."""
    by: str = "merge"
    """Pruning method. merge replaces groups of neighbours by one Gaussian and is usually best. The
    other methods select Gaussians without changing them: coverage (empties no region), paper (eq.
    3), authors (the formula of the paper's released code), opacity, random; lightgaussian and pup
    score Gaussians in views of the scene."""
    opacity_weight: Annotated[float | None, arg(aliases=("--lambda",))] = None
    """Lambda of paper and authors, in [0, 1]: weight of opacity against volume; by default 0.3, as
    in the paper."""
    sh: Bands = "all"
    """SH bands to keep: all, a maximum degree, or auto, the lowest degree whose renders reach 40
    dB."""
    clean: bool = False
    """First remove Gaussians that cannot be drawn or seen; --keep still refers to the whole
    scene."""
    spz_version: SpzVersion | None = None
    """Version of an .spz result; by default 4, which the format's own library, SuperSplat,
    PlayCanvas and three.js read. Spark 2.2 and older viewers need 3, viewers from before 2025 need
    2. A size in --keep is that of this version."""
    target_format: Suppress[str] = ".ply"
    """Suffix of the format of the result. A size or PSNR in ``keep`` without a format refers to
    it."""

    @cached_property
    def budget(self) -> Keep:
        """``keep``, parsed. Raises BudgetError if it is not a budget."""
        from pointsplat_ns.pruning import parse_keep

        if isinstance(self.keep, str):
            return parse_keep(self.keep, self.target_format)
        return self.keep

    @cached_property
    def method(self) -> Method:
        """The method ``by``. Raises PointSplatError if it is unknown, or takes no opacity
        weight."""
        from pointsplat_ns.pruning import method_named

        return method_named(self.by, self.opacity_weight)

    @property
    def spz(self) -> int:
        """Version of an .spz result."""
        from pointsplat_ns.scene.formats import SPZ_VERSION

        return SPZ_VERSION if self.spz_version is None else self.spz_version

    def format_of(self, suffix: str) -> Format:
        """The format of a result with a suffix, SPZ in the version of the options. Raises
        SceneError or PointSplatError if there is none."""
        from pointsplat_ns.scene.formats import format_to_write

        return format_to_write(suffix, self.spz)

    def check(self) -> None:
        """Raise a PointSplatError if an option is invalid, or contradicts another."""
        _ = self.method, self.budget, self.format_of(self.target_format)
        if self.sh not in ("all", "auto", "0", "1", "2", "3"):
            raise PointSplatError(f"sh is {self.sh!r}; expected all, auto or a degree from 0 to 3")

    def count_of(self, n: int, sh_degree: int, traits: Traits | None = None) -> int | None:
        """Number of Gaussians to keep of ``n``; None if the budget needs a search (a PSNR, or the
        size of a compressed file). SH degree and traits of the result matter for a file size.
        Raises BudgetError if the budget does not fit the scene."""
        from pointsplat_ns.pruning import found_by_trying, resolve_keep
        from pointsplat_ns.scene.gaussians import PLAIN

        if found_by_trying(self.budget):
            return None
        return resolve_keep(n, self.budget, sh_degree, PLAIN if traits is None else traits)


@dataclass(frozen=True)
class PruneOptions(ViewOptions, ReductionOptions):
    """Options of :func:`pointsplat_ns.prune`."""

    photos: Photos = False
    """Also print PSNR in held-out photos: the run's test split, or every eighth photo in FOLDER, by
    name. Nothing is trained. Poses for FOLDER come from --poses, or from a camera file in it, above
    it or beside the scene; they are then the views."""

    def check(self) -> None:
        ViewOptions.check(self)
        ReductionOptions.check(self)


@dataclass(frozen=True)
class CompactOptions(PruneOptions):
    """Options of :func:`pointsplat_ns.compact`, which prunes, refines and repairs a scene.

    ``keep`` may be None, and ``by`` empty, until :meth:`completed`.
    """

    keep: Budget = None
    """Size of the result, as for prune: 0.1, 10%, 50000, 12MB, or auto:35, which pruning alone
    reaches. With --photos, auto is the smallest file that loses at most 0.3 dB in held-out photos.
    By default 0.1; with a refiner the budget of its training."""
    by: str = ""
    """Pruning method, as for prune; by default merge; with a refiner the method of its training."""
    refiner: Path | str | None = None
    """Trained network that refines the scene before the repair: a pointsplat run (its folder or
    config.yml), a .safetensors file, or shipped; by default none."""
    effort: Effort = "quick"
    """Length of the repair in steps: 0 (instant), 192 (quick) or 1200 (thorough); up to four times
    as many for more than 20,000 Gaussians."""
    seconds: float | None = None
    """Duration of the repair, in place of --effort; by default unset. Ctrl-C ends the repair early
    and writes the scene so far."""
    photos: Photos = False
    """Train on photos in place of the repair: 2400 steps (quick), 12000 (thorough), or --seconds.
    The result is accepted by its PSNR in training photos and in photos set aside. A run has photos
    in its dataset. Any scene takes photos from FOLDER, with poses from --poses, or from a camera
    file in FOLDER, above it or beside the scene."""
    target_db: float | None = None
    """Minimum PSNR of the final file against renders of the dense scene, dB, in place of --keep:
    finds the smallest such file; by default unset."""
    most_lost: Suppress[float | None] = None
    """Maximum loss of PSNR in held-out photos, dB, in place of the budget; set by
    :meth:`completed`."""

    @property
    def on_photos(self) -> bool:
        """Whether the scene is trained on photos."""
        return self.photos is not False

    @cached_property
    def repair(self) -> RepairBudget:
        """Length of the repair. ``seconds`` apply to training on photos instead, if there is
        any."""
        if self.on_photos and self.seconds is not None:
            return RepairBudget()
        return RepairBudget(self.effort, self.seconds)

    @cached_property
    def photo_budget(self) -> PhotoBudget | None:
        """Length of training on photos; None without photos."""
        return PhotoBudget(self.effort, self.seconds) if self.on_photos else None

    @property
    def searched(self) -> bool:
        """Whether the count is searched for, to reach a quality after all stages."""
        return self.target_db is not None or self.most_lost is not None

    def check(self) -> None:
        if self.target_db is not None and not 0 < self.target_db < math.inf:
            raise BudgetError(
                f"--target-db is {self.target_db:g}; expected a positive number, such as 32"
            )
        if self.target_db is not None and (self.on_photos or self.keep is not None):
            other = "--photos, which may differ from renders" if self.on_photos else "--keep"
            raise BudgetError(
                f"--target-db finds a size by renders of the dense scene; expected no {other}"
            )
        _ = self.repair, self.photo_budget
        ViewOptions.check(self)

    def completed(self, refiner: TrainedRefiner | None = None) -> CompactOptions:
        """The checked options with default ``keep`` and ``by``: those of the refiner's training,
        else a tenth by merging. Raises a PointSplatError as :meth:`check` and
        :meth:`ReductionOptions.check`."""
        from pointsplat_ns.pruning import PruneSettings, method_named

        self.check()
        usual = PruneSettings(0.1, "merge") if refiner is None else refiner.settings
        by = self.by or usual.by
        weight = self.opacity_weight
        if weight is None and method_named(by).weighs_opacity:
            weight = usual.opacity_weight
        most_lost = AUTO_PHOTO_LOSS if self.on_photos and self.keep == "auto" else self.most_lost
        keep = usual.keep if self.keep is None or most_lost is not None else self.keep
        done = replace(self, keep=keep, by=by, opacity_weight=weight, most_lost=most_lost)
        ReductionOptions.check(done)
        return done

    def check_sh_degree(self, dense: Gaussians, refiner: TrainedRefiner | None) -> None:
        """Raise a SceneError, before long computations, if the SH degree after pruning is certain
        to exceed the refiner's."""
        if refiner is None:
            return
        limit = refiner.network.config.sh_degree
        certain = self.sh == "all" or (self.sh.isdigit() and int(self.sh) > limit)
        if dense.sh_degree > limit and certain:
            raise SceneError(
                f"the scene has SH degree {dense.sh_degree}, but the refiner {refiner.source} "
                f"supports at most {limit}; cut the SH bands with --sh {limit}"
            )
