"""Cameras at given places, and what is in their pictures."""

import torch

from pointsplat_ns.looking.poses import in_pictures
from pointsplat_ns.views import Views


def test_a_picture_holds_points_in_front_and_inside_of_its_edges():
    """Focal length 10 and 16 pixels: the edge is at 0.8 of the depth. The second camera is a unit farther back."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    viewmats[1, 2, 3] = 1.0
    K = torch.tensor([[10.0, 0, 8], [0, 10.0, 8], [0, 0, 1.0]])
    views = Views(viewmats, K.repeat(2, 1, 1), 16, 16, torch.zeros(3))
    x = torch.tensor([0.0, 0.0, 0.0, 0.79, 0.81, -0.79, -0.81, 0.0], dtype=torch.float64)
    z = torch.tensor([1.0, -2.0, 0.0, 1, 1, 1, 1, 1e300], dtype=torch.float64)
    for points in (torch.stack([x, 0 * x, z], 1), torch.stack([0 * x, x, z], 1)):
        first, second = in_pictures(views, points).tolist()
        assert first == [True, False, False, True, False, True, False, True]
        assert second == [True, False, True, True, True, True, True, True]
        assert in_pictures(views, points, min_depth=1.0)[0].tolist() == [False] * 7 + [True]
    assert not in_pictures(views, torch.full((1, 3), torch.nan, dtype=torch.float64)).any()
