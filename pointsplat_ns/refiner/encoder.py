"""The dual-branch encoder (paper eq. 4 to 6), its ablations, and the concatenating baseline."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pointsplat_ns.refiner.config import RefinerConfig
from pointsplat_ns.refiner.layers import Linear, make_norm
from pointsplat_ns.refiner.normalize import Features


class DualBranchEncoder(nn.Module):
    """Geometry gated by appearance.

    ``f = softmax(phi_a(f_a) + delta) * (phi_p(f_p) + delta)`` over channels, with
    ``f_p = (means, quats, scales)``, ``f_a = (opacity, dc, reduced rest)`` and ``delta = psi(means)``
    (paper eq. 4 to 6). Without appearance the gate is 1, without position ``delta`` is 0 (Table 4).
    With ``unit_gate`` the result is multiplied by the number of channels.
    """

    def __init__(self, config: RefinerConfig):
        super().__init__()
        dim = config.feature_dim
        self.gate_gain = dim if config.unit_gate else 1
        self.geometry = nn.Sequential(
            Linear(10, dim), make_norm(config.norm, dim), nn.ReLU(inplace=True), Linear(dim, dim)
        )
        self.position = None
        if config.use_position:
            self.position = nn.Sequential(Linear(3, dim), nn.ReLU(inplace=True), Linear(dim, dim))
        self.color = self.appearance = None
        if config.use_appearance:
            reduced = 0
            if config.num_rest:
                reduced = config.color_dim
                self.color = nn.Sequential(
                    Linear(3 * config.num_rest, config.color_hidden),
                    nn.ReLU(inplace=True),
                    Linear(config.color_hidden, reduced),
                )
            self.appearance = nn.Sequential(
                Linear(4 + reduced, dim), make_norm(config.norm, dim), nn.ReLU(inplace=True), Linear(dim, dim)
            )

    def forward(self, features: Features) -> Tensor:
        """Encoded Gaussians. # [N, feature_dim]"""
        geometry = self.geometry(torch.cat([features.positions, features.quats, features.scales], dim=1))
        delta = 0.0 if self.position is None else self.position(features.positions)
        if self.appearance is None:
            return geometry + delta
        parts = [features.opacities, features.features_dc]
        if self.color is not None:
            parts.append(self.color(features.features_rest))
        gate = torch.softmax(self.appearance(torch.cat(parts, dim=1)) + delta, dim=1)
        return self.gate_gain * gate * (geometry + delta)


class ConcatEncoder(nn.Module):
    """All attributes side by side, as SplatFormer feeds them: 59 numbers at SH degree 3. No parameters."""

    def forward(self, features: Features) -> Tensor:
        """Concatenated Gaussians. # [N, 14 + 3 * num_rest]"""
        f = features
        return torch.cat([f.positions, f.scales, f.quats, f.opacities, f.features_dc, f.features_rest], dim=1)


def make_encoder(config: RefinerConfig) -> nn.Module:
    """The encoder of a configuration."""
    return DualBranchEncoder(config) if config.encoder == "dual" else ConcatEncoder()
