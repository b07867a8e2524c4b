"""Files of cameras are read as their own projects read them; anything else is refused in one line,
without harm."""

import math
import os
import re
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.process_data.colmap_utils import parse_colmap_camera_params
from PIL import Image
from refusing import fails

import pointsplat_ns as ps
from making import several_sizes
from pointsplat_ns.geometry.transforms import invert_rigid, rotation_matrices, viewmats_to_opengl
from pointsplat_ns.scene.camera_files import camera_views as cameras
from pointsplat_ns.scene.camera_files import is_camera_file, read_named_views
from posing import (
    inria,
    name_of,
    nerfstudio,
    nerfstudio_of_several_sizes,
    write_colmap,
    write_sparse,
    write_sparse_of_several_sizes,
    written,
)


def read_views(path: Path) -> ps.Views:
    return read_named_views(path).views


def some_views(
    count: int = 12, width: int = 64, height: int = 48, centred: bool = False
) -> ps.Views:
    generator = torch.Generator().manual_seed(3)
    turns = rotation_matrices(torch.randn(count, 4, generator=generator, dtype=torch.float64))
    places = torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)
    cx, cy = (width / 2, height / 2) if centred else (30.5, 25.25)
    K = torch.tensor([[50.0, 0, cx], [0, 52.0, cy], [0, 0, 1]], dtype=torch.float64)
    return ps.Views(
        invert_rigid(torch.cat([turns, places], dim=2)),
        K.repeat(count, 1, 1),
        width,
        height,
        torch.zeros(3),
    )


def need_same(found: ps.Views, expected: ps.Views, within: float = 1e-9) -> None:
    assert (len(found), found.width, found.height) == (
        len(expected),
        expected.width,
        expected.height,
    )
    torch.testing.assert_close(found.viewmats, expected.viewmats.double(), rtol=0, atol=within)
    torch.testing.assert_close(found.Ks, expected.Ks.double(), rtol=0, atol=within)


def without(content: dict, *names: str) -> dict:
    return {name: value for name, value in content.items() if name not in names}


def framed(**changes) -> dict:
    """A ``transforms.json`` of one frame, which is changed; None takes a part away."""
    content = nerfstudio(some_views(1))
    content["frames"][0] = {
        k: v for k, v in {**content["frames"][0], **changes}.items() if v is not None
    }
    return content


WRITERS = {
    "inria": lambda views, folder: written(inria(views), folder / "cameras.json"),
    "nerfstudio": lambda views, folder: written(nerfstudio(views), folder / "transforms.json"),
    # by nerfstudio's own writer
    "colmap text": lambda views, folder: write_sparse(views, folder / "sparse"),
    "colmap binary": lambda views, folder: write_sparse(views, folder / "sparse", ".bin"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_are_those_that_were_written(kind, tmp_path):
    views = some_views(centred=kind == "inria")
    path = WRITERS[kind](views, tmp_path)
    assert is_camera_file(path)
    need_same(read_views(path), views)


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ("sparse/0", "."),
        ("sparse", "."),
        ("colmap/sparse/0", "."),
        ("sparse/0", "sparse/0/images.bin"),
    ],
)
def test_the_model_of_a_colmap_project_is_found_below_its_root(model, named, tmp_path):
    views = some_views()
    write_sparse(views, tmp_path / model, ".bin")
    (tmp_path / "images").mkdir()
    assert is_camera_file(tmp_path / named)
    need_same(read_views(tmp_path / named), views)


