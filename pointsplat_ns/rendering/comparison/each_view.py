"""Renders of a few views of a scene, several at a time on a CPU."""

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
    """Results of a function of a scene and a view, for each view in order. On a CPU several views
    are computed at a time; on a GPU one after the other in this thread.

    Args:
        scene: the Gaussians to render.
        views: any number of views.
        function: function of the scene and a view; runs without gradients.
        max_count_at_once: maximum number of Gaussians, summed over concurrent views, because each
            render takes memory. At least two views are rendered at a time.
    """
    at_once = max(2, max_count_at_once // max(1, len(scene)))

    @torch.no_grad()
    def work(index: int) -> Result:
        return function(scene, views[index])

    for first in range(0, len(views), at_once):
        yield from in_turn(work, range(first, min(first + at_once, len(views))), scene.device)
