"""The scene of groups: one Gaussian for each."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import quaternions_of
from pointsplat_ns.merging.covariance import MIN_DIVISOR, unpack
from pointsplat_ns.merging.groups import Groups
from pointsplat_ns.merging.participants import Participants
from pointsplat_ns.merging.settings import MergeSettings
from pointsplat_ns.rasterizer.constants import ALPHA_MAX
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.tensors import DOUBLES, INDICES


def scene_maker(participants: Participants, groups: Groups, settings: MergeSettings) -> Callable[[float], Gaussians]:
    """A function from a size change to the scene of K groups; the change is added to log-scales. A group of one member
    is that member to the bit."""
    scene, counts = participants.scene, groups.counts.double()
    single = (counts == 1)[:, None]
    log_scales, quats = _axes(groups.cov, scene.dtype)
    means = torch.where(single, scene.means[groups.first], groups.means.to(scene.dtype))
    quats = torch.where(single, scene.quats[groups.first], quats)

    alphas = deepened(groups.alphas, counts, settings.depth_exponent, settings.max_opacity)
    logits = torch.logit(alphas, 1e-7)[:, None].to(scene.dtype)

    first, group, shares = groups.first, groups.group, groups.shares
    del groups
    sh = _mean_sh(participants, group, shares, single[:, 0])
    own_scales, opacities = scene.scales[first], torch.where(single, scene.opacities[first], logits)

    def make(size_change: float) -> Gaussians:
        scales = torch.where(single, own_scales, (log_scales + size_change).to(scene.dtype))
        return Gaussians(means, scales, quats, opacities, *sh, **scene.traits._asdict())

    return make


def deepened(alphas: Tensor, counts: Tensor, exponent: float, max_opacity: float) -> Tensor:
    """Opacities (n,) of Gaussians of ``counts`` (n,) members: 1 - (1 - alpha)^(counts^exponent), their optical depth
    times counts^exponent."""
    depth = -torch.log1p(-alphas.clamp_max(max_opacity)) * counts.double() ** exponent
    return (-torch.expm1(-depth)).clamp_max(ALPHA_MAX)


def _mean_sh(participants: Participants, group: Tensor, shares: Tensor, single: Tensor) -> tuple[Tensor, Tensor]:
    """SH coefficients (K, 3) and (K, (d+1)^2 - 1, 3): means over the members by their ``shares`` (n,) of their groups
    (n,). Those of a group of one, ``single`` (K,), are its own to the bit."""
    scene = participants.scene
    wide = torch.promote_types(scene.dtype, torch.float32)
    means = []
    for values in (scene.features_dc, scene.features_rest):
        mean = torch.zeros(len(single), *values.shape[1:], dtype=wide, device="cpu")
        for rows in torch.arange(len(group), **INDICES).split(CHUNK):
            own = values[participants.members[rows]].to(wide)
            mean.index_add_(0, group[rows], own * shares[rows].to(wide).view(-1, *[1] * (own.dim() - 1)))
            of_single = single[group[rows]]
            mean[group[rows][of_single]] = own[of_single]
        means.append(mean.to(scene.dtype))
    return means[0], means[1]


def _axes(cov: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Log-scales (n, 3) float64, and quaternions (n, 4) of some dtype, of covariances (n, 6)."""
    scales, quats = torch.empty(len(cov), 3, **DOUBLES), torch.empty(len(cov), 4, dtype=dtype, device="cpu")
    for rows in torch.arange(len(cov), **INDICES).split(CHUNK):
        variances, axes = torch.linalg.eigh(unpack(cov[rows]))
        axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
        # as covariances(): rounding leaves nothing of what is thinner
        variances = torch.maximum(variances, 1e-10 * variances[:, 2:]).clamp_min(MIN_DIVISOR)
        scales[rows] = 0.5 * variances.log()
        quats[rows] = quaternions_of(axes).to(dtype)
    return scales, quats
