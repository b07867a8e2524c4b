"""Training one network in several processes: losses over all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor

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
