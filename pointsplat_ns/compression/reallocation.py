"""Moves Gaussians to where a loss pulls at them: some become two each, and elsewhere the cheapest pairs become one."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.looking.sampling import Sampler
from pointsplat_ns.pruning import prune
from pointsplat_ns.views import Views

APART = 0.5
"""Distance of each half from the centre of a Gaussian that is split, in its largest standard deviations."""

NARROWER = math.sqrt(1 - APART**2)
"""Largest standard deviation of a half, as a share of the whole's: both together have the whole's second moments."""


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
    """A scene (K) in which some Gaussians (n,) are replaced by two halves each, side by side along their longest axis:
    (K + n), halves last."""
    others = torch.ones(len(scene), dtype=torch.bool, device=scene.device).index_fill(0, indices, False)
    whole = scene[indices]
    longest = whole.scales.argmax(dim=1, keepdim=True)  # [n, 1]
    axes = rotation_matrices(whole.quats).gather(2, longest[:, :, None].expand(-1, 3, 1))[:, :, 0]
    step = APART * whole.scales.gather(1, longest).exp() * axes
    shrinking = torch.zeros_like(whole.scales).scatter_(1, longest, math.log(NARROWER))
    doubled = scene[torch.cat([others.nonzero()[:, 0], indices, indices])]
    rest = len(scene) - len(indices)
    means = torch.cat([doubled.means[:rest], whole.means + step, whole.means - step])
    return doubled.replace(means=means, scales=torch.cat([doubled.scales[:rest], *[whole.scales + shrinking] * 2]))
