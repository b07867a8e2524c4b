"""Cameras, the data manager, and posed photos loaded when due."""

import copy
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.scene_box import SceneBox
from PIL import Image

import pointsplat_ns as ps
from making import run_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.cameras import cameras_of_views, carried, views_of_cameras
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanagerConfig
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.nerfstudio_plugin.frames import Frames, UndistortedDataset
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.views import EPS2D, NEAR_PLANE, Views

pytestmark = pytest.mark.usefixtures("quick")

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def some_cameras(num: int = 3) -> Cameras:
    generator = torch.Generator().manual_seed(20)
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


def test_cameras_of_several_near_planes_are_refused(views):
    cameras = cameras_of_views(views)
    cameras.metadata["near_plane"] = torch.tensor([[0.1], [0.1], [0.2]])
    with pytest.raises(DataError, match="2 values of near_plane; expected one for all views"):
        views_of_cameras(cameras, BACKGROUND)


def test_sizes_of_each_view_go_to_nerfstudios_cameras_and_back():
    cameras = some_cameras()
    cameras.width = torch.tensor([[40], [41], [40]])
    cameras.height = torch.tensor([[30], [30], [60]])
    views = views_of_cameras(cameras, BACKGROUND)
    assert [(view.width, view.height) for view in views] == [(40, 30), (41, 30), (40, 60)]
    again = cameras_of_views(views)
    assert torch.equal(again.width, cameras.width) and torch.equal(again.height, cameras.height)
    assert views_of_cameras(again, BACKGROUND).images == views.images


def test_datamanager_gives_what_nerfstudios_gives_in_its_order(wall_scene):
    parser = ReplicaDataParserConfig(data=wall_scene, load_seed_points=False, eval_every=3)
    room_for_three = LazyImageDatamanagerConfig(dataparser=parser, cache_gigabytes=3e-5)
    plain = FullImageDatamanagerConfig(dataparser=parser, cache_images_type="uint8")
    lazy, stock = (config.setup(device="cpu") for config in (room_for_three, plain))
    for step in range(2 * len(lazy.train_dataset) + 1):
        (camera, data) = lazy.next_train(step)
        (other, expected) = stock.next_train(step)
        assert data["image_idx"] == expected["image_idx"] == camera.metadata["cam_idx"]
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
        assert torch.equal(camera.get_intrinsics_matrices(), other.get_intrinsics_matrices())
    assert lazy.frame_cache._entries.currsize <= 3e4
    assert lazy.get_train_rays_per_batch() == stock.get_train_rays_per_batch()
    ours = list(lazy.fixed_indices_eval_dataloader)
    theirs = list(stock.fixed_indices_eval_dataloader)
    assert len(ours) == len(theirs) == len(lazy.fixed_indices_eval_dataloader) > 1
    for (camera, data), (other, expected) in zip(ours, theirs, strict=True):
        assert torch.equal(data["image"], expected["image"])
        assert torch.equal(camera.camera_to_worlds, other.camera_to_worlds)
    seen = [lazy.next_eval(step)[1]["image_idx"] for step in range(len(ours))]
    assert sorted(seen) == list(range(len(ours)))


def test_a_sweep_trains_on_the_photos_of_a_run(trained_walls, tmp_path, monkeypatch):
    run = run_of(trained_walls, "wall-b")
    monkeypatch.setitem(PHOTO_STEPS, "quick", 64)
    found = ps.measure_tradeoff(run, tmp_path / "trade", keep=("10%",), repairs=("none", "photos"))
    photos = run_photos(run, "test")
    scene = ps.load(run)
    errors = [
        ps.psnr(ps.render(scene, photo.view), in_unit_range(photo.target)) for photo in photos
    ]
    assert found.points[0].against_photos.psnr == pytest.approx(
        float(torch.stack(errors).mean()), abs=1e-4
    )
    assert found.scene == "wall-b" and found.views_origin == "held-out photos of the dataset"
    trained = next(point for point in found.points if point.repair == "photos")
    pruned = next(
        point
        for point in found.points
        if point.repair == "none" and point.gaussians == trained.gaussians
    )
    assert trained.against_photos.psnr > pruned.against_photos.psnr + 0.1
    assert " --photos " in trained.command


