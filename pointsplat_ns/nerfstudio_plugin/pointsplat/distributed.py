"""Several processes that train one network: how what each of them found becomes one.

Everything here is the identity in a process that is alone. The processes are those of ``torch.distributed``, whose
backend is nccl among GPUs and gloo among CPUs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from pointsplat_ns.refiner.encoder import BatchNorm


def world_size() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Which of them this one is, over all machines."""
    return dist.get_rank() if world_size() > 1 else 0


def means_over_ranks(values: dict[str, Tensor], names: Sequence[str]) -> dict[str, Tensor]:
    """Mean of each named scalar over the processes that have it; no gradient.

    Args:
        values: scalars on this process's device. Names beyond ``names`` are left out.
        names: the same in every process.
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
    """Whether it is so in any process. All must ask, each with its own device."""
    if world_size() == 1:
        return flag
    count = torch.tensor([float(flag)], device=device)
    dist.all_reduce(count)
    return bool(count > 0)


def with_value(local: Tensor, value: Tensor) -> Tensor:
    """A scalar of the given value whose gradient is that of ``local``."""
    return local + (value - local).detach()


def gathered(items: list[Any]) -> list[Any]:
    """The items of all processes, by rank; in every process."""
    if world_size() == 1:
        return items
    parts: list[Any] = [None] * world_size()
    dist.all_gather_object(parts, items)
    return [item for part in parts for item in part]


@torch.no_grad()
def share_state(module: nn.Module) -> None:
    """Give every process the parameters and buffers of the first."""
    if world_size() > 1:
        for value in (*module.parameters(), *module.buffers()):
            dist.broadcast(value, 0)


@torch.no_grad()
def average_gradients(parameters: Iterable[nn.Parameter], steps: int = 1) -> None:
    """Divide gradients that were added up over steps by their number, and take the mean over processes.

    In several processes, a parameter that has a gradient in none of them gets zeros.
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
    """Batch norm over the points that all processes have at hand: ``[N, C] -> [N, C]``.

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
        if float(count) < 2:  # no variance: the running statistics serve
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
    """Make every batch norm within a module one over all processes; its parameters and statistics stay."""
    for part in module.modules():
        if type(part) is BatchNorm:
            part.__class__ = SyncedBatchNorm
