"""Processes that train one network together: ranks and communication.

In a single process every function here is a no-op. The processes are those of
``torch.distributed``, started by ``torchrun`` or by nerfstudio, with the backend nccl on GPUs and
gloo on CPUs.
"""

from __future__ import annotations

import atexit
import datetime
import os
from collections.abc import Callable, Iterable
from typing import Any, Literal

import torch
import torch.distributed as dist
from torch import nn

from pointsplat_ns.errors import PointSplatError


def torchrun_rank() -> tuple[int, int]:
    """Rank of this process and number of processes that ``torchrun`` started; 0 and 1 without
    it."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return 0, 1
    return int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])


def local_rank() -> int:
    """Rank of this process among those that ``torchrun`` started on this machine; 0 without it."""
    return int(os.environ["LOCAL_RANK"]) if torchrun_rank()[1] > 1 else 0


def connect_torchrun(backend: Literal["gloo", "nccl"] = "gloo") -> None:
    """Connect the processes that ``torchrun`` started; no effect for a single process, or the
    second time. Use the backend nccl if each process has its own GPU."""
    if torchrun_rank()[1] == 1 or dist.is_initialized():
        return
    if backend == "nccl":
        torch.cuda.set_device(local_rank())  # nccl gathers objects on the current device
    # One process may take long for its last scene.
    dist.init_process_group(backend, timeout=datetime.timedelta(days=1000))
    atexit.register(dist.destroy_process_group)


def world_size() -> int:
    """Number of connected processes."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Index of this process among all processes on all machines."""
    return dist.get_rank() if world_size() > 1 else 0


def any_rank(flag: bool, device: torch.device | str) -> bool:
    """Whether ``flag`` is set in any process. All processes must call this, each with its own
    device."""
    if world_size() == 1:
        return flag
    count = torch.tensor([float(flag)], device=device, dtype=torch.float32)
    dist.all_reduce(count)
    return bool(count > 0)


def gathered(items: list[Any]) -> list[Any]:
    """Items of all processes, ordered by rank; the same list in every process."""
    if world_size() == 1:
        return items
    parts: list[Any] = [None] * world_size()
    dist.all_gather_object(parts, items)
    return [item for part in parts for item in part]


def by_first(work: Callable[[], object]) -> None:
    """Let the first process do the work while the others wait.

    Raises:
        PointSplatError: in the others, if it failed or ended; the first raises the error itself.
    """
    failure: Exception | None = None
    if rank() == 0:
        try:
            work()
        except Exception as error:
            failure = error
    try:
        text = gathered([failure and (str(failure) or type(failure).__name__)])[0]
    except RuntimeError as error:  # connection lost
        raise failure or PointSplatError(
            "another process ended; run the same command to resume"
        ) from error
    if failure is not None:
        raise failure
    if text:
        raise PointSplatError(f"the first process failed: {text}")


@torch.no_grad()
def share_state(module: nn.Module) -> None:
    """Copy the parameters and buffers of the first process to all others."""
    if world_size() > 1:
        for value in (*module.parameters(), *module.buffers()):
            dist.broadcast(value, 0)


@torch.no_grad()
def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Average gradients over processes. With several, a parameter without a gradient in any process
    gets zeros."""
    parameters = list(parameters)
    if world_size() == 1 or not parameters:
        return
    grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    flat = torch.cat([grad.reshape(-1) for grad in grads])
    dist.all_reduce(flat)
    flat.mul_(1.0 / world_size())
    for p, grad, mean in zip(
        parameters, grads, flat.split([g.numel() for g in grads]), strict=True
    ):
        p.grad = grad.copy_(mean.view_as(grad))
