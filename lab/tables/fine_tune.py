"""Optimises the Gaussians of one pruned scene: the recovery step of the image-driven baselines."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from pointsplat_ns.compression.optimiser import RATES, Adam, AdamSettings, Example, optimised
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views


def fine_tune(
    scene: Gaussians,
    views: Views,
    targets: Gaussians | Sequence[Tensor],
    steps: int,
    seed: int,
    progress: Callable[[float], None],
) -> Gaussians:
    """Optimise the parameters of a scene so that its renders match target images. The number of Gaussians is kept.

    Each step renders one view and takes one step of Adam on 0.8 L1 + 0.2 (1 - SSIM). Each view comes once before any
    is repeated. Values that are not finite (the logit of opacity 1, the log-scale of a flat axis) do not change.

    Args:
        scene: K Gaussians.
        views: C views.
        targets: the dense scene, whose renders are the targets; or C images (H, W, 3) in [0, 1], one per view.
        steps: number of optimisation steps.
        seed: seed of the order of the views.
        progress: called with the share done, in [0, 1].

    Returns:
        K Gaussians; ``scene`` is not changed.

    Raises:
        DataError: if there is no view, or the images do not fit the views.
    """
    if len(views) == 0:
        raise DataError("no view to fine-tune on; expected at least one pose")
    if not isinstance(targets, Gaussians) and len(targets) != len(views):
        raise DataError(f"{len(targets)} pictures for {len(views)} views; expected one each")
    scene = scene.map(lambda value: value.detach().clone())
    scenes = optimised(scene, Adam(scene, AdamSettings(), RATES), _examples(views, targets, scene, seed))
    for step in range(steps):
        scene = next(scenes)
        progress((step + 1) / steps)
    return scene


def _examples(views: Views, targets: Gaussians | Sequence[Tensor], like: Gaussians, seed: int) -> Iterator[Example]:
    """Views in random order, each once before any is repeated, and their target images; without end."""
    images: dict[int, Tensor] = {}
    generator = random.Random(seed)
    while True:
        for index in reversed(generator.sample(range(len(views)), len(views))):
            if index not in images:
                images[index] = _target(targets, views, index, like)
            yield Example(views[index], images[index])


def _target(targets: Gaussians | Sequence[Tensor], views: Views, index: int, like: Gaussians) -> Tensor:
    if isinstance(targets, Gaussians):
        with torch.no_grad():
            return render(targets, views[index])
    image = targets[index].to(like.means)
    if tuple(image.shape) != (views.height, views.width, 3):
        raise DataError(f"picture {index} has shape {tuple(image.shape)}; expected {(views.height, views.width, 3)}")
    return image
