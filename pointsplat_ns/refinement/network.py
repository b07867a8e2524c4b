"""The refiner's network, from the features of a scene to residuals: encoder, Point Transformer V3,
heads.

Point Transformer V3 (X. Wu et al., "Point Transformer V3: Simpler, Faster, Stronger", CVPR 2024) is
a U-net of attention blocks over serialized points, here in plain torch. Shapes: N Gaussians, M
points of a level, C channels, H heads, K points of a patch.

Parameters are float32, whatever torch's default is, on the device that the network's constructor
has entered.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pointsplat_ns.refinement.config import RefinerConfig
from pointsplat_ns.refinement.local_units import APPEARANCE, GEOMETRY, LocalFeatures
from pointsplat_ns.refinement.sparse_ops import (
    Order,
    by_patches,
    by_rows,
    rows_at_a_time,
    segment_max,
    segment_mean,
    submanifold_conv,
)
from pointsplat_ns.refinement.structure import GridLevel, Structure
from pointsplat_ns.system.tensors import of_network
from pointsplat_ns.system.threads import one_thread


def linear(in_channels: int, out_channels: int) -> nn.Linear:
    """``[N, Cin] -> [N, Cout]``."""
    return nn.Linear(in_channels, out_channels, **of_network())


def zero_linear(in_channels: int, out_channels: int) -> nn.Linear:
    """The same, zero before training."""
    layer = linear(in_channels, out_channels)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def layer_norm(channels: int) -> nn.LayerNorm:
    """Normalises each point by itself: ``[N, C] -> [N, C]``."""
    return nn.LayerNorm(channels, **of_network())


class BatchNorm(nn.BatchNorm1d):
    """Batch norm over points: ``[N, C] -> [N, C]``.

    Unlike in torch's, a single point, which has no variance, uses running statistics. These start
    as averages, until the momentum exceeds one over the number of steps: after a short training,
    initial values do not count.
    """

    def __init__(self, channels: int):
        super().__init__(channels, eps=1e-3, momentum=0.01, **of_network())

    def forward(self, x: Tensor) -> Tensor:
        use_batch = self.training and x.shape[0] > 1
        momentum = 0.01
        if use_batch and self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
            momentum = max(momentum, 1.0 / float(self.num_batches_tracked))
        return F.batch_norm(
            x,
            self.running_mean,
            self.running_var,
            self.weight,
            self.bias,
            use_batch,
            momentum,
            self.eps,
        )


class SceneNorm(nn.Module):
    """Normalises each channel over the points of the current scene: ``[N, C] -> [N, C]``.

    There are no running statistics. A single point, which has no variance, is its own mean.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels, **of_network()))
        self.bias = nn.Parameter(torch.zeros(channels, **of_network()))

    def forward(self, x: Tensor) -> Tensor:
        if x.shape[0] < 2:
            return (x - x) * self.weight + self.bias
        with one_thread():  # the same rounding for any number of threads
            return F.batch_norm(x, None, None, self.weight, self.bias, True, 0.0, 1e-3)


NORMS: dict[str, Callable[[int], nn.Module]] = {
    "scene": SceneNorm,
    "batch": BatchNorm,
    "layer": layer_norm,
}
"""By the names of ``RefinerConfig.norm``."""


@dataclass(frozen=True)
class Features:
    """The network's input for N Gaussians: finite, of order 1 unless raw, the same for quaternions
    q and -q."""

    positions: Tensor  # [N, 3] unit cube, centred at 0
    quats: Tensor  # [N, 4] unit wxyz, first non-zero component positive
    scales: Tensor  # [N, 3] log-scale in the unit cube, centred and scaled unless raw
    opacities: Tensor  # [N, 1] logit, scaled unless raw
    features_dc: Tensor  # [N, 3]
    features_rest: Tensor  # [N, 3 * num_rest] zero above the scene's degree
    quat_scale: Tensor  # [N, 1] signed length: the scene's quaternion is this times ``quats``

    @property
    def geometry(self) -> Tensor:
        """Input of the geometry branch. # [N, 10]"""
        return torch.cat([self.positions, self.quats, self.scales], dim=1)

    @property
    def appearance(self) -> Tensor:
        """Input of the appearance branch, without the SH coefficients of degree 1 and higher.
        # [N, 4]"""
        return torch.cat([self.opacities, self.features_dc], dim=1)


