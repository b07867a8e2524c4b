"""Files as other programs write them are read as those programs mean them, or refused by name.

The files in ``cases`` were made from the example room, in the form that the named program writes.
"""

import io
import json
import math
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plys import columns_of, write_columns
from refusing import fails

import pointsplat_ns as ps
from making import SHARED_DATA, cloud, same_bits
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.activated import activated_in
from pointsplat_ns.scene.camera_files import read_named_views
from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.ply import PlyRows
from pointsplat_ns.view_sampling.sampler import Sampler

CASES = Path(__file__).parent / "cases"


def test_every_image_of_a_colmap_model_without_lines_of_points_is_read():
    found = read_named_views(CASES / "colmap_no_blank_lines")
    assert found.names == [f"{index:03d}.png" for index in range(16)]


@pytest.mark.parametrize(
    "points",
    [
        None,
        b"",
        b"1.5 2.5 -1",
        b"1.5 2.5 -1 nan nan 7 " * 4,
        b"1.5 2.5 -1 " * 3000,
        b"# no points",
    ],
)
def test_lines_of_points_may_be_there_empty_or_missing(points, tmp_path):
    """Twelve words are as many as the line of an image may have."""
    (tmp_path / "cameras.txt").write_bytes(b"1 PINHOLE 64 48 50 50 32 24\n")
    after = b"" if points is None else points + b"\n"
    names = [b"1", b"2 of 9", b"a b c.png"]
    lines = [b"%d 1 0 0 0 0 0 0 1 %s\n" % (index, name) for index, name in enumerate(names)]
    (tmp_path / "images.txt").write_bytes(after.join(lines) + after)
    assert read_named_views(tmp_path).names == [name.decode() for name in names]


