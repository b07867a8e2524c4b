"""Training one network in several processes: losses, gradients, batch norm and reports over all of them.

In a single process every function here changes nothing. The processes are those of ``torch.distributed``, with the
backend nccl on GPUs and gloo on CPUs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from pointsplat_ns.refiner.encoder import BatchNorm


def world_size() -> int:
    """Number of processes that train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Index of this process among all machines' processes."""
    return dist.get_rank() if world_size() > 1 else 0


def means_over_ranks(values: dict[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Mean of each named scalar over the processes that have it, without gradient.

    Args:
        values: this process's scalars by name, on its device. Only those in ``names`` are used.
        names: the same in every process.

    Returns:
        The means of the names that this process has.
    """
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


def any_rank(flag: bool, device: torch.device | str) -> bool:
    """Whether ``flag`` is set in any process. All processes must call this, each with its own device."""
    if world_size() == 1:
        return flag
    count = torch.tensor([float(flag)], device=device)
    dist.all_reduce(count)
    return bool(count > 0)


def with_value(local: Tensor, value: Tensor) -> Tensor:
    """A scalar with the value of ``value`` and the gradient of ``local``."""
    return local + (value - local).detach()


def gathered(items: list[Any]) -> list[Any]:
    """The items of all processes, in the order of their ranks; the same list in every process."""
    if world_size() == 1:
        return items
    parts: list[Any] = [None] * world_size()
    dist.all_gather_object(parts, items)
    return [item for part in parts for item in part]


@torch.no_grad()
def share_state(module: nn.Module) -> None:
    """Copy the parameters and buffers of the first process to all others."""
    if world_size() > 1:
        for value in (*module.parameters(), *module.buffers()):
            dist.broadcast(value, 0)


@torch.no_grad()
def average_gradients(parameters: Iterable[nn.Parameter], steps: int = 1) -> None:
    """Divide gradients that were summed over ``steps`` by that number, and average them over processes.

    With several processes, a parameter without a gradient in any of them gets a gradient of zeros.
    """
    parameters = list(parameters)
    share = 1.0 / (steps * world_size())
    if share == 1.0 or not parameters:
        return
    if world_size() > 1:
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([grad.reshape(-1) for grad in grads])
        dist.all_reduce(flat)
        for p, grad, mean in zip(parameters, grads, flat.split([g.numel() for g in grads]), strict=True):
            p.grad = grad.copy_(mean.view_as(grad))
    for p in parameters:
        if p.grad is not None:
            p.grad.mul_(share)


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
