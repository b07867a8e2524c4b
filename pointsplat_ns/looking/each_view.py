"""Renders of a few views of a large scene, several at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import torch

from pointsplat_ns.system.threads import in_threads
from pointsplat_ns.views import View

Result = TypeVar("Result")


def each_view(
    views: Sequence[View], count: int, function: Callable[[View], Result], max_count_at_once: int = 2_000_000
) -> Iterator[Result]:
    """The results of a function for each view, in order. Several views are computed at once.

    Args:
        views: any number of views.
        count: number of Gaussians that are rendered in each view.
        function: function of a view; it runs without gradients.
        max_count_at_once: largest number of Gaussians, summed over the views that are rendered at once, because each
            render takes memory. At least two views are rendered at once.
    """
    at_once = max(2, max_count_at_once // max(1, count))
    for first in range(0, len(views), at_once):
        results: dict[int, Result] = {}

        @torch.no_grad()
        def work(index: int, results: dict[int, Result] = results) -> None:
            results[index] = function(views[index])

        these = range(first, min(first + at_once, len(views)))
        in_threads(work, these)
        yield from (results[index] for index in these)
