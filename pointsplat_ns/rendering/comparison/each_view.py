"""Renders of a few views of a scene, several at once on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.threads import in_turn

Result = TypeVar("Result")


def each_view(
    scene: Gaussians,
    views: Views,
    function: Callable[[Gaussians, View], Result],
    max_count_at_once: int = 2_000_000,
) -> Iterator[Result]:
    """The results of a function of a scene and a view, for each view in order. Several views are
    computed at once; of a scene on a GPU, one after the other in this thread.

    Args:
        scene: the Gaussians that are rendered in each view.
        views: any number of views.
        function: function of the scene and a view; it runs without gradients.
        max_count_at_once: largest number of Gaussians, summed over the views that are rendered at
            once, because each render takes memory. At least two views are rendered at once.
    """
    at_once = max(2, max_count_at_once // max(1, len(scene)))

    @torch.no_grad()
    def work(index: int) -> Result:
        return function(scene, views[index])

    for first in range(0, len(views), at_once):
        yield from in_turn(work, range(first, min(first + at_once, len(views))), scene.device)
