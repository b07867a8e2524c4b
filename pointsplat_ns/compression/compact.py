"""Prune a scene, refine it, repair it, and keep of that what brings renders closer to the dense scene's."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass, replace

import torch

from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.compression.prune import check_options, prune_scene
from pointsplat_ns.compression.repair import RepairBudget, Repaired, repair
from pointsplat_ns.compression.trained_refiner import TrainedRefiner, default_device
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.looking.windows import WindowRenders, sides_of
from pointsplat_ns.pruning import Keep, method_named, need_usable
from pointsplat_ns.pruning.merging.finishing import top_of_parabola
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.views import Views

MIN_GAIN = 0.1
"""Least gain of PSNR, in dB, for which refinement is kept: the sign of a smaller gain depends on the views."""


MOST_LOSS = 0.05
"""Largest loss of PSNR, in dB, that a refinement or repair may cost in pictures of another size."""

NEARER = 2
"""How many times nearer than the compared views a scene must hold as well."""

CLEAR_GAIN = 0.5
"""Gain of PSNR, in dB, from which on no part of a change is tried in place of the whole."""

KEEP = 0.1
"""Share of the Gaussians that is kept by default."""

NO_REPAIR = RepairBudget("instant")


@dataclass(frozen=True, eq=False)
class Compacted:
    """The result of :func:`pointsplat_ns.compact`: a smaller scene, and whether refining it helped.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", effort="instant")
        >>> result.scene is (result.refined if result.accepted else result.pruned)
        True
    """

    scene: Gaussians
    """``repaired.scene`` if it is better than what it started from; else ``refined`` if that was accepted, else
    ``pruned``."""
    pruned: Gaussians
    """The scene before refinement."""
    refined: Gaussians
    """The scene after refinement at ``strength``."""
    strength: float
    """Share of the refiner's residuals in ``refined``, in (0, 1]: the best one tried, or 1 if none helps."""
    accepted: bool
    """Whether ``refined`` was accepted."""
    verdict: str
    """Text: what refinement gained, or why it was left out; and the same of the repair, if there was one."""
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, where views came from."""
    reference: DenseReference | None
    """Renders of the dense scene that both were compared with; None if there are no views."""
    before: Closeness | None
    """Errors of ``pruned`` against the reference."""
    after: Closeness | None
    """Errors of ``refined`` against the reference; None if it was not compared."""
    seconds: float
    """Total duration."""
    repaired: Repaired | None = None
    """The scene after optimisation against the dense scene's renders; None if there was no time for it."""
    after_repair: Closeness | None = None
    """Errors of the repaired scene; None if there is none."""
    target: str = ""
    """What a search for targets found: at what cost, and what the next cheaper scene would have missed; else empty."""
    interrupted: bool = False
    """Whether that search was interrupted."""

    @property
    def repair_accepted(self) -> bool:
        """Whether ``scene`` is the repaired one."""
        return self.repaired is not None and self.scene is self.repaired.scene

    @property
    def closeness(self) -> Closeness | None:
        """Errors of ``scene`` against the reference; None if nothing was compared."""
        if self.repair_accepted:
            return self.after_repair
        return self.after if self.accepted else self.before

    @property
    def psnr(self) -> float | None:
        """PSNR of ``scene`` against the dense scene's renders, over all pixels of all views, dB; None if nothing was
        compared."""
        return None if self.closeness is None else self.closeness.psnr

    @property
    def views(self) -> Views | None:
        """The views that renders were compared in."""
        return None if self.reference is None else self.reference.views


