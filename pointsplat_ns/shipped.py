"""The refiner that ships, or another one, put to use: a scene is made smaller and refined, as far as that brings it
closer to what it was."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.auto_budget import Closeness, DenseReference
from pointsplat_ns.compaction import COMPARED_SIDE, COMPARED_VIEWS, Poses, compact_scene
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import METHODS, Keep, need_usable
from pointsplat_ns.refined_run import open_refined_run, prune_options
from pointsplat_ns.refiner import Refiner, WeightsError, load_refiner, read_metadata
from pointsplat_ns.views import Views

SHIPPED = Path(__file__).parent / "weights" / "refiner.safetensors"
"""The refiner that ships; ``CARD.md`` beside it says what it was trained on and what it reaches."""

WORTH = 0.1
"""Refinement that brings less than this, dB, is left out: which side of zero so little is on depends on the views."""

DEFAULTS = {"keep": 0.1, "score": "merge", "opacity_weight": 0.3}
"""What a file of weights is taken to be trained with where it does not say."""


@dataclass(frozen=True, eq=False)
class TrainedRefiner:
    """A refiner and the kind of scene that it was trained to see."""

    refiner: Refiner
    prune_options: dict[str, Any]
    """Arguments of :func:`pointsplat_ns.pruning.compact`: ``keep``, ``by`` and perhaps ``opacity_weight``."""
    source: Path

    @torch.no_grad()
    def __call__(self, scene: Gaussians) -> Gaussians:
        """The refined scene, where the given one is."""
        parameter = next(self.refiner.parameters())
        return self.refiner(scene.to(parameter.device)).to(scene.device)


def load_shipped(device: torch.device | str = "cpu") -> TrainedRefiner:
    """The refiner that ships, on a device.

    Raises:
        WeightsError: if its file is not there or damaged.
    """
    if not SHIPPED.is_file():
        raise WeightsError(
            f"{SHIPPED}: the refiner that ships is not there; name another with --using RUN_OR_FILE, or make it with "
            "pointsplat make-refiner"
        )
    return load_trained(SHIPPED, device)


def load_trained(path: Path | str, device: torch.device | str = "cpu") -> TrainedRefiner:
    """A trained refiner: a ``.safetensors`` file, or a ``pointsplat`` run (its folder, ``config.yml`` or checkpoint).

    Raises:
        WeightsError: if the file is damaged or of another kind.
        SceneError: if it is no such run.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".safetensors":
        refiner, options = load_refiner(path), _trained_with(read_metadata(path), path)
    elif path.is_file() and kind not in (".yml", ".yaml", ".ckpt"):
        raise WeightsError(
            f"{path}: a {kind or 'nameless'} file; expected a trained pointsplat run (its folder or config.yml), or a "
            ".safetensors file"
        )
    else:
        opened = open_refined_run(path, need_scenes=False)
        refiner, options = opened.refiner, opened.prune_options
    return TrainedRefiner(refiner.to(device).eval(), options, path)


