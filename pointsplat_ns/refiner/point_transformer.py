"""Point Transformer V3 in plain torch: a U-net of attention blocks over serialized points.

Source of the architecture: X. Wu et al., "Point Transformer V3: Simpler, Faster, Stronger", CVPR
2024. Shapes: M points of a level, C channels, H heads, K points of a patch.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pointsplat_ns.refiner.config import RefinerConfig
from pointsplat_ns.refiner.layers import LayerNorm, Linear, make_norm
from pointsplat_ns.refiner.serialization import Order, by_patches
from pointsplat_ns.refiner.sparse_ops import by_rows, rows_at_a_time, segment_max, segment_mean, submanifold_conv
from pointsplat_ns.refiner.structure import GridLevel, Structure
from pointsplat_ns.system.tensors import of_network


class SubmanifoldConv(nn.Module):
    """3x3x3 convolution over the occupied cells of a level.

    Points that share a cell are averaged first and receive the same result.
    """

    def __init__(self, in_channels: int, out_channels: int, bias: bool = True):
        super().__init__()
        bound = (27 * in_channels) ** -0.5
        self.weight = nn.Parameter(torch.empty(27, in_channels, out_channels, **of_network()).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(out_channels, **of_network())) if bias else None

    def forward(self, x: Tensor, level: GridLevel, then: Callable[[Tensor], Tensor] | None = None) -> Tensor:
        """``[M, Cin] -> [M, Cout]``; ``then`` is applied row by row, to the result of each cell once."""
        if level.cell_of is not None:
            x = segment_mean(x, level.cell_of, level.num_cells)
        x = submanifold_conv(x, self.weight, level.neighbours)
        if self.bias is not None:
            x = x.add_(self.bias)
        if then is not None:
            x = by_rows(then, x, rows_at_a_time(x.shape[1]))
        return x if level.cell_of is None else x.index_select(0, level.cell_of)


class PatchAttention(nn.Module):
    """Multi-head attention within patches of K consecutive points along a curve, see
    :mod:`~pointsplat_ns.refiner.serialization`. With at most K points in all, this is plain attention.
    """

    def __init__(self, channels: int, heads: int, patch: int):
        super().__init__()
        self.heads, self.patch = heads, patch
        self.qkv = Linear(channels, 3 * channels)
        self.proj = Linear(channels, channels)

    def forward(self, x: Tensor, order: Order | None = None) -> Tensor:
        """``[M, C] -> [M, C]``; ``order`` along a curve, None for memory order."""
        return by_patches(self._attend, x, self.qkv.out_features, self.patch, order)

    def _attend(self, x: Tensor) -> Tensor:
        """Attention among the points of each patch: ``[P * K, C] -> [P * K, C]``."""
        points, channels = x.shape
        size = min(self.patch, points)
        q, k, v = self.qkv(x).view(-1, size, 3, self.heads, channels // self.heads).permute(2, 0, 3, 1, 4)
        # (P, H, K, C / H) each
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(-1, channels))


class Block(nn.Module):
    """Convolution as positional encoding, attention, MLP: each with a residual connection."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_path: float):
        super().__init__()
        self.drop_path = drop_path
        self.conv = SubmanifoldConv(channels, channels)
        self.conv_out = nn.Sequential(Linear(channels, channels), LayerNorm(channels))
        self.norm1 = LayerNorm(channels)
        self.attention = PatchAttention(channels, heads, config.patch)
        self.norm2 = LayerNorm(channels)
        self.hidden = channels * config.mlp_ratio
        self.mlp = nn.Sequential(Linear(channels, self.hidden), nn.GELU(), Linear(self.hidden, channels))

    def forward(self, x: Tensor, level: GridLevel, order: Order | None) -> Tensor:
        """``[M, C] -> [M, C]``; ``order`` along the curve that the patches follow, None for memory order."""
        x = self.conv(x, level, then=self.conv_out).add_(x)
        attended = by_patches(
            lambda part: self.attention(self.norm1(part)), x, 3 * x.shape[1], self.attention.patch, order
        )
        x = self._drop(attended).add_(x)
        return self._drop(by_patches(lambda part: self.mlp(self.norm2(part)), x, self.hidden)).add_(x)

    def _drop(self, x: Tensor) -> Tensor:
        """In training, random rows are set to zero and the others scaled up, so that the expected value is kept."""
        if not self.training or self.drop_path == 0:
            return x
        keep = 1 - self.drop_path
        return x * (torch.rand(len(x), 1, device=x.device, dtype=x.dtype) < keep).to(x.dtype).div_(keep)