def compact_scene(
    dense: Gaussians,
    refiner: TrainedRefiner | None = None,
    keep: Keep | str | None = None,
    by: str | None = None,
    sh: str = "all",
    views: ViewSource | None = None,
    progress: Progress = silent,
    clean: bool = False,
    budget: RepairBudget = NO_REPAIR,
) -> Compacted:
    """Make a scene smaller, refine it if a network is given, and repair it as long as the budget says.

    The smaller scene is rendered and compared with renders of the dense scene. A refiner's residuals tend to have the
    right direction but to be too large. So half of the residuals are tried as well, and the share at the minimum of the
    parabola through the errors at 0, 1/2 and 1, where the error is least if renders change linearly with the residuals.
    The best is kept if it :func:`helps` at every size of picture. A requested PSNR (``auto``) is reached before
    refinement, so that it holds in any case. Then the scene is repaired
    (:func:`~pointsplat_ns.compression.repair.repair`), from views other than those compared; that, too, is kept as far
    as it helps.

    Args:
        dense: N Gaussians.
        refiner: None for none. Its device is also used for rendering.
        keep: ratio, count, size or PSNR; by default the refiner's training setting, or a tenth.
        by: a method of :data:`~pointsplat_ns.pruning.METHODS`; by default the refiner's training setting, or merging.
        sh: as for :func:`~pointsplat_ns.compression.prune.prune_scene`.
        views: views that renders are compared in; by default sampled in free space.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].
        clean: as for :func:`~pointsplat_ns.compression.prune.prune_scene`.
        budget: how long to repair.

    Returns:
        Scenes on the device of ``dense``.

    Raises:
        BudgetError, SceneError, PointSplatError: as :func:`~pointsplat_ns.compression.prune.prune_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
    """
    start = time.perf_counter()
    keep, by = resolve_options(refiner, keep, by, sh)
    weight = refiner.settings.opacity_weight if refiner is not None and method_named(by).weighs_opacity else None
    need_usable(dense)
    if refiner is not None:
        _need_sh_degree(dense, sh, refiner)
    views = views or ViewSource(dense)
    smaller = prune_scene(dense, keep, by, sh, weight, views, progress=progress, clean=clean)
    pruned, device = smaller.scene, refiner.device if refiner is not None else default_device()
    judge, before, missing = None, None, ""
    try:
        progress("comparing renders", 0.0)
        judge = Comparison(dense.to(device), views)
        before = judge.reference.closeness(pruned.to(device))
    except DataError as error:
        missing = f"it cannot be compared with the dense scene ({error})"
    accepted = False
    refined, strength, after, verdict = pruned, 1.0, None, f"not refined or repaired: {missing}" if missing else ""
    if refiner is not None:
        progress("refining", 0.0)
        refined = refiner(pruned)
        unsound = int((pruned.usable() & ~refined.usable()).sum())
        if unsound:
            verdict = f"refinement left out: {unsound:,} of {len(refined):,} refined Gaussians are not finite"
        elif missing:
            verdict = f"refinement left out: {missing}"
        elif judge is not None and before is not None:
            change = as_far_as_it_helps(judge, before, pruned, refined, progress)
            after, strength, accepted = change.closeness, change.strength, not change.left_out
            refined = change.scene if accepted else refined
            verdict = _verdict(before, change)
    notes = smaller.notes
    if views.origin and views.origin not in notes:
        notes = (*notes, views.origin)
    scene, close = (refined, after) if accepted else (pruned, before)
    repaired, after_repair = None, None
    if judge is not None and close is not None and not budget.empty and close.psnr < math.inf:
        progress("repairing", 0.0)
        shown = functools.partial(progress, "repairing")
        psnr = judge.reference.psnr_of_covered(close.psnr)
        repaired = repair(scene.to(device), dense.to(device), views, budget, shown, psnr=psnr)
        change = as_far_as_it_helps(judge, close, scene, repaired.scene)
        after_repair = change.closeness
        verdict = "\n".join(filter(None, (verdict, _repair_verdict(close, change, repaired))))
        if not change.left_out:
            scene = change.scene
            repaired = replace(repaired, scene=scene)
    if not verdict and before is not None:
        verdict = f"not repaired: {before.psnr:.2f} dB against the dense scene's renders in {before.where}"
    seconds = time.perf_counter() - start
    reference = None if judge is None else judge.reference
    return Compacted(
        *(scene, pruned, refined, strength, accepted, verdict, notes, reference, before, after, seconds),
        *(repaired, after_repair),
    )


