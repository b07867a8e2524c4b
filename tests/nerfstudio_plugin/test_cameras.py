"""nerfstudio's cameras and ours are the same cameras."""

import copy
import dataclasses

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, eps2d_of, near_plane_of, views_of_cameras
from pointsplat_ns.views import EPS2D, NEAR_PLANE, Views

SEED = 20
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def some_cameras(num: int = 3) -> Cameras:
    """Turned and moved at random, off-centre, with unequal focal lengths."""
    generator = torch.Generator().manual_seed(SEED)
    turn = torch.linalg.qr(torch.randn(num, 3, 3, generator=generator))[0]
    turn = turn * torch.linalg.det(turn)[:, None, None]
    poses = torch.cat([turn, torch.randn(num, 3, 1, generator=generator)], dim=2)
    return Cameras(poses, 35.0, 36.0, 20.5, 14.0, 40, 30, camera_type=CameraType.PERSPECTIVE)


@pytest.fixture
def views() -> Views:
    return views_of_cameras(some_cameras(), BACKGROUND, "antialiased")


def test_a_view_sees_a_point_at_the_pixel_where_nerfstudios_ray_to_it_starts(views):
    cameras = some_cameras()
    at = torch.tensor([12.5, 31.5])  # row and column, at pixel centres as nerfstudio counts
    rays = cameras.generate_rays(torch.tensor([[1]]), coords=at[None])
    point = rays.origins[0] + 2.5 * rays.directions[0]
    in_camera = views.viewmats[1] @ torch.cat([point, torch.ones(1)])
    pixel = views.Ks[1] @ in_camera[:3]
    assert in_camera[2] > 0
    # 1e-3 pixels: float32 rays
    torch.testing.assert_close(pixel[:2] / pixel[2], at.flip(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cameras_of_views_are_the_pinhole_cameras_that_the_views_were_made_of_in_float32(views, dtype):
    views = dataclasses.replace(views, viewmats=views.viewmats.to(dtype), Ks=views.Ks.to(dtype))
    assert (len(views), views.width, views.height, views.rasterize_mode) == (3, 40, 30, "antialiased")
    back = cameras_of_views(views)
    # 1e-6: one inversion of a float32 pose
    torch.testing.assert_close(back.camera_to_worlds, some_cameras().camera_to_worlds, atol=1e-6, rtol=0)
    assert torch.equal(back.get_intrinsics_matrices(), some_cameras().get_intrinsics_matrices())
    assert back.distortion_params is None and (back.width == 40).all() and (back.height == 30).all()
    assert (back.camera_to_worlds.dtype, back.fx.dtype) == (torch.float32, torch.float32)


@pytest.mark.parametrize(("near_plane", "eps2d"), [(NEAR_PLANE, EPS2D), (1e-7, 0.0), (300.0, 1.0)])
def test_near_plane_and_eps2d_go_to_nerfstudios_cameras_and_back(views, near_plane, eps2d):
    cameras = cameras_of_views(dataclasses.replace(views, near_plane=near_plane, eps2d=eps2d))
    for some in (cameras, cameras[1:2], copy.deepcopy(cameras).to("cpu")):
        assert near_plane_of(some) == near_plane == views_of_cameras(some, BACKGROUND).near_plane
        assert eps2d_of(some) == eps2d == views_of_cameras(some, BACKGROUND).eps2d


def test_cameras_of_a_dataset_have_gsplats_near_plane(views):
    assert near_plane_of(some_cameras()) == views.near_plane == NEAR_PLANE
    with_others = some_cameras()
    with_others.metadata = {"cam_idx": 1}
    assert near_plane_of(with_others) == NEAR_PLANE and eps2d_of(with_others) == EPS2D


def test_cameras_of_several_near_planes_or_sizes_are_refused(views):
    cameras = cameras_of_views(views)
    cameras.metadata["near_plane"] = torch.tensor([[0.1], [0.1], [0.2]])
    with pytest.raises(DataError, match="2 values of near_plane; expected one for all views"):
        views_of_cameras(cameras, BACKGROUND)
    cameras = some_cameras()
    cameras.width = torch.tensor([[40], [41], [40]])
    with pytest.raises(DataError, match="photos of 2 sizes; expected one size for all views"):
        views_of_cameras(cameras, BACKGROUND)
