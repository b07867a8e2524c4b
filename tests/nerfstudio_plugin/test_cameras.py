"""Cameras, views of a dataset and the data manager."""

import copy
import dataclasses

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, carried, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanagerConfig
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
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


def test_a_view_sees_a_point_at_the_pixel_of_nerfstudios_ray(views):
    cameras = some_cameras()
    at = torch.tensor([12.5, 31.5])  # row and column, at pixel centres as nerfstudio counts
    rays = cameras.generate_rays(torch.tensor([[1]]), coords=at[None])
    point = rays.origins[0] + 2.5 * rays.directions[0]
    in_camera = views.viewmats[1] @ torch.cat([point, torch.ones(1)])
    pixel = views.Ks[1] @ in_camera[:3]
    assert in_camera[2] > 0
    # 1e-3 pixels: float32 rays
    torch.testing.assert_close(pixel[:2] / pixel[2], at.flip(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("near_plane", "eps2d"), [(NEAR_PLANE, EPS2D), (1e-7, 0.0), (300.0, 1.0)])
def test_near_plane_and_eps2d_go_to_nerfstudios_cameras_and_back(views, near_plane, eps2d):
    cameras = cameras_of_views(dataclasses.replace(views, near_plane=near_plane, eps2d=eps2d))
    for some in (cameras, cameras[1:2], copy.deepcopy(cameras).to("cpu")):
        assert carried(some) == {"near_plane": near_plane, "eps2d": eps2d}
        again = views_of_cameras(some, BACKGROUND)
        assert (again.near_plane, again.eps2d) == (near_plane, eps2d)


def test_cameras_of_several_near_planes_or_sizes_are_refused(views):
    cameras = cameras_of_views(views)
    cameras.metadata["near_plane"] = torch.tensor([[0.1], [0.1], [0.2]])
    with pytest.raises(DataError, match="2 values of near_plane; expected one for all views"):
        views_of_cameras(cameras, BACKGROUND)
    cameras = some_cameras()
    cameras.width = torch.tensor([[40], [41], [40]])
    with pytest.raises(DataError, match="photos of 2 sizes; expected one size for all views"):
        views_of_cameras(cameras, BACKGROUND)


def datamanagers(wall_scene, **settings):
    parser = ReplicaDataParserConfig(data=wall_scene, load_seed_points=False, eval_every=3)
    lazy = LazyImageDatamanagerConfig(dataparser=parser, **settings).setup(device="cpu")
    stock = FullImageDatamanagerConfig(dataparser=parser, cache_images_type="uint8").setup(device="cpu")
    return lazy, stock


def test_datamanager_gives_what_nerfstudios_gives_in_its_order(wall_scene):
    lazy, stock = datamanagers(wall_scene, cache_gigabytes=3e-5)  # room for three photos
    for step in range(2 * len(lazy.train_dataset) + 1):
        (camera, data), (other, expected) = lazy.next_train(step), stock.next_train(step)
        assert data["image_idx"] == expected["image_idx"] == camera.metadata["cam_idx"]
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
        assert torch.equal(camera.get_intrinsics_matrices(), other.get_intrinsics_matrices())
    assert lazy.frame_cache._entries.currsize <= 3e4
    assert lazy.get_train_rays_per_batch() == stock.get_train_rays_per_batch()
    ours, theirs = list(lazy.fixed_indices_eval_dataloader), list(stock.fixed_indices_eval_dataloader)
    assert len(ours) == len(theirs) == len(lazy.fixed_indices_eval_dataloader) > 1
    for (camera, data), (other, expected) in zip(ours, theirs, strict=True):
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
    seen = [lazy.next_eval(step)[1]["image_idx"] for step in range(len(ours))]
    assert sorted(seen) == list(range(len(ours)))
