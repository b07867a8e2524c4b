"""Posed photos loaded when due, and what is kept of them in memory."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.scene_box import SceneBox
from PIL import Image

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.frames import Frames, UndistortedDataset

WIDTH, HEIGHT = 40, 30


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
    photos, mask_paths = [], []
    for i in range(num):
        small = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
        photos.append(folder / f"photo{i}.png")
        cv2.imwrite(str(photos[-1]), cv2.resize(small, (width, height)))
        mask_paths.append(folder / f"mask{i}.png")
        mask = np.full((height, width), 255, np.uint8)
        mask[:, : 5 + i] = 0
        cv2.imwrite(str(mask_paths[-1]), mask)
    poses = torch.eye(4)[None, :3].repeat(num, 1, 1)
    poses[:, 0, 3] = torch.arange(num)
    lens = None if distortion is None else torch.tensor(distortion)
    metadata = {"fisheye_crop_radius": 14.0} if camera_type == CameraType.FISHEYE624 else None
    cameras = Cameras(poses, 35.0, 36.0, 20.5, 14.0, width, height, lens, camera_type, metadata=metadata)
    outputs = DataparserOutputs(
        image_filenames=photos,
        cameras=cameras,
        mask_filenames=mask_paths if masks else None,
        scene_box=SceneBox(aabb=torch.zeros(2, 3)),
    )
    return UndistortedDataset(outputs, scale_factor=scale)


ARIA = CameraType.FISHEYE624
"""The lens of Project Aria's glasses; nerfstudio makes masks of its own for it, and takes no others."""


@pytest.mark.parametrize(
    ("distortion", "camera_type", "masks"),
    [
        (None, CameraType.PERSPECTIVE, False),
        ([0.1, -0.05, 0.0, 0.0, 0.01, -0.01], CameraType.PERSPECTIVE, True),
        ([0.05, 0.01, 0.0, 0.0, 0.0, 0.0], CameraType.FISHEYE, True),
        ([0.02, -0.01, *[0.0] * 10], ARIA, False),
    ],
)
def test_image_mask_and_intrinsics_are_those_nerfstudio_caches(tmp_path, distortion, camera_type, masks):
    dataset = make_dataset(tmp_path, distortion=distortion, camera_type=camera_type, masks=masks)
    frames = Frames(dataset)
    got = [frames[i] for i in range(5)]
    got_again = [frames[i] for i in range(5)]

    manager = FullImageDatamanager.__new__(FullImageDatamanager)
    torch.nn.Module.__init__(manager)
    manager.config = FullImageDatamanagerConfig(cache_images_type="uint8")
    manager.train_dataset, manager.device = InputDataset(dataset._dataparser_outputs), "cpu"
    expected = manager._load_images("train", cache_images_device="gpu")
    for i, (camera, data) in enumerate(got):
        assert torch.equal(data["image"], expected[i]["image"]) and data["image"].dtype == torch.uint8
        assert torch.equal(data["image"], got_again[i][1]["image"])
        assert ("mask" in data) == (masks or camera_type == ARIA) and data["image_idx"] == i
        if "mask" in data:
            assert torch.equal(data["mask"], expected[i]["mask"]) and data["mask"].dtype == torch.bool
        theirs = manager.train_dataset.cameras[i : i + 1]
        assert camera.shape == (1,)
        assert torch.equal(camera.get_intrinsics_matrices(), theirs.get_intrinsics_matrices())
        assert (int(camera.width), int(camera.height)) == (int(theirs.width), int(theirs.height))
        assert data["image"].shape[:2] == (int(camera.height), int(camera.width))
        assert torch.equal(camera.camera_to_worlds, theirs.camera_to_worlds)