class Comparison:
    """Compares scenes with the dense one: in whole pictures of a middle size, and in windows of the smallest size, the
    full size, and a larger one that stands for nearer places. What helps in the first may harm in none of the others.

    Args:
        dense: N Gaussians, on the device that renders.
        views: where views come from.

    Raises:
        DataError: if there are no views.
    """

    def __init__(self, dense: Gaussians, views: ViewSource):
        self.reference = DenseReference(dense, views.compared())
        self.device = dense.device
        whole = views.whole()
        sides = sides_of(whole.width, whole.height)
        others = (sides[0], sides[-1], NEARER * sides[-1])
        self._others = WindowRenders(dense, whole, others) if len(sides) > 1 else None

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR of a scene in the windows of each size, dB; empty where pictures are no larger than a window."""
        return [] if self._others is None else self._others.psnrs(scene)


def as_compacted(dense: Gaussians, pruned: Gaussians, views: ViewSource, notes: tuple[str, ...]) -> Compacted:
    """What :func:`compact_scene` gives of a scene that is best left as it was pruned.

    Args:
        dense: the scene before.
        pruned: the scene after.
        views: views that renders are compared in.
        notes: of how it was pruned.
    """
    reference = DenseReference(dense, views.compared())
    verdict, before = "not repaired", reference.closeness(pruned)
    return Compacted(pruned, pruned, pruned, 1.0, False, verdict, notes, reference, before, None, 0.0)


def resolve_options(
    refiner: TrainedRefiner | None, keep: Keep | str | None, by: str | None, sh: str
) -> tuple[Keep, str]:
    """Check the options of :func:`compact_scene` that do not depend on the scene, before a scene is read.

    Returns:
        ``keep``, parsed if it is text, and ``by``. If they are None, those that the refiner was trained with; without
        a refiner, a tenth and merging.

    Raises:
        BudgetError, PointSplatError: as :func:`~pointsplat_ns.compression.prune.check_options`.
    """
    usual = (KEEP, "merge") if refiner is None else (refiner.settings.keep, refiner.settings.by)
    by = usual[1] if by is None else by
    return check_options(usual[0] if keep is None else keep, by, sh), by


def _need_sh_degree(dense: Gaussians, sh: str, refiner: TrainedRefiner) -> None:
    """Refuse, before the long computations, a scene whose SH degree exceeds the refiner's."""
    limit = refiner.network.config.sh_degree
    if dense.sh_degree > limit and (sh == "all" or (sh.isdigit() and int(sh) > limit)):
        raise SceneError(
            f"the scene has SH degree {dense.sh_degree}; the refiner {refiner.source} was built for at most {limit}; "
            f"cut it with --sh {limit}"
        )


def at_strength(before: Gaussians, after: Gaussians, strength: float) -> Gaussians:
    """The linear interpolation between two scenes, at ``strength`` in [0, 1], of the parameters as stored (log-scales,
    logits). A value that is infinite in one of them stays as in ``before``."""
    if strength == 1:
        return after
    mixed = (a.lerp(b, strength) for a, b in zip(before.tensors(), after.tensors(), strict=True))
    values = zip(before.items(), mixed, strict=True)
    return Gaussians(**{name: torch.where(value.isfinite(), value, a) for (name, a), value in values})


@dataclass(frozen=True, eq=False)
class Change:
    """As much of a refinement or repair as helps."""

    scene: Gaussians
    """The scene with it; the one before, if nothing of it helps."""
    strength: float
    """Share of the change, in (0, 1]; 1 if nothing of it helps."""
    closeness: Closeness
    """Errors of ``scene``; of the whole change, if nothing of it helps."""
    left_out: str
    """Why nothing of it is taken; empty if it helps."""