def test_a_camera_of_3dgs_looks_along_its_third_column(tmp_path):
    entry = {
        "id": 0,
        "img_name": "a",
        "width": 60,
        "height": 40,
        "fx": 30.0,
        "fy": 30.0,
        "position": [1.0, 2.0, 3.0],
        "rotation": [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
    }
    view = read_views(written([entry], tmp_path / "cameras.json"))[0]
    ahead, below = torch.tensor(
        [[3.0, 2.0, 3.0, 1.0], [3.0, 2.0, 2.0, 1.0]], dtype=torch.float64
    )  # z is up
    torch.testing.assert_close((view.viewmat @ ahead)[:3], torch.tensor([0.0, 0.0, 2.0]).double())
    torch.testing.assert_close((view.viewmat @ below)[:3], torch.tensor([0.0, 1.0, 2.0]).double())


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (50.0, 30.5, 25.25)),
        ("PINHOLE", (50.0, 52.0, 30.5, 25.25)),
        ("SIMPLE_RADIAL", (50.0, 30.5, 25.25, 0.0)),
        ("RADIAL", (50.0, 30.5, 25.25, 0.0, 0.0)),
        ("OPENCV", (50.0, 52.0, 30.5, 25.25, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_colmap_models_are_what_nerfstudio_reads(model, params, suffix, tmp_path):
    """The oracle is nerfstudio's own reader: names, poses, and focal lengths and principal points
    of each model, from the same files."""
    viewmats = some_views(12).viewmats.numpy()
    poses = {name_of(index): viewmat for index, viewmat in enumerate(viewmats)}
    folder = write_colmap(tmp_path, suffix, (model, 64, 48, [*params]), poses)
    cameras, images, _ = colmap_parsing_utils.read_model(str(folder), suffix)
    images = {image.name: image for image in images.values()}
    found = read_named_views(folder)
    names = [camera.name for camera in found.cameras]
    assert sorted(names) == sorted(images) and len(images) == 12
    for name, view in zip(names, found.views, strict=True):
        image = images[name]
        # 1e-9: both make the same rotation of one quaternion in float64
        assert np.allclose(view.viewmat[:3, :3].numpy(), image.qvec2rotmat(), atol=1e-9)
        assert np.allclose(view.viewmat[:3, 3].numpy(), image.tvec, atol=1e-9)
        lens = parse_colmap_camera_params(cameras[image.camera_id])
        expected = [[lens["fl_x"], 0, lens["cx"]], [0, lens["fl_y"], lens["cy"]], [0, 0, 1]]
        assert view.K.tolist() == expected and (view.width, view.height) == (lens["w"], lens["h"])


def test_poses_are_moved_to_where_nerfstudio_trains(tmp_path):
    parsers = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    views = some_views()
    applied = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.5]]
    content = {**nerfstudio(views), "applied_transform": applied, "applied_scale": 2.0}
    path = written(content, tmp_path / "transforms.json")
    (tmp_path / "images").mkdir()
    for frame in content["frames"]:
        Image.new("RGB", (64, 48)).save(tmp_path / frame["file_path"])
    config = parsers.NerfstudioDataParserConfig(
        data=tmp_path, eval_mode="all", load_3D_points=False
    )
    outputs = config.setup().get_dataparser_outputs("train")
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    by_name = dict(
        zip(
            (p.name for p in outputs.image_filenames), outputs.cameras.camera_to_worlds, strict=True
        )
    )
    expected = torch.stack([by_name[name_of(index)] for index in range(len(views))])
    # nerfstudio computes in float32
    torch.testing.assert_close(
        viewmats_to_opengl(read_views(path).viewmats).float(), expected, rtol=0, atol=2e-6
    )


def test_transforms_that_are_no_rigid_motion_are_refused(tmp_path):
    path = written(nerfstudio(some_views()), tmp_path / "transforms.json")
    doubled = {"transform": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]], "scale": 1}
    written(doubled, tmp_path / "dataparser_transforms.json")
    fails(
        lambda: read_views(path),
        "dataparser_transforms.json: its transform is not a rigid motion",
        error=ps.DataError,
    )