class TransformerStage(nn.Module):
    """Blocks of one level, each along another curve."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_paths: list[float]):
        super().__init__()
        self.blocks = nn.ModuleList(Block(channels, heads, config, rate) for rate in drop_paths)

    def forward(self, x: Tensor, level: GridLevel, curves: list[int]) -> Tensor:
        """``[M, C] -> [M, C]``; ``curves`` are indices into the level's orders."""
        for i, block in enumerate(self.blocks):
            x = block(x, level, level.orders[curves[i % len(curves)]])
        return x


class Pool(nn.Module):
    """To the next coarser level: project, maximum over each cell, normalise."""

    def __init__(self, in_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.proj = Linear(in_channels, out_channels)
        self.out = nn.Sequential(make_norm(norm, out_channels), nn.GELU())

    def forward(self, x: Tensor, cluster: Tensor, size: int) -> Tensor:
        """``[M, Cin] -> [size, Cout]``."""
        x = self.proj(x)
        return self.out(x if len(x) == size else segment_max(x, cluster, size))


class Unpool(nn.Module):
    """To the next finer level: the features of each point's cell are added to its own."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.coarse = nn.Sequential(Linear(in_channels, out_channels), make_norm(norm, out_channels), nn.GELU())
        self.skip = nn.Sequential(Linear(skip_channels, out_channels), make_norm(norm, out_channels), nn.GELU())

    def forward(self, x: Tensor, skip: Tensor, cluster: Tensor) -> Tensor:
        """``[size, Cin], [M, Cskip] -> [M, Cout]``."""
        return self.coarse(x).index_select(0, cluster).add_(self.skip(skip))


class PointTransformer(nn.Module):
    """Encoder stages from fine to coarse, decoder stages back, with skip connections between equal levels."""

    def __init__(self, in_channels: int, config: RefinerConfig):
        super().__init__()
        enc, dec, norm = config.enc_channels, config.dec_channels, config.norm
        self.num_curves = len(config.curves)
        self.embed = SubmanifoldConv(in_channels, enc[0], bias=False)
        self.embed_out = nn.Sequential(make_norm(norm, enc[0]), nn.GELU())

        rates = _split(_ramp(config.drop_path, sum(config.enc_depths)), config.enc_depths)
        self.encoder = nn.ModuleList(
            TransformerStage(c, h, config, r) for c, h, r in zip(enc, config.enc_heads, rates, strict=True)
        )
        self.pools = nn.ModuleList(Pool(a, b, norm) for a, b in zip(enc[:-1], enc[1:], strict=True))

        rates = _split(_ramp(config.drop_path, sum(config.dec_depths)), config.dec_depths)
        self.unpools = nn.ModuleList(
            Unpool(a, skip, out, norm) for a, skip, out in zip((*dec, enc[-1])[1:], enc[:-1], dec, strict=True)
        )
        self.decoder = nn.ModuleList(
            TransformerStage(c, h, config, r) for c, h, r in zip(dec, config.dec_heads, rates, strict=True)
        )

    def forward(self, x: Tensor, structure: Structure) -> Tensor:
        """``[N, Cin] -> [N, backbone_dim]``, points in the structure's memory order."""
        levels = structure.levels
        x = self.embed_out(self.embed(x, levels[0]))
        skips = []
        for i, stage in enumerate(self.encoder):
            if i:
                skips.append(x)
                x = self.pools[i - 1](x, levels[i - 1].cluster, levels[i].size)
            x = stage(x, levels[i], self._curves())
        for i in reversed(range(len(self.decoder))):
            x = self.unpools[i](x, skips[i], levels[i].cluster)
            x = self.decoder[i](x, levels[i], self._curves())
        return x

    def _curves(self) -> list[int]:
        """Indices of the curves for the blocks of a stage: shuffled in training, else in the configured order."""
        if not self.training:
            return list(range(self.num_curves))
        return torch.randperm(self.num_curves, device="cpu").tolist()


def _ramp(top: float, count: int) -> list[float]:
    """``count`` rates rising evenly from 0 to ``top``."""
    return [top * i / max(1, count - 1) for i in range(count)]


def _split(values: list[float], sizes: tuple[int, ...]) -> list[list[float]]:
    taken = iter(values)
    return [[next(taken) for _ in range(size)] for size in sizes]