def as_far_as_it_helps(
    judge: Comparison, before: Closeness, old: Gaussians, new: Gaussians, progress: Progress = silent
) -> Change:
    """The best share of a refinement or repair that helps; a scene on the device of ``old``.

    Args:
        judge: what compares.
        before: errors of ``old``.
        old, new: the scenes before and after.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].
    """
    start, end = old.to(judge.device), new.to(judge.device)
    tried: dict[float, Closeness] = {}

    @functools.cache
    def least() -> list[float]:
        """What a share of the change must reach in pictures of other sizes; rendered only if one helps at all."""
        return [psnr - MOST_LOSS for psnr in judge.psnrs(start)]

    def attempt(strength: float) -> bool:
        """Whether a share of the change helps."""
        done = len(tried)
        scene = at_strength(start, end, strength)
        tried[strength] = judge.reference.closeness(
            scene, lambda share: progress("comparing renders", (done + share) / 3)
        )
        if not helps(before, tried[strength]):
            return False
        return all(psnr >= bound for bound, psnr in zip(least(), judge.psnrs(scene), strict=True))

    helping = [1.0] if attempt(1.0) else []
    if tried[1.0].errors != before.errors and (not helping or tried[1.0].psnr < before.psnr + CLEAR_GAIN):
        helping += [0.5] if attempt(0.5) else []
        bottom = bottom_of_parabola(before.error, tried[0.5].error, tried[1.0].error)
        if 0.05 < bottom < 0.95 and abs(bottom - 0.5) > 0.05:  # closer ones hardly differ from those tried
            helping += [bottom] if attempt(bottom) else []
    progress("comparing renders", 1.0)
    if not helping:
        return Change(old, 1.0, tried[1.0], _left_out(before, tried[1.0]))
    strength = min(helping, key=lambda share: tried[share].error)
    return Change(at_strength(start, end, strength).to(old.device), strength, tried[strength], "")


def bottom_of_parabola(at_zero: float, at_half: float, at_one: float) -> float:
    """The position in [0, 1] where the parabola through values at 0, 1/2 and 1 is least; NaN if one is not finite.

    Example:
        >>> round(bottom_of_parabola(0.3**2, 0.2**2, 0.7**2), 6)
        0.3
    """
    if not all(map(math.isfinite, (at_zero, at_half, at_one))):
        return math.nan
    return top_of_parabola((0.0, 0.5, 1.0), [-at_zero, -at_half, -at_one], margin=0.0)


def helps(before: Closeness, after: Closeness) -> bool:
    """Whether a refinement or repair is worth keeping: it gains :data:`MIN_GAIN`, and is closer in at least half of the
    views, as a gain over all pixels may be that of a few views, paid for by the others."""
    return _gains(before, after) and 2 * _closer_in(before, after) >= len(before.errors)


def _gains(before: Closeness, after: Closeness) -> bool:
    return after.psnr >= before.psnr + MIN_GAIN and math.isfinite(before.psnr)


def _figures(before: Closeness, after: Closeness) -> str:
    """Errors before and after in words."""
    count, better = len(before.errors), _closer_in(before, after)
    figures = f"{before.psnr:.2f} -> {after.psnr:.2f} dB against the dense scene's renders in {before.where}"
    if before.ssim is not None and after.ssim is not None:
        figures += f", SSIM {before.ssim:.3f} -> {after.ssim:.3f}"
    return f"{figures}, worst view {before.worst:.2f} -> {after.worst:.2f} dB, closer in {better} of {count}"


def _closer_in(before: Closeness, after: Closeness) -> int:
    """Number of views in which a scene has come closer."""
    return sum(new < old for new, old in zip(after.errors, before.errors, strict=True))


def _left_out(before: Closeness, after: Closeness) -> str:
    """Why what brought these errors was left out."""
    if helps(before, after):
        return "it harms pictures of another size"
    if _gains(before, after):
        return "it is farther in most views"
    return "it does not help" if after.psnr <= before.psnr else f"it brings less than {MIN_GAIN:g} dB"


def _verdict(before: Closeness, change: Change) -> str:
    """One line of text: what refinement gained, or why it was left out."""
    figures = _figures(before, change.closeness)
    if not change.left_out:
        return f"refinement{_at(change.strength)}: {figures}"
    if change.closeness.errors == before.errors:
        return f"refinement left out: it changes nothing, {before.psnr:.2f} dB in {before.where}"
    return f"refinement left out, {change.left_out}: {figures}"


def _repair_verdict(before: Closeness, change: Change, repaired: Repaired) -> str:
    """One line of text: what the repair gained and cost, or why it was left out."""
    cost = f"{repaired.steps} steps in {repaired.seconds:.1f} s" + (", interrupted" if repaired.interrupted else "")
    figures = _figures(before, change.closeness)
    if not change.left_out:
        return f"repair{_at(change.strength)}, {cost}: {figures}"
    return f"repair left out, {change.left_out} ({cost}): {figures}"


def _at(strength: float) -> str:
    """A strength in words, if it is not the whole."""
    return "" if strength == 1 else f" at {strength:.0%} of its strength"