@pytest.mark.parametrize(
    ("model", "extra"), [("OPENCV", (0.1, 0.0, 0.0, 0.0)), ("OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0))]
)
def test_distortion_is_left_out_and_said_to_be(model, extra, tmp_path, caplog):
    caplog.set_level("INFO")
    views = some_views(3)
    text = write_sparse(views, tmp_path / "text", ".txt", model, extra)
    binary = write_sparse(views, tmp_path / "binary", ".bin", model, extra)
    file = written(
        {**nerfstudio(views), "camera_model": model, "k1": extra[0]}, tmp_path / "transforms.json"
    )
    for path in (text, binary, file):
        caplog.clear()
        need_same(read_views(path), views)
        assert f"{path}: the lens distortion of 3 of 3 cameras is ignored" in caplog.text


@pytest.mark.parametrize(
    ("model", "params", "focal", "centre"),
    [
        ("SIMPLE_PINHOLE", "50 30 20", (50, 50), (30, 20)),
        ("PINHOLE", "50 51 30 20", (50, 51), (30, 20)),
        ("FULL_OPENCV", "50 51 30 20 1 2 3 4 5 6 7 8", (50, 51), (30, 20)),
    ],
)
def test_focal_lengths_and_principal_point_of_each_model_of_colmap(
    model, params, focal, centre, tmp_path
):
    folder = write_sparse(some_views(1), tmp_path)
    (folder / "cameras.txt").write_text(f"3 {model} 64 48 {params}\n")
    K = read_views(folder).Ks[0]
    assert K.diagonal()[:2].tolist() == [*focal] and K[:2, 2].tolist() == [*centre]


@pytest.mark.parametrize("kind", ["cameras.json", "transforms.json", "colmap"])
def test_each_camera_keeps_its_own_size(kind, tmp_path):
    views = several_sizes(some_views(8, centred=True))
    if kind == "colmap":
        found = read_views(write_sparse_of_several_sizes(views, tmp_path / "sparse"))
    else:
        content = inria(views) if kind == "cameras.json" else nerfstudio_of_several_sizes(views)
        found = read_views(written(content, tmp_path / kind))
    need_same(found, views)
    assert [size[:2] for size in found.size_of_each()] == [s[:2] for s in views.images]


def inria_with(**changes) -> list:
    return [
        *inria(some_views(1, centred=True)),
        {**inria(some_views(1, centred=True))[0], **changes},
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[" * 100_000, "cannot be read as JSON"),
        ({"camera_path": []}, "camera path of `ns-render`; expected"),
        ([], "0 cameras; expected 1 to 100000"),
        (inria_with(position=[10**400, 0, 0]), r"the pose of camera 1 (.*)?is not a rigid motion"),
        (inria_with(position=[1e10, 0, 0]), r"camera 1 \(frame_0.png\) is too far away"),
        (
            inria_with(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
            r"the pose of camera 1 (.*)?is not a rigid motion",
        ),
        (inria_with(fx=1e12), "camera 1 .* has no usable focal length"),
        ({"fl_x": 5, "w": 4, "h": 4, "frames": [3]}, "camera 0 is not a frame"),
        (framed(cx=1e9), "camera 0 .* has its principal point far outside"),
        (
            framed(camera_model="EQUIRECTANGULAR"),
            "camera 0 is 'EQUIRECTANGULAR'; expected one of SIMPLE_PINHOLE",
        ),
        (
            {**framed(), "applied_transform": [[1, 2]]},
            "its 'applied_transform' or 'applied_scale' is not usable",
        ),
        (
            {**framed(), "applied_transform": [[0, 0, 0, 0]] * 3},
            "its 'applied_transform' is not a rigid motion",
        ),
        (without(framed(), "fl_x", "fl_y"), "camera 0 has no focal length"),
        (without(framed(), "w"), "camera 0 has no size, and .*; expected numbers 'w' and 'h'"),
    ],
)
def test_other_json_is_refused_in_one_line(content, message, tmp_path):
    path = written(content, tmp_path / "cameras.json")
    said = fails(lambda: read_views(path), error=ps.DataError)
    assert said.startswith(str(path)) and re.search(message, said)


def damaged(file: str, change) -> Callable[[Path], Path]:
    """A function that writes a model and changes the bytes of one of its files."""

    def write(folder: Path) -> Path:
        write_sparse(some_views(2), folder, Path(file).suffix)
        (folder / file).write_bytes(change((folder / file).read_bytes()))
        return folder

    return write


def images_with(at: int, value: bytes) -> Callable[[Path], Path]:
    return damaged("images.bin", lambda data: data[:at] + value + data[at + len(value) :])


NAME_AT = 8 + 64
"""Where the name of the first image begins."""

POINTS_AT = NAME_AT + len(name_of(0)) + 1


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (
            damaged("cameras.txt", lambda _: b"3 PINHOLE 64 48 50 50 30\n"),
            "cameras.txt: '3 PINHOLE 64 48 50 50 30' is not a camera",
        ),
        (
            damaged("cameras.txt", lambda _: b"3 EQUIRECTANGULAR 64 48 64 48\n"),
            "model EQUIRECTANGULAR; expected one of",
        ),
        (
            damaged("images.txt", lambda _: b"1 1 0 0 0 0 0 0 3\n\n"),
            "images.txt: '1 1 0 0 0 0 0 0 3' is not an image",
        ),
        (
            damaged("images.txt", lambda _: b"1 1 0 0 0 0 0 0 3 " + b"a" * 10_000),
            "a line of more than 4096 bytes",
        ),
        (
            images_with(0, struct.pack("<Q", 2**63)),
            r"images.bin: declares \d+ entries, has room for 2",
        ),
        (
            images_with(8 + 4, struct.pack("<d", math.nan)),
            "the pose of camera 0 .frame_0.png. is not a rigid motion",
        ),
        (
            images_with(POINTS_AT, struct.pack("<Q", 2**62)),
            "an image with 4611686018427387904 points, more than the file",
        ),
        (images_with(NAME_AT, b"a" * 20_000), "image name does not end within 4096 bytes"),
        (
            damaged("images.bin", lambda data: data[: NAME_AT + 3]),
            r"images.bin: declares 2 entries, has room for 0",
        ),
    ],
)
def test_damaged_colmap_models_are_refused_in_one_line(write, message, tmp_path):
    folder = write(tmp_path / "sparse")
    said = fails(lambda: read_views(folder), error=ps.DataError)
    assert said.startswith(str(folder)) and re.search(message, said)


def test_points_take_no_memory(tmp_path):
    """One image with two million points, of which the file holds none on the disk, and one of text
    as long."""
    folder = write_sparse(some_views(1), tmp_path / "binary", ".bin")
    data = bytearray((folder / "images.bin").read_bytes())
    data[POINTS_AT:] = struct.pack("<Q", 2_000_000)
    (folder / "images.bin").write_bytes(data)
    os.truncate(folder / "images.bin", len(data) + 24 * 2_000_000)
    text = write_sparse(some_views(1), tmp_path / "text")
    (text / "images.txt").write_text("1 1 0 0 0 0 0 0 3 a.png\n" + "1.5 2.5 -1 " * 1_000_000 + "\n")
    for path in (folder, text):
        read_views(path)
        tracemalloc.start()
        try:
            assert len(read_views(path)) == 1
            assert tracemalloc.get_traced_memory()[1] < 1e6
        finally:
            tracemalloc.stop()


def test_missing_and_huge_files_and_other_folders_are_refused(tmp_path, monkeypatch):
    with pytest.raises(
        ps.SceneError, match="no such file; expected cameras.json of 3DGS, transforms.json"
    ):
        read_views(tmp_path / "nothing.json")
    fails(
        lambda: read_views(tmp_path),
        "no cameras.bin or cameras.txt in the folder or its sparse/0; expected",
    )
    folder = write_sparse(some_views(2), tmp_path / "sparse", ".bin")
    (folder / "cameras.bin").unlink()
    with pytest.raises(ps.DataError, match="cameras.bin: no such file; expected a COLMAP model"):
        read_views(folder)
    path = written(nerfstudio(some_views()), tmp_path / "transforms.json")
    monkeypatch.setattr(cameras, "MOST_CAMERAS", 3)
    with pytest.raises(ps.DataError, match="12 cameras; expected 1 to 3"):
        read_views(path)
    os.truncate(path, 65_000_000)
    with pytest.raises(ps.DataError, match="65 MB; expected cameras of at most 64 MB"):
        read_views(path)
