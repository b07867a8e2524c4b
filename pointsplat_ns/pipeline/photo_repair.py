"""Optimises a smaller scene against the photos that the dense scene was trained on.

A repair against renders of the dense scene cannot be better than these. Photos hold more. Each step
takes every k-th pixel of a photo and a step of Adam on 0.8 RMSE + 0.2 (1 - SSIM). Few pixels allow
many steps. Every eighth step takes a render of the dense scene from a sampled pose, which holds the
parts that photos show little of.

Every eighth photo takes part in no step. The result is kept if PSNR rises in photos of the steps,
and does not fall in these. Where it falls, the result is compared with a repair. The dense scene
was trained on these photos, too, and knows them better than either does, so a small loss says
little.

A few times, Gaussians are split where the loss pulls at them most, and merging makes them as many
as before.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count as counted
from itertools import cycle, islice

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.pipeline.acceptance import ACCEPTANCE, SMALL_GAIN
from pointsplat_ns.pipeline.optimiser import RATES, Adam, AdamSettings, optimised, size_factors
from pointsplat_ns.pipeline.photos.examples import (
    Example,
    Photos,
    every_kth_pixel,
    mean_psnr,
    render_of,
)
from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.repair import OptimisationRun
from pointsplat_ns.pipeline.repair_budget import PhotoBudget
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.pruning import prune
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.view_sampling.sampler import Sampler


@dataclass(frozen=True)
class PhotoSettings:
    """Settings of the optimisation."""

    adam: AdamSettings = AdamSettings(faster=8.0, damping=0.01)
    """The rates are those of the first step. Without damping, a Gaussian that photos show in a few
    pixels moves as far as others, and becomes a fog before cameras that no photo has: a sampled
    view has 13 dB against the dense scene in place of 26 (fox, 30 %). Held-out photos lose 0.2 dB
    at a damping of 0.1, and nothing at 0.01 (fox, vr_project)."""
    means_rate: float = 0.01
    """Learning rate of the means, before that factor: a share of each Gaussian's own size. With
    3DGS' rate, a share of the scene's extent, and half of the factor, a tenth ends 0.3 dB (fox) and
    1.0 dB (vr_project) lower in held-out photos. A hundred times that share gains as much in one of
    them and loses 2 dB in the other, whose background is far."""
    last_factor: float = 0.05
    """Factor on the first rates at the last step. They fall along a half cosine."""
    side: int = 160
    """Longer side of what a step draws of a photo or of a sampled view, pixels. Many steps on few
    pixels gain most: in the time of 1,600 steps on 200 there are 2,400 on 140, and a tenth has 0.1
    dB more in held-out photos and 0.5 dB more in sampled views (fox, vr_project). On 80, LPIPS is
    worse."""
    dense_every: int = 8
    """One step of this many takes a render of the dense scene. With every sixteenth, held-out
    photos gain 0.06 dB, and sampled views lose 1.1 dB against the dense scene (fox, ray,
    drone_hall, vr_project at a tenth)."""
    most_lost: float = 1.5
    """Largest fall of PSNR below a repair, in photos of no step, with which a result is kept, dB.
    Of 20 trainings at 30 and 50 % on 7 photos to all (ray, figure, drone_hall, fox) nine are kept,
    which have 0.7 dB more in held-out photos than a repair, one of them 0.4 dB less; the others
    have 0.6 dB less on average, and 0.4 dB more at most."""
    large: int = 40_000
    """Number of Gaussians above which a scene is repaired before it is trained, and steps draw more
    pixels: as a repair does for so many. 160 pixels show too little of it at once, and what one
    step gains elsewhere is lost. In held-out photos, without and with both: 53,574 of a plant 23.3
    and 23.5 dB, 84,307 of a garden, whose photos are renders, 22.4 and 22.9."""
    moves: int = 5
    """Number of times that Gaussians are moved (:func:`reallocated`) to where the gradients
    by their means, in units of their size, are largest. At a tenth, held-out photos gain 0.5 dB
    (fox), 0.2 dB (vr_project) and nothing (kitchen, whose photos are blurred)."""


PHOTO_REPAIR = PhotoSettings()


@dataclass(frozen=True, eq=False)
class PhotoRepaired:
    """A scene that was optimised against photos."""

    scene: Gaussians
    """The scene after the last step."""
    before: float
    """Mean PSNR of another scene in the compared photos, dB: of that before the first step, or of a
    repaired one."""
    after: float
    """The same of ``scene``, dB."""
    unseen_before: float
    """Mean PSNR of that scene in photos that take part in no step, dB."""
    unseen: float
    """The same of ``scene``, dB."""
    used: int
    """Number of photos of the steps."""
    compared: int
    """Number of the compared photos."""
    steps: int
    seconds: float
    interrupted: bool
    """Whether Ctrl-C ended it early."""

    def rejection(self, most_lost: float = 0.0) -> Reason | None:
        """Why the scene does not replace the other, if photos of no step may lose that many dB;
        None if it does."""
        if not self.after >= self.before + ACCEPTANCE.min_gain:  # NaN too
            return SMALL_GAIN
        lost = self.unseen_before - self.unseen
        return Reason(Cause.WORSE_IN_OTHER_PHOTOS, decibels=lost) if lost > most_lost else None

    def beside(self, other: Gaussians, photos: Photos) -> PhotoRepaired:
        """The same, compared with another scene in the same photos."""
        before, unseen_before = _psnrs(other, photos)
        return replace(self, before=before, unseen_before=unseen_before)


def _psnrs(scene: Gaussians, photos: Photos) -> tuple[float, float]:
    """Mean PSNR in the compared photos, and in photos that take part in no step, dB."""
    _, compared, unseen = _roles(len(photos))
    return mean_psnr(scene, photos, compared), mean_psnr(scene, photos, unseen)


def _roles(count: int) -> tuple[list[int], list[int], list[int]]:
    """Indices of the photos of the steps, of those of them that are compared, and of photos of no
    step to compare."""
    apart = list(range(0, count, 8))
    used = sorted({*range(count)} - {*apart})
    compared = [used[place] for place in spread_indices(len(used), VIEW_COUNTS.compared)]
    return (
        used,
        compared,
        [apart[place] for place in spread_indices(len(apart), VIEW_COUNTS.compared // 2)],
    )


def photo_repair(
    scene: Gaussians,
    dense: Gaussians,
    photos: Photos,
    views: ViewProvider,
    budget: PhotoBudget,
    progress: Callable[[float], None] | None = None,
) -> PhotoRepaired:
    """Optimise a smaller scene against photos; its number of Gaussians does not change. Ctrl-C ends
    it early.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        photos: training photos; at least two.
        views: source of views without photos.
        budget: length; not empty.
        progress: called with the share done, in [0, 1].

    Raises:
        DataError: if there are fewer than two photos, or nothing of the scene is visible.
    """
    if len(photos) < 2:
        raise DataError(
            f"{len(photos)} photos to train on; expected at least two, one of them to compare with"
        )
    run = OptimisationRun(budget)
    used, compared, _ = _roles(len(photos))
    before, unseen_before = _psnrs(scene, photos)
    growth = budget.for_count(len(scene)).growth if len(scene) > PHOTO_REPAIR.large else 1.0
    examples = _examples(photos, used, dense, views, round(growth * PHOTO_REPAIR.side))
    last = run.take(scene, _scenes(scene, examples, views, run), progress)
    after, unseen = _psnrs(last, photos)
    return PhotoRepaired(
        scene=last,
        before=before,
        after=after,
        unseen_before=unseen_before,
        unseen=unseen,
        used=len(used),
        compared=len(compared),
        steps=run.count,
        seconds=run.seconds,
        interrupted=run.interrupted,
    )


def _scenes(
    scene: Gaussians,
    examples: Iterator[Callable[[], Example]],
    views: ViewProvider,
    run: OptimisationRun,
) -> Iterator[Gaussians]:
    """The scene after each step of a run, without end."""
    rates = {**RATES, "means": PHOTO_REPAIR.means_rate}
    for turn in counted(1):
        adam = Adam(scene, PHOTO_REPAIR.adam, rates)

        def choose(scene: Gaussians, adam: Adam = adam) -> tuple[float, Tensor]:
            return cosine_factor(run.done, PHOTO_REPAIR.last_factor), size_factors(
                scene, adam.reach
            )

        # the last time when half of the steps are done
        until = 0.5 * turn / PHOTO_REPAIR.moves if turn <= PHOTO_REPAIR.moves else math.inf
        for stepped in optimised(scene, adam, examples, choose):
            yield (scene := stepped)
            if run.done >= until:
                break
        pull = adam.root_mean_square("means") * size_factors(scene, adam.reach)[:, 0]
        scene = reallocated(scene, pull, 0.2, views.for_merging())


def _examples(
    photos: Photos, used: list[int], dense: Gaussians, views: ViewProvider, side: int
) -> Iterator[Callable[[], Example]]:
    """Photos, each once before any is repeated, and renders of the dense scene, each drawn once;
    without end. Their longer side has about ``side`` pixels."""
    generator = random.Random(0)
    sampled = islice(views.sampled(drawn_side=side), VIEW_COUNTS.stepped)
    renders = cycle(functools.cache(functools.partial(render_of, dense, view)) for view in sampled)
    shown = (index for _ in counted() for index in generator.sample(used, len(used)))
    for step in counted(1):
        if step % PHOTO_REPAIR.dense_every:
            part = every_kth_pixel(photos[next(shown)], side, dense.device, generator)
            yield functools.partial(Example, *part)
        else:
            yield next(renders)


@torch.no_grad()
def reallocated(scene: Gaussians, pull: Tensor, share: float, views: Views | Sampler) -> Gaussians:
    """Split Gaussians, and merge the scene to as many as there were.

    Args:
        scene: K Gaussians; not changed.
        pull: (K,), those with the largest are split.
        share: of the Gaussians that are split, in [0, 1].
        views: views that weigh errors of merging, as for :func:`pointsplat_ns.pruning.prune`.

    Returns:
        K Gaussians; ``scene`` if fewer than K are finite.
    """
    strongest = pull.argsort(descending=True)[: round(share * len(scene))]
    doubled = split(scene, strongest)
    if int(doubled.usable().sum()) < len(scene):
        return scene
    return prune(doubled, len(scene), "merge", views)


def split(scene: Gaussians, indices: Tensor) -> Gaussians:
    """A scene (K) in which some Gaussians (n,) are replaced by two halves each, side by side along
    their longest axis: (K + n), halves last. Both together have the second moments of the whole."""
    others = torch.ones(len(scene), dtype=torch.bool, device=scene.device).index_fill(
        0, indices, False
    )
    whole = scene[indices]
    longest = whole.scales.argmax(dim=1, keepdim=True)  # [n, 1]
    axes = rotation_matrices(whole.quats).gather(2, longest[:, :, None].expand(-1, 3, 1))[:, :, 0]
    apart = 0.5  # distance of each half from the centre, in the largest standard deviations
    step = apart * whole.scales.gather(1, longest).exp() * axes
    shrinking = torch.zeros_like(whole.scales).scatter_(
        1, longest, math.log(math.sqrt(1 - apart**2))
    )
    doubled = scene[torch.cat([others.nonzero()[:, 0], indices, indices])]
    rest = len(scene) - len(indices)
    means = torch.cat([doubled.means[:rest], whole.means + step, whole.means - step])
    return doubled.replace(
        means=means, scales=torch.cat([doubled.scales[:rest], *[whole.scales + shrinking] * 2])
    )
