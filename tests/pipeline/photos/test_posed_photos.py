"""Photos in a folder with the poses of a file of cameras: found, brought into the scene's frame,
split and checked."""

import json
import re
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch

import pointsplat_ns as ps
from making import ball, views_from_within
from pointsplat_ns.cli import main
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.geometry.transforms import flip_camera_axes, invert_rigid
from pointsplat_ns.pipeline.photos import frame as module
from pointsplat_ns.pipeline.photos.posed_photos import PosedPhotos, read_with_photos
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS
from pointsplat_ns.scene.image_files import write_picture
from pointsplat_ns.scene.rotation import Similarity
from pointsplat_ns.view_sampling.poses import look_at, views_of
from posing import inria, name_of, nerfstudio, write_photos, write_sparse

pytestmark = pytest.mark.usefixtures("quick")

COUNT = 18


@pytest.fixture(scope="module")
def views() -> ps.Views:
    """Cameras in order of their names; the first photos are named first."""
    return views_from_within((0.2, 0.1, 0.0), COUNT, 64, 48)


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setitem(PHOTO_STEPS, "quick", 40)


def read(scene: ps.Gaussians, folder: Path, poses: Path | None = None, **options) -> PosedPhotos:
    return read_with_photos(scene, folder, poses, **options)[1]


def same_poses(found: ps.Views, views: ps.Views, within: float = 1e-5) -> bool:
    return float((found.viewmats - views.viewmats).abs().max()) < within


def between(poses: torch.Tensor, others: torch.Tensor) -> Similarity:
    """What moves poses (C, 4, 4) to others."""
    matrix = others[0, :3, :3] @ poses[0, :3, :3].T
    scale = float(
        (others[0, :3, 3] - others[1, :3, 3]).norm() / (poses[0, :3, 3] - poses[1, :3, 3]).norm()
    )
    return Similarity(matrix, scale, others[0, :3, 3] - scale * matrix @ poses[0, :3, 3])


@pytest.mark.parametrize(
    "kind", ["text", "binary", "root", "transforms.json", "cameras.json", "named"]
)
def test_poses_are_found_where_projects_have_them(kind, scene, views, tmp_path, said):
    folder = write_photos(scene, views, tmp_path / "images")
    poses = None
    if kind in ("text", "named"):
        poses = write_sparse(views, tmp_path / ("sparse/0" if kind == "text" else "elsewhere"))
    elif kind in ("binary", "root"):
        write_sparse(views, tmp_path / "sparse/0" if kind == "binary" else tmp_path, ".bin")
    else:
        content = nerfstudio(views) if kind == "transforms.json" else inria(views)
        (tmp_path / kind).write_text(json.dumps(content))
    found = read(scene, folder, poses if kind == "named" else None)
    assert same_poses(found.views, views) and "moved into" not in said.text
    assert (len(found.training), len(found.held_out)) == (15, 3)
    # In the order of names as text: frame_0, frame_1, frame_10, ..., of which 0, 16 and 7 come
    # first, ninth and last.
    for example, index in zip(found.held_out, (0, 16, 8), strict=True):
        assert torch.equal(example.view.viewmat, found.views.viewmats[index])
        assert (
            float((example.target.float() / 255 - ps.render(scene, views[index])).abs().max())
            < 0.01
        )
        assert torch.allclose(example.view.K, views.Ks[index].double()) and example.mask is None
    assert "photos: 18 of " in said.text and "3 are held out; 166 kB in memory" in said.text


@pytest.mark.parametrize("axes", [True, False])
def test_turned_axes_and_other_scales_of_poses_are_found_and_named(
    axes, scene, views, tmp_path, said
):
    folder = write_photos(scene, views, tmp_path / "images")
    poses = invert_rigid(views.viewmats.double())
    up = torch.tensor(
        [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
    ).double()  # as nerfstudio's processing turns COLMAP's world
    poses[:, :3] = (
        up @ poses[:, :3] if axes else poses[:, :3] * poses.new_tensor([1.0, 1.0, 1.0, 0.4])
    )
    others = invert_rigid(flip_camera_axes(poses) if axes else poses)
    write_sparse(replace(views, viewmats=others), tmp_path / "sparse/0")
    assert same_poses(read(scene, folder).views, views, 1e-5 if axes else 2e-3)
    change = "axes x, y, z of the scene are x, z, -y of the poses, camera axes y and z flipped"
    assert (
        f"poses are moved into the frame of the scene: {change if axes else 'positions times 2.5'}"
        in said.text
    )


def test_a_scene_in_the_frame_of_nerfstudio_needs_no_file_that_says_so(
    scene, views, tmp_path, said
):
    """The scene is turned, moved and scaled as nerfstudio does; the file of its dataset is not at
    hand."""
    poses = invert_rigid(views.viewmats.double())
    oriented = module._as_nerfstudio(poses)
    there = between(poses, oriented).apply(scene)
    assert float(oriented[:, :3, 3].abs().max()) == pytest.approx(1)
    assert oriented[:, :3, 3].mean(0).abs().max() < 1e-9
    folder = write_photos(scene, views, tmp_path / "images")
    (tmp_path / "transforms.json").write_text(json.dumps(nerfstudio(views)))
    found = read(there, folder)
    assert same_poses(found.views, replace(views, viewmats=invert_rigid(oriented)), 1e-4)
    assert "oriented, centred and scaled as nerfstudio does" in said.text


def test_applied_and_dataparser_transforms_that_a_scene_lacks_are_undone(
    scene, views, tmp_path, said
):
    folder = write_photos(scene, views, tmp_path / "images")
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    rows = torch.cat([turn, torch.tensor([[0.3], [-0.2], [0.1]])], dim=1).tolist()
    shifted = module.Motion(torch.tensor(rows, dtype=torch.float64))
    saved = replace(views, viewmats=invert_rigid(shifted.of(invert_rigid(views.viewmats.double()))))
    (tmp_path / "transforms.json").write_text(
        json.dumps({**nerfstudio(saved), "applied_transform": rows})
    )
    assert same_poses(read(scene, folder).views, views)
    assert "applied_transform undone" in said.text
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps({"transform": rows, "scale": 0.5})
    )
    (tmp_path / "transforms.json").write_text(json.dumps(nerfstudio(views)))
    assert same_poses(read(scene, folder).views, views)
    assert "without dataparser_transforms.json" in said.text


