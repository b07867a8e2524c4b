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
from pointsplat_ns.refiner.encoder import make_norm
from pointsplat_ns.refiner.rows import add_by_rows, add_rows, by_rows, rows_at_a_time
from pointsplat_ns.refiner.sparse_ops import permute, segment_max, segment_mean, submanifold_conv
from pointsplat_ns.refiner.structure import Level, Structure


class SubmanifoldConv(nn.Module):
    """3x3x3 convolution over the occupied cells of a level.

    Points that share a cell are averaged first and receive the same result.
    """

    def __init__(self, in_channels: int, out_channels: int, bias: bool = True):
        super().__init__()
        bound = (27 * in_channels) ** -0.5
        self.weight = nn.Parameter(torch.empty(27, in_channels, out_channels).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None

    def forward(self, x: Tensor, level: Level, then: Callable[[Tensor], Tensor] | None = None) -> Tensor:
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
    """Multi-head attention within patches of K points that are consecutive along a curve.

    A last patch of fewer points is filled up with the points before it, which keep the result of
    their own patch; with at most K points in all there is one patch, and this is plain attention.
    """

    def __init__(self, channels: int, heads: int, patch: int):
        super().__init__()
        self.heads, self.patch = heads, patch
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(
        self, x: Tensor, order: tuple[Tensor, Tensor] | None, norm: nn.Module | None = None, add: bool = False
    ) -> Tensor:
        """``[M, C] -> [M, C]``: attention among the rows of ``norm(x)``.

        Args:
            x: features.  # [M, C]
            order: a curve's order and inverse, None for memory order.
            norm: applied row by row before.
            add: add the result to ``x`` in place, without gradients, and return that.
        """
        size = min(self.patch, len(x))
        full = len(x) // size * size
        rows = rows_at_a_time(self.qkv.out_features, size)

        def attend(part: Tensor) -> Tensor:
            return self._attend(part if norm is None else norm(part), size)

        if add:
            along = None if order is None else order[0]
            # Read before they change: the last patch borrows points of the one before.
            last = x[len(x) - size :] if along is None else x.index_select(0, along[len(x) - size :])
            last = attend(last)[full - len(x) :] if full < len(x) else None
            add_by_rows(attend, x, rows, along, full)
            if last is not None:
                add_rows(x, last, along, full)
            return x
        if order is not None:
            x = permute(x, *order)
        out = by_rows(attend, x[:full], rows)
        if full < len(x):
            out = torch.cat([out, attend(x[len(x) - size :])[full - len(x) :]])
        return out if order is None else permute(out, order[1], order[0])

    def _attend(self, x: Tensor, size: int) -> Tensor:
        """``[P * size, C] -> [P * size, C]``: each run of ``size`` rows by itself."""
        channels = x.shape[1]
        q, k, v = self.qkv(x).view(-1, size, 3, self.heads, channels // self.heads).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(-1, channels))


class Block(nn.Module):
    """Convolution as positional encoding, attention, MLP: each added to what came in."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_path: float):
        super().__init__()
        self.drop_path = drop_path
        self.conv = SubmanifoldConv(channels, channels)
        self.conv_out = nn.Sequential(nn.Linear(channels, channels), nn.LayerNorm(channels))
        self.norm1 = nn.LayerNorm(channels)
        self.attention = PatchAttention(channels, heads, config.patch)
        self.norm2 = nn.LayerNorm(channels)
        hidden = channels * config.mlp_ratio
        self.mlp = nn.Sequential(nn.Linear(channels, hidden), nn.GELU(), nn.Linear(hidden, channels))

    def forward(self, x: Tensor, level: Level, order: tuple[Tensor, Tensor] | None) -> Tensor:
        """``[M, C] -> [M, C]``."""
        x = self.conv(x, level, self.conv_out).add_(x)
        rows = rows_at_a_time(self.mlp[0].out_features)
        if not torch.is_grad_enabled() and not self.training:
            x = self.attention(x, order, self.norm1, add=True)
            return add_by_rows(self._mlp, x, rows)
        x = self._drop(self.attention(x, order, self.norm1)).add_(x)
        return self._drop(by_rows(self._mlp, x, rows)).add_(x)

    def _mlp(self, x: Tensor) -> Tensor:
        return self.mlp(self.norm2(x))

    def _drop(self, x: Tensor) -> Tensor:
        if not self.training or self.drop_path == 0:
            return x
        keep = 1 - self.drop_path
        return x * (torch.rand(len(x), 1, device=x.device, dtype=x.dtype) < keep).to(x.dtype).div_(keep)


class Stage(nn.Module):
    """Blocks of one level, each along another curve."""

    def __init__(self, channels: int, heads: int, config: RefinerConfig, drop_paths: list[float]):
        super().__init__()
        self.blocks = nn.ModuleList(Block(channels, heads, config, rate) for rate in drop_paths)

    def forward(self, x: Tensor, level: Level, curves: list[int]) -> Tensor:
        """``[M, C] -> [M, C]``; ``curves`` are indices into the level's orders."""
        for i, block in enumerate(self.blocks):
            x = block(x, level, level.orders[curves[i % len(curves)]])
        return x


class Pool(nn.Module):
    """To the next coarser level: project, maximum over each cell, normalise."""

    def __init__(self, in_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.proj = nn.Linear(in_channels, out_channels)
        self.out = nn.Sequential(make_norm(norm, out_channels), nn.GELU())

    def forward(self, x: Tensor, cluster: Tensor, size: int) -> Tensor:
        """``[M, Cin] -> [size, Cout]``."""
        x = self.proj(x)
        return self.out(x if len(x) == size else segment_max(x, cluster, size))


class Unpool(nn.Module):
    """Back to the finer level: each point gets its cell's features, added to its own."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int, norm: str):
        super().__init__()
        self.coarse = nn.Sequential(nn.Linear(in_channels, out_channels), make_norm(norm, out_channels), nn.GELU())
        self.skip = nn.Sequential(nn.Linear(skip_channels, out_channels), make_norm(norm, out_channels), nn.GELU())

    def forward(self, x: Tensor, skip: Tensor, cluster: Tensor) -> Tensor:
        """``[size, Cin], [M, Cskip] -> [M, Cout]``."""
        return self.coarse(x).index_select(0, cluster).add_(self.skip(skip))


class PointTransformer(nn.Module):
    """Encoder stages from fine to coarse, decoder stages back, with skips between equals."""

    def __init__(self, in_channels: int, config: RefinerConfig):
        super().__init__()
        enc, dec, norm = config.enc_channels, config.dec_channels, config.norm
        self.num_curves = len(config.curves)
        self.embed = SubmanifoldConv(in_channels, enc[0], bias=False)
        self.embed_out = nn.Sequential(make_norm(norm, enc[0]), nn.GELU())

        rates = _split(_ramp(config.drop_path, sum(config.enc_depths)), config.enc_depths)
        self.encoder = nn.ModuleList(
            Stage(c, h, config, r) for c, h, r in zip(enc, config.enc_heads, rates, strict=True)
        )
        self.pools = nn.ModuleList(Pool(a, b, norm) for a, b in zip(enc[:-1], enc[1:], strict=True))

        rates = _split(_ramp(config.drop_path, sum(config.dec_depths)), config.dec_depths)
        self.unpools = nn.ModuleList(
            Unpool(a, skip, out, norm) for a, skip, out in zip((*dec[1:], enc[-1]), enc[:-1], dec, strict=True)
        )
        self.decoder = nn.ModuleList(
            Stage(c, h, config, r) for c, h, r in zip(dec, config.dec_heads, rates, strict=True)
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
        """Which curve each block of a stage follows: shuffled in training, as configured otherwise."""
        if not self.training:
            return list(range(self.num_curves))
        return torch.randperm(self.num_curves).tolist()


def _ramp(top: float, count: int) -> list[float]:
    """``count`` rates rising evenly from 0 to ``top``."""
    return [top * i / max(1, count - 1) for i in range(count)]


def _split(values: list[float], sizes: tuple[int, ...]) -> list[list[float]]:
    taken = iter(values)
    return [[next(taken) for _ in range(size)] for size in sizes]