@pytest.mark.parametrize("scale", [1 / 3, 0.29, 0.58])
def test_reduced_photos_are_of_the_size_of_their_cameras(tmp_path, scale):
    """Some products of a size and a scale are a whole number in float32, and just below it in float64."""
    for width, height in ((540, 360), (360, 640), (100, 50)):
        dataset = make_dataset(tmp_path, num=1, scale=scale, size=(width, height))
        camera, image = dataset.cameras[0], dataset.get_data(0, "uint8")["image"]
        assert (int(camera.width), int(camera.height)) == (image.shape[1], image.shape[0])


def test_writing_to_what_was_handed_out_does_not_change_the_next(tmp_path):
    frames = Frames(make_dataset(tmp_path))
    camera, data = frames[0]
    camera.rescale_output_resolution(0.5)
    del data["image"]
    camera, data = frames[-5]
    assert int(camera.width) == WIDTH and "image" in data
    with pytest.raises(IndexError):
        frames[5]


@pytest.mark.parametrize("damage", ["missing", "truncated", "other size", "mask"])
def test_a_bad_photo_is_named(tmp_path, damage):
    frames = Frames(make_dataset(tmp_path, masks=True))
    photo = tmp_path / "photo2.png"
    if damage == "truncated":
        photo.write_bytes(photo.read_bytes()[:200])
    elif damage == "other size":
        for path in (photo, tmp_path / "mask2.png"):
            cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH + 2, 3 if path == photo else 1), np.uint8))
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


@pytest.mark.parametrize(("times", "count"), [([0.0, 0.5, 1.0, 0.5, 0.0], 3), ([0.0, 0.0, 0.0, 0.0, float("nan")], 2)])
def test_photos_of_several_times_are_refused_as_a_scene_here_has_none(tmp_path, times, count):
    outputs = make_dataset(tmp_path)._dataparser_outputs
    outputs.cameras.times = torch.tensor(times)[:, None]
    with pytest.raises(DataError, match=f"{tmp_path}: its 5 photos are of {count} different times; .* not move"):
        UndistortedDataset(outputs)
    outputs.cameras.times = torch.full((5, 1), 0.5)
    assert len(UndistortedDataset(outputs)) == 5


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "I;16", "P"])
def test_only_photos_that_nerfstudio_reads_rightly_are_read(tmp_path, mode):
    dataset = make_dataset(tmp_path)
    Image.new(mode, (WIDTH, HEIGHT)).save(dataset.image_filenames[2])
    if mode in ("I;16", "P"):
        with pytest.raises(DataError, match="photo2.png: cannot be read .* its pixels are of mode .*expected 8-bit"):
            Frames(dataset)[2]
    else:
        assert Frames(dataset)[2][1]["image"].shape == (HEIGHT, WIDTH, 4 if mode == "RGBA" else 3)


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_photo_that_its_exif_turns_is_said(tmp_path, orientation):
    """The camera is that of the turned photo; the pixels are stored as the sensor had them."""
    dataset = make_dataset(tmp_path)
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", (HEIGHT, WIDTH)).save(dataset.image_filenames[2], exif=exif)
    with pytest.raises(DataError, match="photo2.png: .* pixels, but its camera says") as caught:
        Frames(dataset)[2]
    said = f"its EXIF orientation ({orientation}) says that it is to be turned" in str(caught.value)
    assert said == ("mogrify -auto-orient" in str(caught.value)) == (orientation == 6)


@pytest.mark.parametrize(("name", "value"), [("camera_to_worlds", float("nan")), ("cy", float("inf"))])
def test_a_camera_that_is_not_finite_names_its_photo(tmp_path, name, value):
    outputs = make_dataset(tmp_path)._dataparser_outputs
    numbers = getattr(outputs.cameras, name).clone()  # one number may stand for all cameras
    for index in (1, 3):
        numbers[index].view(-1)[-1] = value
    setattr(outputs.cameras, name, numbers)
    with pytest.raises(DataError, match="photo1.png: .* frame 1 hold NaN or infinity, as do those of 1 more of 5"):
        UndistortedDataset(outputs)
