"""Images of a stranger: formats of photos alone are decoded, regular files alone opened, no image
takes the memory that its header asks for, and no other program starts."""

import json
import os
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import EpsImagePlugin, Image

from hostile import POSTSCRIPT, png_of, webp_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.datamanager import (
    LazyImageDatamanager,
    LazyImageDatamanagerConfig,
)
from pointsplat_ns.nerfstudio_plugin.frames import UndistortedDataset
from pointsplat_ns.nerfstudio_plugin.image_guard import photos_alone
from pointsplat_ns.nerfstudio_plugin.replica.layout import PinholeParams, read_depth, read_photo
from pointsplat_ns.scene.camera_files.camera_views import Camera
from pointsplat_ns.scene.image_files import IMAGE_FORMATS, exif_hint, open_image, read_reduced
from pointsplat_ns.scene.photo_files import PHOTO_SUFFIXES, PhotoReader

HOSTILE = {
    "postscript": POSTSCRIPT,
    "bomb": png_of(20_000, 20_000),
    "large": png_of(13_000, 12_000),
    "webp": webp_of(16_383, 16_383),
    "pipe": None,
}

pytestmark = pytest.mark.filterwarnings("error::PIL.Image.DecompressionBombWarning")


def opened_by_others(path: Path):
    """As nerfstudio's dataparsers open photos, and decode some."""
    with photos_alone(), Image.open(path) as image:
        image.load()


CAMERA = Camera(
    "a.png", torch.eye(4).flatten().tolist(), (64, 48), (50.0, 50.0), (32.0, 24.0), "PINHOLE"
)
PARAMS = PinholeParams(64, 48, 50.0, 50.0, 32.0, 24.0, 1000.0, Path("cam_params.json"))


def masked(path: Path):
    photo = path.with_name("photo.png")
    Image.new("RGB", (64, 48)).save(photo)
    return PhotoReader(path.parent, 64).read(photo, CAMERA._replace(mask=path.name))


def dataset_of(photo: Path, mask: Path | None = None) -> UndistortedDataset:
    cameras = Cameras(torch.eye(4)[None, :3], 50.0, 50.0, 32.0, 24.0, 64, 48)
    masks = None if mask is None else [mask]
    return UndistortedDataset(DataparserOutputs([photo], cameras, mask_filenames=masks))


def masked_dataset(path: Path):
    photo = path.with_name("photo.png")
    Image.new("RGB", (64, 48)).save(photo)
    return dataset_of(photo, path).get_data(0)


def training_data(path: Path):
    """The data of ``ns-train splatfacto-cpu``: its dataparser asks the first photo for its size."""
    frames = [
        {"file_path": path.name, "transform_matrix": torch.eye(4).tolist()} for _ in range(12)
    ]
    content = {"fl_x": 50, "fl_y": 50, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": frames}
    path.with_name("transforms.json").write_text(json.dumps(content))
    return LazyImageDatamanager(
        LazyImageDatamanagerConfig(dataparser=NerfstudioDataParserConfig(data=path.parent))
    )


READERS = {
    "photo": lambda path: PhotoReader(path.parent, 64).read(path, CAMERA),
    "size": lambda path: PhotoReader(path.parent, 64).size(path, CAMERA),
    "mask": masked,
    "replica": lambda path: read_photo(path, PARAMS),
    "depth": lambda path: read_depth(path, PARAMS),
    "others": opened_by_others,
    "dataset": lambda path: dataset_of(path).get_data(0),
    "mask of a dataset": masked_dataset,
    "training": training_data,
}


@pytest.fixture(params=HOSTILE)
def hostile(request, tmp_path, monkeypatch, time_limit) -> Path:
    path = tmp_path / "i00.png"
    content = HOSTILE[request.param]
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    monkeypatch.setattr(
        EpsImagePlugin, "Ghostscript", lambda *_: pytest.fail("Ghostscript is started")
    )
    return path


@pytest.mark.parametrize("reader", READERS)
def test_it_is_refused_in_one_line_by_each_reader(reader, hostile):
    with pytest.raises(DataError, match=r"(i00|photo)\.png: ") as raised:
        READERS[reader](hostile)
    assert "\n" not in str(raised.value)


def test_it_has_no_thumbnail_and_no_orientation(hostile):
    assert read_reduced(hostile, 96) is None and exif_hint(hostile, (48, 64)) == ""


def test_each_kind_of_photo_is_opened(tmp_path):
    pixels = torch.arange(64 * 48 * 3).remainder(251).reshape(48, 64, 3).to(torch.uint8)
    known = {suffix: Image.registered_extensions()[suffix] for suffix in PHOTO_SUFFIXES}
    assert {*known.values(), "PPM"} == {*IMAGE_FORMATS}
    for suffix in known:
        path = tmp_path / f"a{suffix}"
        Image.fromarray(pixels.numpy()).save(path)
        with open_image(path) as image:
            assert image.size == (64, 48) and image.convert("RGB").getpixel((0, 0))[2] < 9
        with photos_alone(), Image.open(path) as image:
            assert image.size == (64, 48)


def test_pillow_is_as_before_when_the_guard_is_left(tmp_path):
    before = Image.open
    with pytest.raises(FileNotFoundError), photos_alone():
        Image.open(tmp_path / "none.png")
    assert Image.open is before