class DualBranchEncoder(nn.Module):
    """Geometry gated by appearance.

    ``f = softmax(phi_a(f_a) + delta) * (phi_p(f_p) + delta)`` over channels, with
    ``f_p = (means, quats, scales)``, ``f_a = (opacity, dc, reduced rest)`` and ``delta =
    psi(means)`` (paper eq. 4 to 6). Without appearance the gate is 1, without position ``delta`` is
    0 (Table 4). With ``unit_gate`` the result is multiplied by the number of channels.
    """

    def __init__(self, config: RefinerConfig):
        super().__init__()
        dim = config.feature_dim
        norm = NORMS[config.norm]
        local = config.units == "local"
        geometry, appearance = (GEOMETRY, APPEARANCE) if local else (10, 4)
        self.gate_gain = dim if config.unit_gate else 1
        self.geometry = nn.Sequential(
            linear(geometry, dim), norm(dim), nn.ReLU(inplace=True), linear(dim, dim)
        )
        self.position = self.color = self.appearance = None
        if config.use_position:
            self.position = nn.Sequential(linear(3, dim), nn.ReLU(inplace=True), linear(dim, dim))
        if config.use_appearance:
            hidden = config.color_hidden
            reduced = config.color_dim if config.num_rest else 0
            if config.num_rest:
                self.color = nn.Sequential(
                    linear(3 * config.num_rest, hidden),
                    nn.ReLU(inplace=True),
                    linear(hidden, reduced),
                )
            self.appearance = nn.Sequential(
                linear(appearance + reduced, dim),
                norm(dim),
                nn.ReLU(inplace=True),
                linear(dim, dim),
            )

    def forward(self, features: Features | LocalFeatures) -> Tensor:
        """Encoded Gaussians. # [N, feature_dim]"""
        geometry = self.geometry(features.geometry)
        delta = 0.0 if self.position is None else self.position(features.positions)
        if self.appearance is None:
            return geometry + delta
        parts = [features.appearance]
        if self.color is not None:
            parts.append(self.color(features.features_rest))
        gate = torch.softmax(self.appearance(torch.cat(parts, dim=1)) + delta, dim=1)
        return self.gate_gain * gate * (geometry + delta)


class ConcatEncoder(nn.Module):
    """All attributes side by side, as SplatFormer feeds them: 59 numbers at SH degree 3, or 77 in
    local units. No parameters."""

    def forward(self, features: Features | LocalFeatures) -> Tensor:
        """Concatenated Gaussians. # [N, encoded_dim]"""
        f = features
        if isinstance(f, LocalFeatures):
            return torch.cat([f.geometry, f.appearance, f.features_rest], dim=1)
        return torch.cat(
            [f.positions, f.scales, f.quats, f.opacities, f.features_dc, f.features_rest], dim=1
        )


class SubmanifoldConv(nn.Module):
    """3x3x3 convolution over the occupied cells of a level.

    Points that share a cell are averaged first and receive the same result.
    """

    def __init__(self, in_channels: int, out_channels: int, bias: bool = True):
        super().__init__()
        bound = (27 * in_channels) ** -0.5
        self.weight = nn.Parameter(
            torch.empty(27, in_channels, out_channels, **of_network()).uniform_(-bound, bound)
        )
        self.bias = nn.Parameter(torch.zeros(out_channels, **of_network())) if bias else None

    def forward(
        self, x: Tensor, level: GridLevel, then: Callable[[Tensor], Tensor] | None = None
    ) -> Tensor:
        """``[M, Cin] -> [M, Cout]``; ``then`` is applied row by row, to the result of each cell
        once."""
        if level.cell_of is not None:
            x = segment_mean(x, level.cell_of, level.num_cells)
        x = submanifold_conv(x, self.weight, level.neighbours)
        if self.bias is not None:
            x = x.add_(self.bias)
        if then is not None:
            x = by_rows(then, x, rows_at_a_time(x.shape[1]))
        return x if level.cell_of is None else x.index_select(0, level.cell_of)


