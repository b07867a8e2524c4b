"""Output heads: one MLP per attribute, from a point's features to the residual of that attribute."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from torch import Tensor, nn

from pointsplat_ns.refiner.config import RefinerConfig
from pointsplat_ns.refiner.layers import Linear
from pointsplat_ns.system.threads import one_thread


class ResidualHeads(nn.Module):
    """One ReLU MLP per attribute, whose last layer starts at zero.

    Residuals are in the network's own units: the means' in unit cubes, bounded by tanh to
    ``means_reach``; the quaternions' per unit length; the others as the container stores them.
    """

    def __init__(self, in_channels: int, config: RefinerConfig):
        super().__init__()
        self.means_reach = config.means_reach
        sizes = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "features_dc": 3}
        if config.num_rest:
            sizes["features_rest"] = 3 * config.num_rest
        self.mlps = nn.ModuleDict({name: _head(in_channels, config, size) for name, size in sizes.items()})

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        """Residuals by attribute: ``[N, Cin] -> {name: [N, size]}``."""
        rows = 4096  # at a time on a CPU, so that hidden layers fit into its cache: a quarter faster
        if x.device.type != "cpu" or len(x) <= rows:
            return self._forward(x)
        parts = [self._forward(part) for part in x.split(rows)]
        return {name: torch.cat([part[name] for part in parts]) for name in self.mlps}

    def _forward(self, x: Tensor) -> dict[str, Tensor]:
        out = {}
        for name, mlp in self.mlps.items():
            # The rounding of a matrix times one column depends on the number of threads.
            with one_thread() if name == "opacities" else nullcontext():
                residual = mlp(x)
            out[name] = residual.tanh() * self.means_reach if name == "means" else residual
        return out


def _head(in_channels: int, config: RefinerConfig, out_channels: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    width = in_channels
    for _ in range(config.head_depth - 1):
        layers += [Linear(width, config.head_width), nn.ReLU(inplace=True)]
        width = config.head_width
    last = Linear(width, out_channels)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)