def test_photos_of_another_scene_are_refused_with_their_psnr(scene, views, tmp_path):
    other = ball(500, seed=9)
    colors = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    folder = write_photos(other.replace(features_dc=colors), views, tmp_path / "images")
    write_sparse(views, tmp_path / "sparse/0")
    with pytest.raises(
        DataError, match=r"do not match the photos in the frame .* dB PSNR in 8 photos.*--poses"
    ):
        read(scene, folder)


def test_photos_that_fit_worst_are_named_and_left_out(scene, views, tmp_path, said):
    folder = write_photos(scene, views, tmp_path / "images")
    for index in (3, 16):
        write_picture(1 - ps.render(scene, views[index]), folder / name_of(index))
    write_sparse(views, tmp_path / "sparse/0")
    found = read(scene, folder)
    assert (len(found.training), len(found.held_out)) == (
        14,
        2,
    )  # no other photo is held out in its place
    [line] = [line for line in said.messages if "match the scene worst are left out" in line]
    assert "frame_3.png (" in line and "frame_16.png (" in line and line.count("dB") == 2


def test_photos_that_cannot_be_read_are_named_and_left_out(scene, views, tmp_path, said):
    """Of the first, which is held out, the end is missing; the other is no photo."""
    folder = write_photos(scene, views, tmp_path / "images")
    write_sparse(views, tmp_path / "sparse/0")
    first = folder / name_of(0)
    other = folder / name_of(5)
    first.write_bytes(first.read_bytes()[:-2000])
    other.write_bytes(b"no photo")
    found = read(scene, folder)
    assert (len(found.training), len(found.held_out)) == (14, 2)
    [line] = [
        line for line in said.messages if line.startswith("photos that are unusable are left out: ")
    ]
    assert (
        f"{first}: cannot be read as a photo" in line
        and f"{other}: cannot be read as a photo" in line
    )
    assert len(read(scene, folder, training=False).held_out) == 2
    for path in folder.iterdir():
        path.write_bytes(b"no photo")
    with pytest.raises(DataError, match="cannot be read as a photo"):
        read(scene, folder)


def test_names_that_do_not_match_are_told_with_examples_of_both(scene, views, tmp_path):
    folder = write_photos(scene, views, tmp_path / "images")
    for index, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"IMG_{index}.png")
    write_sparse(views, tmp_path / "sparse/0")
    with pytest.raises(
        DataError,
        match=r"0 of its 18 cameras .*'frame_0.png', 'frame_1.png'; of photos: 'IMG_0.png'",
    ):
        read(scene, folder)


def test_too_few_photos_no_poses_and_no_room_are_said(scene, views, tmp_path, monkeypatch):
    folder = write_photos(scene, views[:7], tmp_path / "images")
    with pytest.raises(DataError, match="no poses there, above it or beside the scene"):
        read(scene, folder)
    write_sparse(views, tmp_path / "sparse/0")
    with pytest.raises(
        DataError, match="7 of its 18 cameras have a photo in .*; expected at least 8"
    ):
        read(scene, folder)
    with pytest.raises(SceneError, match="no such file"):
        read(scene, folder, tmp_path / "none.json")
    write_photos(scene, views, folder)
    free = psutil.virtual_memory()._replace(available=100_000)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    with pytest.raises(DataError, match="lower --resolution"):
        read(scene, folder)
    small = read(scene, folder, resolution=(32, 24))
    assert small.training[0].target.shape == (24, 32, 3) and (
        small.views.width,
        small.views.height,
    ) == (32, 24)


