"""Views into the example room that are not sampled, which would take ten seconds."""

import torch

import pointsplat_ns as ps
from pointsplat_ns.view_sampling.poses import look_at


def room_views(width: int = 64, height: int = 48) -> ps.Views:
    """Two views into the example room."""
    viewmats = look_at(
        torch.tensor([[1.6, -1.6, 1.8], [-0.4, 0.8, 2.0]]),
        torch.tensor([[0.0, 0.0, 1.2], [1.5, -1.0, 1.4]]),
    )
    K = torch.tensor(
        [[0.7 * width, 0.0, width / 2], [0.0, 0.7 * width, height / 2], [0.0, 0.0, 1.0]]
    )
    return ps.Views(viewmats, K.repeat(2, 1, 1), width, height, torch.zeros(3))