WIDTH = 40
HEIGHT = 30


def make_dataset(
    folder: Path,
    num: int = 5,
    distortion: list[float] | None = None,
    camera_type: CameraType = CameraType.PERSPECTIVE,
    masks: bool = False,
    scale: float = 1.0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> UndistortedDataset:
    width, height = size
    rng = np.random.default_rng(7)
    photos, mask_paths = (
        [folder / f"{kind}{i}.png" for i in range(num)] for kind in ("photo", "mask")
    )
    for i in range(num):
        cv2.imwrite(
            str(photos[i]), cv2.resize(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), size)
        )
        mask = np.full((height, width), 255, np.uint8)
        mask[:, : 5 + i] = 0
        cv2.imwrite(str(mask_paths[i]), mask)
    poses = torch.eye(4)[None, :3].repeat(num, 1, 1)
    poses[:, 0, 3] = torch.arange(num)
    lens = None if distortion is None else torch.tensor(distortion)
    metadata = {"fisheye_crop_radius": 14.0} if camera_type == CameraType.FISHEYE624 else None
    cameras = Cameras(
        poses, 35.0, 36.0, 20.5, 14.0, width, height, lens, camera_type, metadata=metadata
    )
    outputs = DataparserOutputs(
        image_filenames=photos,
        cameras=cameras,
        mask_filenames=mask_paths if masks else None,
        scene_box=SceneBox(aabb=torch.zeros(2, 3)),
    )
    return UndistortedDataset(outputs, scale_factor=scale)


ARIA = CameraType.FISHEYE624
"""The lens of Project Aria's glasses; nerfstudio makes masks of its own for it, and takes no
others."""


@pytest.mark.parametrize(
    ("distortion", "camera_type", "masks"),
    [
        (None, CameraType.PERSPECTIVE, False),
        ([0.1, -0.05, 0.0, 0.0, 0.01, -0.01], CameraType.PERSPECTIVE, True),
        ([0.05, 0.01, 0.0, 0.0, 0.0, 0.0], CameraType.FISHEYE, True),
        ([0.02, -0.01, *[0.0] * 10], ARIA, False),
    ],
)
def test_image_mask_and_intrinsics_are_those_nerfstudio_caches(
    tmp_path, distortion, camera_type, masks
):
    dataset = make_dataset(tmp_path, distortion=distortion, camera_type=camera_type, masks=masks)
    frames = Frames(dataset)
    changed, _ = frames[0]
    changed.rescale_output_resolution(0.5)  # must not change the next
    got = [frames[i] for i in range(5)]
    with pytest.raises(IndexError):
        frames[5]

    manager = FullImageDatamanager.__new__(FullImageDatamanager)
    torch.nn.Module.__init__(manager)
    manager.config = FullImageDatamanagerConfig(cache_images_type="uint8")
    manager.train_dataset = InputDataset(dataset._dataparser_outputs)
    manager.device = "cpu"
    expected = manager._load_images("train", cache_images_device="gpu")
    for i, (camera, data) in enumerate(got):
        assert (
            torch.equal(data["image"], expected[i]["image"]) and data["image"].dtype == torch.uint8
        )
        assert ("mask" in data) == (masks or camera_type == ARIA) and data["image_idx"] == i
        assert (
            "mask" not in data
            or torch.equal(data["mask"], expected[i]["mask"])
            and data["mask"].dtype == torch.bool
        )
        theirs = manager.train_dataset.cameras[i : i + 1]
        assert torch.equal(camera.get_intrinsics_matrices(), theirs.get_intrinsics_matrices())
        assert (
            data["image"].shape[:2]
            == (int(camera.height), int(camera.width))
            == (theirs.height, theirs.width)
        )
        assert torch.equal(camera.camera_to_worlds, theirs.camera_to_worlds)


