"""Layers of the networks: float32 whatever torch's default is, on the device that the network's constructor enters."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pointsplat_ns.system.tensors import of_network
from pointsplat_ns.system.threads import one_thread


class Linear(nn.Linear):
    """torch's, in float32: ``[N, Cin] -> [N, Cout]``."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__(in_channels, out_channels, **of_network())


class LayerNorm(nn.LayerNorm):
    """torch's, in float32: ``[N, C] -> [N, C]``."""

    def __init__(self, channels: int):
        super().__init__(channels, **of_network())


class BatchNorm(nn.BatchNorm1d):
    """Batch norm over points: ``[N, C] -> [N, C]``.

    It differs from torch's in two ways. A single point, which has no variance, uses the running statistics. And the
    running statistics start as plain averages, until the momentum exceeds one over the number of steps; otherwise their
    initial values would still count after a short training.
    """

    MOMENTUM = 0.01

    def __init__(self, channels: int):
        super().__init__(channels, eps=1e-3, momentum=self.MOMENTUM, **of_network())

    def forward(self, x: Tensor) -> Tensor:
        use_batch = self.training and x.shape[0] > 1
        momentum = self.MOMENTUM
        if use_batch and self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
            momentum = max(momentum, 1.0 / float(self.num_batches_tracked))
        return nn.functional.batch_norm(
            x, self.running_mean, self.running_var, self.weight, self.bias, use_batch, momentum, self.eps
        )


class SceneNorm(nn.Module):
    """Normalises each channel over the points of the current scene: ``[N, C] -> [N, C]``.

    As batch norm in training, but also in evaluation: there are no running statistics. A single point, which has no
    variance, is its own mean.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels, **of_network()))
        self.bias = nn.Parameter(torch.zeros(channels, **of_network()))
        self.eps = 1e-3

    def forward(self, x: Tensor) -> Tensor:
        if x.shape[0] < 2:
            return (x - x) * self.weight + self.bias
        with one_thread():  # the same rounding for any number of threads
            return nn.functional.batch_norm(x, None, None, self.weight, self.bias, True, 0.0, self.eps)


def make_norm(kind: str, channels: int) -> nn.Module:
    """The normalisation named in a :class:`RefinerConfig`: ``scene``, ``batch`` or ``layer``."""
    return {"scene": SceneNorm, "batch": BatchNorm, "layer": LayerNorm}[kind](channels)