def test_a_scene_that_gsplat_normalised_is_found_by_the_models_points(scene, views, tmp_path, said):
    """Axes of the points of any signs: turns of axes find the rest."""
    folder = write_photos(scene, views, tmp_path / "images")
    model = write_sparse(views, tmp_path / "sparse/0")
    points = (scene.means.double() * torch.tensor([1.0, 0.7, 0.4])) @ torch.linalg.qr(
        torch.randn(3, 3).double()
    ).Q
    rows = [
        f"{number} {x} {y} {z} 0 0 0 0.5 1 0" for number, (x, y, z) in enumerate(points.tolist())
    ]
    (model / "points3D.txt").write_text("# 3D point list\n" + "\n".join(rows) + "\n")
    poses = invert_rigid(views.viewmats.double())
    turned = module._turned(
        module._as_gsplat(poses, points), torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    )
    found = read(between(poses, turned).apply(scene), folder)
    assert same_poses(found.views, replace(views, viewmats=invert_rigid(turned)), 1e-4)
    assert (
        "normalised as gsplat does, axes x, y, z of the scene are -x, -y, z of the poses"
        in said.text
    )


def test_a_white_background_is_found(tmp_path, said):
    """Of an object: black is behind it in renders, unless they are told."""
    thing = ball(400)
    thing = thing.replace(means=0.3 * thing.means, scales=thing.scales - 1)
    turns = 6.28 * torch.arange(COUNT) / COUNT
    eyes = 2 * torch.stack([turns.cos(), turns.sin(), 0.3 * torch.ones(COUNT)], dim=1).double()
    around = views_of(look_at(eyes, torch.zeros_like(eyes)), 64, 48, 5.0)
    white = replace(around, background=torch.ones(3))
    folder = write_photos(thing, white, tmp_path / "images")
    write_sparse(around, tmp_path / "sparse/0")
    found = read(thing, folder)
    assert (
        found.views.background.tolist() == found.training[0].view.background.tolist() == [1.0] * 3
    )
    assert "white background" in said.text


def test_any_scene_is_compacted_with_its_photos(scene, views, tmp_path, capsys):
    """What only photos know: other colours than those of the scene."""
    folder = write_photos(
        scene.replace(features_dc=scene.features_dc + 0.3), views, tmp_path / "my photos"
    )
    model = write_sparse(views, tmp_path / "model", ".bin")
    ps.save(scene, tmp_path / "room.ply")
    words = ["--photos", str(folder), "--poses", str(model), "--keep", "50%"]
    main(["compact", str(tmp_path / "room.ply"), *words, "-o", str(tmp_path / "small.ply")])
    out = capsys.readouterr().out
    before, after, dense = map(float, re.search(TEXT, out).groups())
    assert after > before + 1 and after > dense + 1 and " dB in 12 training photos; " in out
    assert len(ps.load(tmp_path / "small.ply")) == 250


@pytest.mark.parametrize("how", ["prune", "tradeoff"])
def test_held_out_photos_judge_what_is_not_trained(how, scene, views, tmp_path, capsys):
    shown = scene.replace(features_dc=scene.features_dc + 0.3) if how == "tradeoff" else scene
    folder = write_photos(shown, views, tmp_path / "images")
    model = write_sparse(views, tmp_path / "model", ".bin")
    path = tmp_path / "room.ply"
    ps.save(scene, path)
    words = ["--photos", str(folder), "--poses", str(model), "--keep", "50%"]
    if how == "tradeoff":
        main(
            [
                "tradeoff",
                str(path),
                *words,
                "--repairs",
                "none",
                "photos",
                "-o",
                str(tmp_path / "trade"),
            ]
        )
        sweep = json.loads((tmp_path / "trade" / "tradeoff.json").read_text())
        _, merged, trained = (point["against_photos"]["psnr"] for point in sweep["points"])
        assert trained > merged + 1 and f"held-out photos of {folder}" in capsys.readouterr().out
        command = sweep["points"][2]["command"]
        assert f"--photos {folder}" in command and f"--poses {model}" in command
        return
    main(["prune", str(path), *words, "-o", str(tmp_path / "small.ply")])
    pruned, dense = map(
        float, re.search(TEXT.replace(r"([\d.]+) -> ", ""), capsys.readouterr().out).groups()
    )
    assert dense > pruned + 1


TEXT = r"held-out photos: ([\d.]+) -> ([\d.]+) dB PSNR in 3 photos, the dense scene ([\d.]+) dB"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"views": "none"}, "photos need a camera file with their poses"),
        ({"data": "data"}, "data of a run, but photos are read from"),
        ({"views": "run.json"}, "no such file"),
    ],
)
def test_options_that_do_not_go_with_a_folder_of_photos_are_refused(
    options, text, scene, views, tmp_path
):
    folder = write_photos(scene, views[:1], tmp_path)
    with pytest.raises(PointSplatError, match=text):
        ps.compact(scene, "50%", photos=folder, **options)
