"""Training one network in several processes: losses and batch norm over all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor, nn

from pointsplat_ns.refiner.layers import BatchNorm
from pointsplat_ns.system.processes import world_size


def means_over_ranks(values: dict[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Mean of each named scalar over the processes that have it, without gradient, for the names that this process has.
    ``names`` are the same in every process; ``values`` are this process's, on its device."""
    present = [name for name in names if name in values]
    if world_size() == 1:
        return {name: values[name].detach() for name in present}
    device = next(iter(values.values())).device
    table = torch.zeros(2, len(names), dtype=torch.float64, device=device)  # sums and counts
    for column, name in enumerate(names):
        if name in values:
            table[0, column], table[1, column] = values[name].detach().double(), 1.0
    dist.all_reduce(table)
    return {
        name: (table[0, names.index(name)] / table[1, names.index(name)]).to(values[name].dtype) for name in present
    }


def with_value(local: Tensor, value: Tensor) -> Tensor:
    """A scalar with the value of ``value`` and the gradient of ``local``."""
    return local + (value - local).detach()


class SyncedBatchNorm(BatchNorm):
    """Batch norm with statistics over the points of all processes: ``[N, C] -> [N, C]``.

    torch's own synchronised batch norm needs a GPU.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or world_size() == 1:
            return super().forward(x)
        from torch.distributed.nn.functional import all_reduce

        sums = all_reduce(torch.cat([x.sum(0), x.new_full((1,), len(x))]))
        count = sums[-1].detach()
        if float(count) < 2:  # no variance: use the running statistics
            mean, variance = self.running_mean, self.running_var
        else:
            mean = sums[:-1] / count
            variance = all_reduce((x - mean).square().sum(0)) / count
            self._track(mean.detach(), variance.detach(), count)
        return (x - mean) * (variance + self.eps).rsqrt() * self.weight + self.bias

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: Tensor) -> None:
        self.num_batches_tracked.add_(1)
        momentum = max(self.momentum, 1.0 / float(self.num_batches_tracked))
        self.running_mean.lerp_(mean, momentum)
        self.running_var.lerp_(variance * count / (count - 1), momentum)


def synchronise_batch_norm(module: nn.Module) -> None:
    """Turn every batch norm in a module into a :class:`SyncedBatchNorm`, with the same parameters and statistics."""
    for part in module.modules():
        if type(part) is BatchNorm:
            part.__class__ = SyncedBatchNorm
