"""Optimises a smaller scene against the training photos of the dense scene.

A repair against renders cannot beat the dense scene; photos can. Each step of Adam minimises 0.8
RMSE + 0.2 (1 - SSIM) over every k-th pixel of a photo: few pixels allow many steps. Every eighth
step takes a render of the dense scene from a sampled pose instead, to preserve parts that photos
hardly show.

Every eighth photo is set aside from the steps. The result is accepted if PSNR rises in the photos
of the steps and does not fall in the photos set aside. If it falls there, the result is compared
with a repair, with a tolerance: the dense scene was trained on the photos set aside too, so a small
loss in them means little.

A few times, Gaussians with the largest gradients are split, and merging restores the count.
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
    """Settings of training on photos."""

    adam: AdamSettings = AdamSettings(faster=8.0, damping=0.01)
    """Rates are those of the first step. Without damping, a Gaussian that covers a few pixels of
    the photos moves as far as the others and becomes fog in front of other cameras: a sampled view
    has 13 dB against the dense scene instead of 26 (fox, 30 %). Held-out photos lose 0.2 dB at a
    damping of 0.1, and nothing at 0.01 (fox, vr_project)."""
    means_rate: float = 0.01
    """Learning rate of the means before ``adam.faster``, as a share of each Gaussian's own size.
    With the rate of 3DGS, a share of the scene's extent, and half of ``faster``, a tenth ends 0.3
    dB (fox) and 1.0 dB (vr_project) lower in held-out photos. A hundred times the rate of 3DGS
    gains as much in one of them and loses 2 dB in the other, whose background is far."""
    last_factor: float = 0.05
    """Factor on the rates at the last step. They fall along a half cosine."""
    side: int = 160
    """Longer side of the picture that a step draws, pixels. Many steps on few pixels gain most:
    1,600 steps at 200 pixels take as long as 2,400 at 140, which gain 0.1 dB more in held-out
    photos and 0.5 dB more in sampled views at a tenth (fox, vr_project). At 80 pixels, LPIPS is
    worse."""
    dense_every: int = 8
    """Number of steps per render of the dense scene. With 16, held-out photos gain 0.06 dB and
    sampled views lose 1.1 dB against the dense scene (fox, ray, drone_hall, vr_project at a
    tenth)."""
    most_lost: float = 1.5
    """Maximum loss of PSNR against a repair, in photos set aside, dB. Of 20 trainings at 30 and 50
    % on 7 photos to all (ray, figure, drone_hall, fox), nine are accepted. In held-out photos they
    have 0.7 dB more than a repair on average (the worst 0.4 dB less); the rejected ones have 0.6 dB
    less (the best 0.4 dB more)."""
    large: int = 40_000
    """Number of Gaussians above which a scene is repaired before training, and steps draw more
    pixels, as in a repair of that count. At 160 pixels, a step shows too little of a large scene,
    and its gain is lost elsewhere. PSNR in held-out photos without and with both: 23.3 and 23.5 dB
    (53,574 Gaussians of a plant), 22.4 and 22.9 dB (84,307 of a garden, whose photos are
    renders)."""
    moves: int = 5
    """Number of reallocations (:func:`reallocated`) to places with the largest gradients of the
    means, in units of the Gaussians' size. At a tenth, held-out photos gain 0.5 dB (fox), 0.2 dB
    (vr_project) and nothing (kitchen, whose photos are blurred)."""


PHOTO_REPAIR = PhotoSettings()


@dataclass(frozen=True, eq=False)
class PhotoRepaired:
    """A scene optimised against photos."""

    scene: Gaussians
    """The scene after the last step."""
    before: float
    """Mean PSNR of the baseline in the compared photos, dB. The baseline is the scene before the
    first step, or a repaired one."""
    after: float
    """The same of ``scene``, dB."""
    set_aside_before: float
    """Mean PSNR of the baseline in photos set aside from the steps, dB."""
    set_aside: float
    """The same of ``scene``, dB."""
    used: int
    """Number of photos in the steps."""
    compared: int
    """Number of compared photos."""
    steps: int
    seconds: float
    interrupted: bool
    """Whether Ctrl-C ended it early."""

    def rejection(self, most_lost: float = 0.0) -> Reason | None:
        """Reason to reject the scene in favour of the baseline; None if it is accepted. Photos set
        aside may lose ``most_lost`` dB."""
        if not self.after >= self.before + ACCEPTANCE.min_gain:  # NaN too
            return SMALL_GAIN
        lost = self.set_aside_before - self.set_aside
        return Reason(Cause.WORSE_IN_OTHER_PHOTOS, decibels=lost) if lost > most_lost else None

    def against(self, other: Gaussians, photos: Photos) -> PhotoRepaired:
        """The same scene with another baseline, compared in the same photos."""
        before, set_aside_before = _psnrs(other, photos)
        return replace(self, before=before, set_aside_before=set_aside_before)


def _psnrs(scene: Gaussians, photos: Photos) -> tuple[float, float]:
    """Mean PSNR in the compared photos and in the photos set aside, dB."""
    _, compared, set_aside = _photo_roles(len(photos))
    return mean_psnr(scene, photos, compared), mean_psnr(scene, photos, set_aside)


def _photo_roles(count: int) -> tuple[list[int], list[int], list[int]]:
    """Indices of the photos in the steps, the compared ones among them, and the compared ones of
    the photos set aside."""
    set_aside = list(range(0, count, 8))
    used = sorted({*range(count)} - {*set_aside})
    compared = [used[place] for place in spread_indices(len(used), VIEW_COUNTS.compared)]
    places = spread_indices(len(set_aside), VIEW_COUNTS.compared // 2)
    return used, compared, [set_aside[place] for place in places]


def photo_repair(
    scene: Gaussians,
    dense: Gaussians,
    photos: Photos,
    views: ViewProvider,
    budget: PhotoBudget,
    progress: Callable[[float], None] | None = None,
) -> PhotoRepaired:
    """Optimise a smaller scene against photos. The number of Gaussians does not change. Ctrl-C ends
    the steps early.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        photos: training photos; at least two.
        views: source of views without photos.
        budget: length of the training; not empty.
        progress: called with the share done, in [0, 1].

    Raises:
        DataError: if there are fewer than two photos, or nothing of the scene is visible.
    """
    if len(photos) < 2:
        raise DataError(
            f"{len(photos)} photos to train on; expected at least two, one of them for comparison"
        )
    run = OptimisationRun(budget)
    used, compared, _ = _photo_roles(len(photos))
    before, set_aside_before = _psnrs(scene, photos)
    growth = budget.for_count(len(scene)).growth if len(scene) > PHOTO_REPAIR.large else 1.0
    examples = _examples(photos, used, dense, views, round(growth * PHOTO_REPAIR.side))
    last = run.take(scene, _scenes(scene, examples, views, run), progress)
    after, set_aside = _psnrs(last, photos)
    return PhotoRepaired(
        scene=last,
        before=before,
        after=after,
        set_aside_before=set_aside_before,
        set_aside=set_aside,
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
    """The scene after each step of a run, endlessly."""
    rates = {**RATES, "means": PHOTO_REPAIR.means_rate}
    for turn in counted(1):
        adam = Adam(scene, PHOTO_REPAIR.adam, rates)

        def choose(scene: Gaussians, adam: Adam = adam) -> tuple[float, Tensor]:
            share = cosine_factor(run.done, PHOTO_REPAIR.last_factor)
            return share, size_factors(scene, adam.reach)

        # The last reallocation comes when half of the steps are done.
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
    """Photos, shuffled in every round, and renders of the dense scene, drawn once and reused;
    endless. Their longer side has about ``side`` pixels."""
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
    """Split Gaussians, and merge the scene to its former count.

    Args:
        scene: K Gaussians; not changed.
        pull: (K,) strength of the gradients; Gaussians with the largest are split.
        share: share of the Gaussians to split, in [0, 1].
        views: views for visibility weights, as for :func:`pointsplat_ns.pruning.prune`.

    Returns:
        K Gaussians; ``scene`` if fewer than K are finite.
    """
    strongest = pull.argsort(descending=True)[: round(share * len(scene))]
    doubled = split(scene, strongest)
    if int(doubled.usable().sum()) < len(scene):
        return scene
    return prune(doubled, len(scene), "merge", views)


def split(scene: Gaussians, indices: Tensor) -> Gaussians:
    """Replace n of K Gaussians by two halves, side by side along the longest axis: (K + n), halves
    last. The halves together keep the second moments of the whole."""
    others = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
    others[indices] = False
    whole = scene[indices]
    longest = whole.scales.argmax(dim=1, keepdim=True)  # [n, 1]
    axes = rotation_matrices(whole.quats).gather(2, longest[:, :, None].expand(-1, 3, 1))[:, :, 0]
    offset = 0.5  # distance of a half from the centre, in units of the largest standard deviation
    step = offset * whole.scales.gather(1, longest).exp() * axes
    log_factor = math.log(math.sqrt(1 - offset**2))
    shrinking = torch.zeros_like(whole.scales).scatter_(1, longest, log_factor)
    doubled = scene[torch.cat([others.nonzero()[:, 0], indices, indices])]
    rest = len(scene) - len(indices)
    means = torch.cat([doubled.means[:rest], whole.means + step, whole.means - step])
    halved = whole.scales + shrinking
    return doubled.replace(means=means, scales=torch.cat([doubled.scales[:rest], halved, halved]))