def _trained_with(metadata: dict[str, Any], path: Path) -> dict[str, Any]:
    """Arguments of :func:`pointsplat_ns.pruning.compact` that a file's metadata names."""
    known = {**DEFAULTS, **{name: metadata[name] for name in DEFAULTS if name in metadata}}
    try:
        if known["score"] not in METHODS:
            raise WeightsError(f"score is {known['score']!r}; expected one of {', '.join(METHODS)}")
        return prune_options(float(known["keep"]), known["score"], float(known["opacity_weight"]))
    except (PointSplatError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: metadata not understood ({error}); train or download it again") from error


@dataclass(frozen=True, eq=False)
class RefinedCompaction:
    """A smaller scene, and whether refining it helped."""

    scene: Gaussians
    """``refined`` if that helps, ``compacted`` if not."""
    compacted: Gaussians
    """Before refinement."""
    refined: Gaussians
    """After it, at ``strength``."""
    strength: float
    """The share of the refiner's residuals in ``refined``, in (0, 1]: the best that was found, 1 if none helps."""
    helped: bool
    """Whether refinement is in ``scene``."""
    verdict: str
    """One line for a person: what refinement brought, or why it was left out."""
    notes: tuple[str, ...]
    """Lines for a person: SH bands dropped, PSNR reached, where poses came from."""
    reference: DenseReference | None
    """The dense scene's renders that both were compared with; None where there is no view to compare in."""
    before: Closeness | None
    """How close ``compacted`` comes to them."""
    after: Closeness | None
    """How close ``refined`` comes to them; None where it was not compared."""


def compact_and_refine(
    dense: Gaussians,
    trained: TrainedRefiner,
    keep: Keep | None = None,
    by: str | None = None,
    sh: str = "all",
    poses: Callable[[int], Views] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> RefinedCompaction:
    """Make a scene smaller and refine it, if that helps.

    The smaller scene and the refined one are rendered from some poses and compared with the dense scene's own renders
    by the mean squared error over all pixels of all views. On a scene unlike those that it was trained on, a refiner
    moves the right way but too far: half of the residuals are tried, too, and the share at the bottom of the parabola
    through the errors at 0, 1/2 and 1, which is where the least error is if pictures change in proportion. The best is
    kept if it is :data:`WORTH` it. A wanted PSNR (``auto``) is met before refinement, so that it holds in any case.

    Args:
        dense: N Gaussians.
        trained: the refiner, on the device that it is to run and its scenes are to be rendered on.
        keep: ratio, count, size or PSNR; by default what the refiner was trained with.
        by: a method of :data:`~pointsplat_ns.compaction.ALL_METHODS`; by default the one that the refiner was trained
            with.
        sh: as for :func:`~pointsplat_ns.compaction.compact_scene`.
        poses: gives so many views to look from; by default they are sampled in free space.
        progress: called with what is being done and the share done of it, in [0, 1].

    Raises:
        BudgetError, SceneError, PointSplatError: as :func:`~pointsplat_ns.compaction.compact_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs poses and none can be had.
    """
    told = progress or (lambda what, share: None)
    poses = poses or Poses(None, dense)
    need_usable(dense)
    limit = trained.refiner.config.sh_degree
    if dense.sh_degree > limit and (sh == "all" or (sh.isdigit() and int(sh) > limit)):
        raise SceneError(
            f"the scene has SH degree {dense.sh_degree}; the refiner {trained.source} was built for at most {limit}; "
            f"cut it with --sh {limit}"
        )
    options = trained.prune_options
    made = compact_scene(
        dense,
        options["keep"] if keep is None else keep,
        by or options["by"],
        sh,
        options.get("opacity_weight"),
        poses,
        progress=progress,
    )
    told("refining", 0.0)
    compacted, refined = made.scene, trained(made.scene)
    strength, reference, before, after = 1.0, None, None, None
    unsound = int((compacted.usable() & ~refined.usable()).sum())
    try:
        told("comparing renders", 0.0)
        views = poses(COMPARED_VIEWS).resized(COMPARED_SIDE)
        device = next(trained.refiner.parameters()).device
        reference = DenseReference(dense.to(device), views)
        before = reference.closeness(compacted.to(device))
    except DataError as error:
        verdict = f"refinement left out: it cannot be compared with the dense scene ({error})"
    if unsound:
        verdict = f"refinement left out: {unsound:,} of {len(refined):,} refined Gaussians are not finite"
    elif reference is not None and before is not None:
        refined, strength, after = as_far_as_it_helps(reference, before, compacted, refined, told)
        verdict = _verdict(before, after, strength)
    helped = before is not None and after is not None and helps(before, after)
    origin = getattr(poses, "origin", "")
    notes = (*made.notes, origin) if origin and origin not in made.notes else made.notes
    scene = refined if helped else compacted
    return RefinedCompaction(scene, compacted, refined, strength, helped, verdict, notes, reference, before, after)


def at_strength(before: Gaussians, after: Gaussians, strength: float) -> Gaussians:
    """The scene that is ``strength``, in [0, 1], of the way from one to another, in the parameters as they are stored;
    a parameter that is infinite in one of them stays as in ``before``."""
    if strength == 1:
        return after
    mixed = (a.lerp(b, strength) for a, b in zip(before.tensors(), after.tensors(), strict=True))
    values = zip(before.items(), mixed, strict=True)
    return Gaussians(**{name: torch.where(value.isfinite(), value, a) for (name, a), value in values})


def as_far_as_it_helps(
    reference: DenseReference,
    before: Closeness,
    compacted: Gaussians,
    refined: Gaussians,
    told: Callable[[str, float], None] = lambda what, share: None,
) -> tuple[Gaussians, float, Closeness]:
    """The scene at the best share of a refiner's residuals, that share and how close it comes; at full strength if
    none helps.

    Args:
        reference: the dense scene's renders.
        before: how close ``compacted`` comes to them.
        compacted, refined: before and after refinement.
        told: called with what is being done and the share done of it, in [0, 1].
    """
    device = reference.pictures[0].device
    tried = _try_strengths(reference, before, compacted.to(device), refined.to(device), told)
    best = min(tried, key=lambda share: tried[share].error)
    strength = best if helps(before, tried[best]) else 1.0
    return at_strength(compacted, refined, strength), strength, tried[strength]


def _try_strengths(
    reference, before: Closeness, compacted: Gaussians, refined: Gaussians, told
) -> dict[float, Closeness]:
    """Closeness by strength; that of 1 is always there."""
    tried: dict[float, Closeness] = {}

    def attempt(strength: float) -> None:
        done = len(tried)
        tried[strength] = reference.closeness(
            at_strength(compacted, refined, strength), lambda share: told("comparing renders", (done + share) / 3)
        )

    attempt(1.0)
    if tried[1.0].errors != before.errors:
        attempt(0.5)
        bottom = bottom_of_parabola(before.error, tried[0.5].error, tried[1.0].error)
        if 0.05 < bottom < 0.95 and abs(bottom - 0.5) > 0.05:  # nearer ones differ by next to nothing
            attempt(bottom)
    told("comparing renders", 1.0)
    return tried


def bottom_of_parabola(at_zero: float, at_half: float, at_one: float) -> float:
    """Where in [0, 1] the parabola through three values is least; NaN if a value is not finite.

    Example:
        >>> round(bottom_of_parabola(0.3**2, 0.2**2, 0.7**2), 6)
        0.3
    """
    if not all(map(math.isfinite, (at_zero, at_half, at_one))):
        return math.nan
    bend = 2 * ((at_one - at_half) - (at_half - at_zero))
    slope = (at_one - at_zero) - bend
    if bend <= 0 or -slope >= 2 * bend:
        return 1.0 if at_one < at_zero else 0.0
    return max(0.0, -slope / (2 * bend))


def helps(before: Closeness, after: Closeness) -> bool:
    """Whether refinement is worth keeping, see :data:`WORTH`."""
    return after.psnr >= before.psnr + WORTH and math.isfinite(before.psnr)


def _verdict(before: Closeness, after: Closeness, strength: float) -> str:
    """What refinement brought, as a line for a person."""
    count = len(before.errors)
    better = sum(new < old for new, old in zip(after.errors, before.errors, strict=True))
    figures = f"{before.psnr:.2f} -> {after.psnr:.2f} dB against the dense scene's renders in {_views(count)}"
    if before.ssim is not None and after.ssim is not None:
        figures += f", SSIM {before.ssim:.3f} -> {after.ssim:.3f}"
    figures += f", worst view {before.worst:.2f} -> {after.worst:.2f} dB, closer in {better} of {count}"
    if helps(before, after):
        share = "" if strength == 1 else f" at {strength:.0%} of its strength"
        return f"refinement{share}: {figures}"
    if after.errors == before.errors:
        return f"refinement left out: it changes nothing, {before.psnr:.2f} dB in {_views(count)}"
    why = "it does not help" if after.psnr <= before.psnr else f"it brings less than {WORTH:g} dB"
    return f"refinement left out, {why}: {figures}"


def _views(count: int) -> str:
    return f"{count} view{'s' if count != 1 else ''}"
