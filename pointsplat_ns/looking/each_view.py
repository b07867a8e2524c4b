"""Renders of a few views of a large scene, several at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch

from pointsplat_ns.system.threads import in_threads
from pointsplat_ns.views import View

T = TypeVar("T")

AT_ONCE = 2_000_000
"""Largest number of Gaussians in all that are rendered at once, as each render takes memory; but always two scenes."""


def each_view(views: Sequence[View], count: int, function: Callable[[View], T]) -> Iterator[T]:
    """The result of a function for each view, in order. Several views are computed at once, but no more than
    :data:`AT_ONCE` allows.

    Args:
        views: any number of them.
        count: number of Gaussians that are rendered in each.
        function: of a view, without gradients.
    """
    at_once = max(2, AT_ONCE // max(1, count))
    for first in range(0, len(views), at_once):
        results: dict[int, T] = {}

        @torch.no_grad()
        def work(index: int, results: dict[int, T] = results) -> None:
            results[index] = function(views[index])

        these = range(first, min(first + at_once, len(views)))
        in_threads(work, these)
        yield from (results[index] for index in these)