def without_count(data: bytes, **extra: object) -> bytes:
    """A SOG file whose palette has no ``count``."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w") as new:
        for name in old.namelist():
            part = old.read(name)
            if name == "meta.json":
                meta = json.loads(part)
                del meta["shN"]["count"]
                part = json.dumps({**meta, "shN": {**meta["shN"], **extra}}).encode()
            new.writestr(name, part)
    return stream.getvalue()


def test_a_palette_of_lichtfeld_has_its_size_under_another_name():
    scene = ps.load(CASES / "lichtfeld_palette_size.sog")
    written = ps.place(ps.example_room()[::300], up="z:-y")
    assert (len(scene), scene.sh_degree) == (len(written), 1)
    nearest = written[torch.cdist(scene.means, written.means).argmin(dim=1)]
    # 256 numbers in 256 rows
    assert float((scene.features_rest - nearest.features_rest).abs().max()) < 0.01
    assert float(nearest.features_rest.abs().max()) > 0.05


@pytest.mark.parametrize("extra", [{}, {"palette_size": 2048, "coeffs": 8}])
def test_images_tell_the_size_of_a_palette_without_a_count(tmp_path, extra):
    data = encode_sog(cloud(3000, sh_degree=2))
    (tmp_path / "with.sog").write_bytes(data)
    (tmp_path / "without.sog").write_bytes(without_count(data, **extra))
    assert same_bits(ps.load(tmp_path / "with.sog"), ps.load(tmp_path / "without.sog"))


def test_a_palette_of_no_size_is_refused(tmp_path):
    (tmp_path / "a.sog").write_bytes(without_count(encode_sog(cloud(9)), palette_size="64"))
    assert "a palette of '64' entries" in fails(lambda: ps.load(tmp_path / "a.sog"))


def test_a_moving_scene_is_refused_by_the_name_of_its_trainer():
    said = fails(lambda: ps.load(CASES / "stg.ply"), "moving scene of SpacetimeGaussians")
    assert "'trbf_center'" in said and said.endswith(
        "export a PLY of one moment from the program that trained it"
    )


@pytest.mark.parametrize(
    ("names", "trainer"),
    [
        (["t", "scale_t_0", "rot_r_0"], "4D Gaussian Splatting"),
        (["t", "scaling_t"], "4D Gaussian Splatting"),
        (["xyz_disp_0", "xyz_disp_1"], "Ex4DGS"),
        (["velocity_0", "acceleration_0", "time", "duration"], "a 4D training"),
    ],
)
def test_properties_tell_moving_scenes(tmp_path, names, trainer):
    extra = {name: np.zeros(3, np.float32) for name in names}
    write_columns(tmp_path / "a.ply", {**columns_of(cloud(3)), **extra})
    fails(lambda: ps.load(tmp_path / "a.ply"), f"a moving scene of {trainer}")
    fails(lambda: PlyRows.open(tmp_path / "a.ply"), f"a moving scene of {trainer}")


@pytest.mark.parametrize(
    ("file", "trainer", "instead"),
    [
        ("deformation.pth", "4DGaussians", "export_perframe_3DGS.py"),
        ("dynamic_point_cloud.ply", "Ex4DGS", "one moment"),
        ("../../deform/iteration_7/deform.pth", "Deformable 3D Gaussians", "one moment"),
    ],
)
def test_files_beside_a_scene_tell_that_it_moves(tmp_path, file, trainer, instead):
    folder = tmp_path / "point_cloud" / "iteration_7"
    scene = cloud(3)
    for name in ("point_cloud.ply", "time_00001.ply"):
        ps.save(scene, folder / name)
    assert same_bits(ps.load(folder / "point_cloud.ply"), scene)
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    (folder / file).write_bytes(b"")
    fails(lambda: ps.load(folder / "point_cloud.ply"), f"moving scene of {trainer}", instead)
    assert same_bits(ps.load(folder / "time_00001.ply"), scene)


def activated(scene: ps.Gaussians, *names: str) -> dict[str, np.ndarray]:
    """The vertex properties of a scene with some parameters activated."""
    values = {"scales": scene.stds, "opacities": scene.alphas[:, None]}
    changed = scene.replace(**{name: values[name] for name in names})
    return columns_of(changed)


@pytest.mark.parametrize("names", [("scales", "opacities"), ("opacities",), ("scales",)])
@pytest.mark.parametrize("form", [{}, {"order": ">"}, {"text": True}])
def test_activated_parameters_are_told_by_their_values(tmp_path, names, form, caplog):
    """Scales alone are told by how dense they would make the scene, so that it has to be dense."""
    scene = ps.example_room()[:: 4 if names == ("scales",) else 30]
    write_columns(tmp_path / "a.ply", activated(scene, *names), **form)
    found = ps.load(tmp_path / "a.ply")
    assert f"its {' and '.join(names)} are stored activated" in caplog.text
    torch.testing.assert_close(found.stds, scene.stds, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.alphas, scene.alphas, rtol=1e-5, atol=1e-6)
    assert torch.equal(found.means, scene.means)


def test_activated_parameters_are_read_so_in_parts(tmp_path):
    scene = ps.example_room()[::30]
    path = tmp_path / "a.ply"
    write_columns(path, activated(scene, "scales", "opacities"))
    rows = pickle.loads(pickle.dumps(PlyRows.open(path).with_sh_degree(0)))
    assert torch.equal(rows.read(100, 200).scales, ps.load(path).scales[100:200])


def in_millimetres() -> ps.Gaussians:
    """A room whose log-scales are all above 0."""
    room = ps.place(ps.example_room(), scale=1e4)
    return room[(room.scales > 0).all(dim=1)]


ORDINARY = {
    "room": ps.example_room,
    "millimetres": in_millimetres,
    "of one opacity": lambda: in_millimetres().replace(
        opacities=torch.full((len(in_millimetres()), 1), 0.5)
    ),
    "opaque": lambda: ps.example_room()[ps.example_room().opacities[:, 0] > 0],
    "few": lambda: in_millimetres()[:20].replace(opacities=torch.linspace(0, 1, 20)[:, None]),
    "none": lambda: ps.example_room()[:0],
}
"""Scenes with some of what tells activated ones."""


@pytest.mark.parametrize("name", ORDINARY)
def test_ordinary_scenes_are_not_taken_for_activated_ones(name, tmp_path, caplog):
    scene = ORDINARY[name]()
    ps.save(scene, tmp_path / "a.ply")
    assert same_bits(ps.load(tmp_path / "a.ply"), scene) and "activated" not in caplog.text


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the files are not there")
@pytest.mark.parametrize(
    "name",
    [
        "splats/apt_bathroom/Toilet.compressed.ply",
        "splats/pc_statue_massa/massa.sog",
        "splats/kettle_pod/pod.spz",
        "splatfacto/fox/splatfacto/2026-11-26_gsplat",
    ],
)
def test_trained_scenes_are_not_taken_for_activated_ones(name):
    scene = ps.load(SHARED_DATA / name)
    columns = (scene.means, scene.scales, scene.opacities[:, 0])
    assert not any(activated_in(*(column.double().numpy() for column in columns), len(scene)))


@pytest.mark.parametrize(
    ("full", "kind"), [(255, np.uint8), (65_535, np.uint16), (1, np.float32), (255, np.float32)]
)
def test_colours_without_sh_are_converted(tmp_path, full, kind, caplog):
    scene = cloud(50, sh_degree=0)
    columns = {name: v for name, v in columns_of(scene).items() if not name.startswith("f_dc")}
    shares = np.random.default_rng(0).random((50, 3))
    shares[0] = (0, 0.5, 1)
    stored = (full * shares).round(0 if full > 1 else 7).astype(kind)
    columns |= dict(zip(("red", "green", "blue"), stored.T, strict=True))
    write_columns(tmp_path / "a.ply", columns)
    found = ps.load(tmp_path / "a.ply")
    torch.testing.assert_close(
        0.5 + SH_C0 * found.features_dc, torch.from_numpy(stored / full).float()
    )
    assert torch.equal(found.opacities, scene.opacities) and not caplog.messages
    rows = pickle.loads(pickle.dumps(PlyRows.open(tmp_path / "a.ply")))
    assert torch.equal(rows.read(7, 9).features_dc, found.features_dc[7:9])


def with_comments(path: Path, *comments: str) -> Path:
    """A scene whose file has these comments."""
    ps.save(cloud(3), path, overwrite=True)
    lines = "".join(f"comment {comment}\n" for comment in comments).encode()
    path.write_bytes(path.read_bytes().replace(b" 1.0\n", b" 1.0\n" + lines, 1))
    return path


def test_the_y_axis_that_brush_always_writes_points_down(tmp_path):
    scene = ps.load(CASES / "brush_vertical_axis_y.ply")
    assert scene.up == "-y"
    ps.save(scene, tmp_path / "a.ply")
    assert ps.load(tmp_path / "a.ply").up == "-y"


@pytest.mark.parametrize(
    ("comments", "up"),
    [
        (["Exported from Brush", "Vertical axis: y"], "-y"),
        (["Vertical axis: y", "Exported from Brush"], "-y"),
        (["Vertical axis: y"], "y"),
        (["Exported from Brush", "Vertical axis: 0.123 0.456 -0.789"], (0.123, 0.456, -0.789)),
        (["Exported from Brush", "Vertical axis: -0 -1 0"], "-y"),
        (["Vertical axis: [0.6, 0, 0.8]"], (0.6, 0.0, 0.8)),
        (["Vertical axis: 0 0 0"], None),
        (["Vertical axis: nan 1 0"], None),
        (["Vertical axis: 1e300 1 0"], None),
        (["Vertical axis: 1 0"], None),
    ],
)
def test_up_is_an_axis_or_three_numbers(comments, up, tmp_path):
    scene = ps.load(with_comments(tmp_path / "a.ply", *comments))
    assert scene.up == up
    ps.save(scene, tmp_path / "b.ply")
    assert ps.load(tmp_path / "b.ply").up == up


def test_a_direction_along_no_axis_is_used_and_turns_with_the_scene(tmp_path):
    scene = ps.example_room()[::100].replace(up=(0.6, 0.0, 0.8))
    upward = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    torch.testing.assert_close(Sampler(scene).up.direction, upward)
    placed = ps.place(scene, up="y")
    assert placed.up == "y"
    torch.testing.assert_close(
        placed.means[:, 1].double(), scene.means.double() @ upward, rtol=0, atol=1e-5
    )
    turned = ps.place(scene, up="z:-y")
    assert turned.up == "-y", "what is said to be up by name is so"
    with pytest.raises(ps.SceneError, match="or three numbers"):
        scene.replace(up=(0.0, 0.0, 0.0))


def blender(folder: Path, sizes: dict[str, tuple[int, int]], **extra: object) -> Path:
    """A scene of Blender for NeRF: photos without suffix in the file, and no size of them."""
    for name, size in sizes.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGBA", size).save(folder / f"{name}.png")
    frames = [
        {"file_path": f"./{name}", "rotation": 0.01, "transform_matrix": torch.eye(4).tolist()}
        for name in sizes
    ]
    path = folder / "transforms_train.json"
    path.write_text(json.dumps({"camera_angle_x": 0.69, "frames": frames, **extra}))
    return path


def test_sizes_that_a_camera_file_lacks_are_those_of_the_photos(tmp_path):
    path = blender(tmp_path, {"train/r_0": (80, 60), "train/r_1": (80, 60), "train/r_2": (40, 60)})
    found = read_named_views(path)
    assert [camera.size for camera in found.cameras] == [(80, 60), (80, 60), (40, 60)]
    focals = [camera.focal[0] for camera in found.cameras]
    assert focals == pytest.approx([0.5 * side / math.tan(0.345) for side in (80, 80, 40)])
    assert found.photo(2) == tmp_path / "train/r_2.png"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda folder: (folder / "train/r_0.png").unlink(), "is not beside the file"),
        (lambda folder: (folder / "train/r_0.png").write_bytes(b"%!PS"), "cannot be read (not one"),
    ],
)
def test_a_camera_without_a_size_and_a_photo_is_refused(tmp_path, make, said):
    path = blender(tmp_path, {"train/r_0": (8, 6)})
    make(tmp_path)
    fails(
        lambda: read_named_views(path),
        f"{path}: camera 0 has no size, and its photo './train/r_0' {said}",
    )


def test_photos_outside_of_the_folder_are_not_opened_for_their_size(tmp_path):
    path = blender(tmp_path / "data", {"r_0": (8, 6)})
    Image.new("RGB", (8, 6)).save(tmp_path / "other.png")
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = "../other.png"
    path.write_text(json.dumps(content))
    fails(lambda: read_named_views(path), "'../other.png' is not beside the file")


def test_poses_that_ns_export_writes_are_refused_with_what_to_name_instead(tmp_path):
    """They have no focal lengths."""
    path = tmp_path / "transforms_train.json"
    frames = [{"file_path": "images/0.png", "transform": torch.eye(4)[:3].tolist()}]
    path.write_text(json.dumps(frames))
    fails(
        lambda: read_named_views(path),
        f"{path}: poses of `ns-export cameras`",
        "the run itself",
        "dataparser_transforms.json",
    )