class PatchAttention(nn.Module):
    """Multi-head attention among the K points of each patch."""

    def __init__(self, channels: int, heads: int, patch: int):
        super().__init__()
        self.heads = heads
        self.patch = patch
        self.qkv = linear(channels, 3 * channels)
        self.proj = linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """``[P * K, C] -> [P * K, C]``, patches in a row; fewer than K points are one patch."""
        points, channels = x.shape
        size = min(self.patch, points)
        q, k, v = (
            self.qkv(x).view(-1, size, 3, self.heads, channels // self.heads).permute(2, 0, 3, 1, 4)
        )
        # (P, H, K, C / H) each
        return self.proj(
            F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(-1, channels)
        )


class Block(nn.Module):
    """Convolution as positional encoding, attention, MLP: each with a residual connection."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_path: float):
        super().__init__()
        self.drop_path = drop_path
        self.conv = SubmanifoldConv(channels, channels)
        self.conv_out = nn.Sequential(linear(channels, channels), layer_norm(channels))
        self.norm1 = layer_norm(channels)
        self.attention = PatchAttention(channels, heads, config.patch)
        self.norm2 = layer_norm(channels)
        self.hidden = channels * config.mlp_ratio
        self.mlp = nn.Sequential(
            linear(channels, self.hidden), nn.GELU(), linear(self.hidden, channels)
        )

    def forward(self, x: Tensor, level: GridLevel, order: Order | None) -> Tensor:
        """``[M, C] -> [M, C]``; ``order`` along the curve that the patches follow, None for memory
        order."""
        x = self.conv(x, level, then=self.conv_out).add_(x)
        attended = by_patches(
            lambda part: self.attention(self.norm1(part)),
            x,
            3 * x.shape[1],
            self.attention.patch,
            order,
        )
        x = self._drop(attended).add_(x)
        return self._drop(by_patches(lambda part: self.mlp(self.norm2(part)), x, self.hidden)).add_(
            x
        )

    def _drop(self, x: Tensor) -> Tensor:
        """In training, random rows are set to zero and the others scaled up, so that the expected
        value is kept."""
        if not self.training or self.drop_path == 0:
            return x
        keep = 1 - self.drop_path
        return x * (torch.rand(len(x), 1, device=x.device, dtype=x.dtype) < keep).to(x.dtype).div_(
            keep
        )


class TransformerStage(nn.Module):
    """Blocks of one level, each along another curve."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_paths: list[float]):
        super().__init__()
        self.blocks = nn.ModuleList(Block(channels, heads, config, rate) for rate in drop_paths)

    def forward(self, x: Tensor, level: GridLevel) -> Tensor:
        """``[M, C] -> [M, C]``; the order of curves is shuffled in training."""
        curves = (
            torch.randperm(len(level.orders), device="cpu").tolist()
            if self.training
            else range(len(level.orders))
        )
        for i, block in enumerate(self.blocks):
            x = block(x, level, level.orders[curves[i % len(curves)]])
        return x


class Pool(nn.Module):
    """To the next coarser level: project, maximum over each cell, normalise."""

    def __init__(self, in_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.proj = linear(in_channels, out_channels)
        self.out = nn.Sequential(NORMS[norm](out_channels), nn.GELU())

    def forward(self, x: Tensor, cluster: Tensor, size: int) -> Tensor:
        """``[M, Cin] -> [size, Cout]``."""
        x = self.proj(x)
        return self.out(x if len(x) == size else segment_max(x, cluster, size))


class Unpool(nn.Module):
    """To the next finer level: the features of each point's cell are added to its own."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.coarse = nn.Sequential(
            linear(in_channels, out_channels), NORMS[norm](out_channels), nn.GELU()
        )
        self.skip = nn.Sequential(
            linear(skip_channels, out_channels), NORMS[norm](out_channels), nn.GELU()
        )

    def forward(self, x: Tensor, skip: Tensor, cluster: Tensor) -> Tensor:
        """``[size, Cin], [M, Cskip] -> [M, Cout]``."""
        return self.coarse(x).index_select(0, cluster).add_(self.skip(skip))


class PointTransformer(nn.Module):
    """Encoder stages from fine to coarse, decoder stages back, with skip connections between equal
    levels."""

    def __init__(self, in_channels: int, config: RefinerConfig):
        super().__init__()
        enc = config.enc_channels
        dec = config.dec_channels
        norm = config.norm

        def stages(
            channels: tuple[int, ...], heads: tuple[int, ...], depths: tuple[int, ...]
        ) -> nn.ModuleList:
            """Blocks are dropped at rates that rise evenly from 0 to ``drop_path``."""
            rates = iter(
                [config.drop_path * i / max(1, sum(depths) - 1) for i in range(sum(depths))]
            )
            each = zip(channels, heads, depths, strict=True)
            return nn.ModuleList(
                TransformerStage(c, h, config, [next(rates) for _ in range(d)]) for c, h, d in each
            )

        conv = config.stem == "conv"
        self.embed = (
            SubmanifoldConv(in_channels, enc[0], bias=False)
            if conv
            else linear(in_channels, enc[0])
        )
        self.embed_out = nn.Sequential(NORMS[norm](enc[0]), nn.GELU())
        self.encoder = stages(enc, config.enc_heads, config.enc_depths)
        self.pools = nn.ModuleList(Pool(a, b, norm) for a, b in zip(enc[:-1], enc[1:], strict=True))
        self.unpools = nn.ModuleList(
            Unpool(a, skip, out, norm)
            for a, skip, out in zip((*dec, enc[-1])[1:], enc[:-1], dec, strict=True)
        )
        self.decoder = stages(dec, config.dec_heads, config.dec_depths)

    def forward(self, x: Tensor, structure: Structure) -> Tensor:
        """``[N, Cin] -> [N, backbone_dim]``, points in the structure's memory order."""
        levels = structure.levels
        conv = isinstance(self.embed, SubmanifoldConv)
        x = self.embed_out(self.embed(x, levels[0]) if conv else self.embed(x))
        skips = []
        for i, stage in enumerate(self.encoder):
            if i:
                skips.append(x)
                x = self.pools[i - 1](x, levels[i - 1].cluster, levels[i].size)
            x = stage(x, levels[i])
        for i in reversed(range(len(self.decoder))):
            x = self.unpools[i](x, skips[i], levels[i].cluster)
            x = self.decoder[i](x, levels[i])
        return x


class ResidualHeads(nn.Module):
    """One ReLU MLP per attribute, whose last layer starts at zero.

    Residuals are in the network's own units: the means' in unit cubes, bounded by tanh to
    ``means_reach``; the quaternions' per unit length; the others as the container stores them.
    Those in local units are described in :mod:`pointsplat_ns.refinement.local_units`.
    """

    def __init__(self, in_channels: int, config: RefinerConfig):
        super().__init__()
        self.means_reach = config.means_reach
        turns = 3 if config.units == "local" else 4
        sizes = {"means": 3, "scales": 3, "quats": turns, "opacities": 1, "features_dc": 3}
        if config.num_rest:
            sizes["features_rest"] = 3 * config.num_rest

        def mlp(out_channels: int) -> nn.Sequential:
            widths = [in_channels, *[config.head_width] * (config.head_depth - 1)]
            hidden = [
                (linear(a, b), nn.ReLU(inplace=True))
                for a, b in zip(widths[:-1], widths[1:], strict=True)
            ]
            return nn.Sequential(
                *(layer for pair in hidden for layer in pair), zero_linear(widths[-1], out_channels)
            )

        self.mlps = nn.ModuleDict({name: mlp(size) for name, size in sizes.items()})

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """Residuals by attribute: ``[N, Cin] -> {name: [N, size]}``."""
        out = {}
        for name, mlp in self.mlps.items():
            # The rounding of a matrix times one column depends on the number of threads.
            with one_thread() if name == "opacities" else nullcontext():
                residual = by_rows(
                    mlp, x, 4096
                )  # so that hidden layers fit into the cache: a quarter faster
            out[name] = residual.tanh() * self.means_reach if name == "means" else residual
        return out