@pytest.mark.parametrize("scale", [1 / 3, 0.29, 0.58])
def test_reduced_photos_are_of_the_size_of_their_cameras(tmp_path, scale):
    """Some products of a size and a scale are a whole number in float32, and just below it in
    float64."""
    for width, height in ((540, 360), (360, 640), (100, 50)):
        dataset = make_dataset(tmp_path, num=1, scale=scale, size=(width, height))
        camera = dataset.cameras[0]
        image = dataset.get_data(0, "uint8")["image"]
        assert (int(camera.width), int(camera.height)) == (image.shape[1], image.shape[0])


@pytest.mark.parametrize("damage", ["missing", "truncated", "other size", "mask"])
def test_a_bad_photo_is_named(tmp_path, damage):
    frames = Frames(make_dataset(tmp_path, masks=True))
    photo = tmp_path / "photo2.png"
    if damage == "truncated":
        photo.write_bytes(photo.read_bytes()[:200])
    elif damage == "other size":
        Image.new("RGB", (WIDTH + 2, HEIGHT)).save(photo)
        Image.new("L", (WIDTH + 2, HEIGHT)).save(tmp_path / "mask2.png")
    else:
        (tmp_path / "mask2.png" if damage == "mask" else photo).unlink()
    with pytest.raises(DataError, match="mask2.png" if damage == "mask" else "photo2.png"):
        frames[2]
    assert frames[1][1]["image_idx"] == 1


def test_a_lens_that_cannot_be_undone_is_named(tmp_path):
    with pytest.raises(DataError, match="photo0.png.*distortion"):
        make_dataset(tmp_path, distortion=[0.1, 0.0, 0.0, 0.2, 0.0, 0.0])
    with pytest.raises(DataError, match="photo0.png.*Only perspective and fisheye"):
        make_dataset(tmp_path, camera_type=CameraType.EQUIRECTANGULAR)


def test_photos_of_several_times_are_refused_as_a_scene_here_has_none(tmp_path):
    outputs = make_dataset(tmp_path)._dataparser_outputs
    outputs.cameras.times = torch.tensor([[0.0], [0.5], [1.0], [0.5], [0.0]])
    with pytest.raises(
        DataError, match=f"{tmp_path}: its 5 photos are of 3 different times; .* not move"
    ):
        UndistortedDataset(outputs)
    outputs.cameras.times = torch.full((5, 1), 0.5)
    assert len(UndistortedDataset(outputs)) == 5


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "I;16", "P"])
def test_only_photos_that_nerfstudio_reads_rightly_are_read(tmp_path, mode):
    dataset = make_dataset(tmp_path)
    Image.new(mode, (WIDTH, HEIGHT)).save(dataset.image_filenames[2])
    if mode in ("I;16", "P"):
        with pytest.raises(
            DataError, match="photo2.png: cannot be read .* its pixels are of mode .*expected 8-bit"
        ):
            Frames(dataset)[2]
    else:
        assert Frames(dataset)[2][1]["image"].shape == (HEIGHT, WIDTH, 4 if mode == "RGBA" else 3)


@pytest.mark.parametrize(
    ("orientation", "hint"), [(3, "give the camera the size"), (6, "mogrify -auto-orient")]
)
def test_a_photo_that_its_exif_turns_is_said(tmp_path, orientation, hint):
    """The camera is that of the turned photo; the pixels are stored as the sensor had them."""
    dataset = make_dataset(tmp_path)
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (HEIGHT, WIDTH)).save(dataset.image_filenames[2], exif=exif)
    with pytest.raises(DataError, match=f"photo2.png: .* pixels, but its camera says .*{hint}"):
        Frames(dataset)[2]


@pytest.mark.parametrize(
    ("name", "value"), [("camera_to_worlds", float("nan")), ("cy", float("inf"))]
)
def test_a_camera_that_is_not_finite_names_its_photo(tmp_path, name, value):
    outputs = make_dataset(tmp_path)._dataparser_outputs
    numbers = getattr(outputs.cameras, name).clone()  # one number may stand for all cameras
    for index in (1, 3):
        numbers[index].view(-1)[-1] = value
    setattr(outputs.cameras, name, numbers)
    with pytest.raises(
        DataError, match="photo1.png: .* frame 1 hold NaN or infinity, as do those of 1 more of 5"
    ):
        UndistortedDataset(outputs)
