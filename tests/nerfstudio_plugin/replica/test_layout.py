"""The Replica layout on disk: what is read, and what each fault says."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth, read_photo
from pointsplat_ns.nerfstudio_plugin.replica.seed_points import fuse_depth, voxel_thin

CAMERA = {"w": 8, "h": 6, "fx": 5.0, "fy": 5.0, "cx": 3.5, "cy": 2.5, "scale": 1000.0}


def write_scene(folder: Path, frames: int = 4, depth: bool = True, camera: dict | None = None) -> Path:
    (folder / "results").mkdir(parents=True)
    lines = []
    for n in range(frames):
        Image.new("RGB", (8, 6), (10 * n, 50, 200)).save(folder / "results" / f"frame{n:06d}.png")
        if depth:
            Image.fromarray(np.full((6, 8), 2000, np.uint16)).save(folder / "results" / f"depth{n:06d}.png")
        pose = np.eye(4)
        pose[0, 3] = 0.1 * n
        lines.append(" ".join(str(v) for v in pose.reshape(-1)))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera or CAMERA}))
    return folder


def edit_line(scene: Path, line: int, text: str) -> None:
    lines = (scene / "traj.txt").read_text().splitlines()
    lines[line - 1] = text
    (scene / "traj.txt").write_text("\n".join(lines) + "\n")


def fault(scene: Path) -> str:
    with pytest.raises(DataError) as caught:
        load_replica(scene)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_whole_scene_is_read_as_written(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s"))
    assert scene.numbers == (0, 1, 2, 3)
    assert scene.depths is not None and scene.depths[2].name == "depth000002.png"
    assert np.allclose(scene.poses[3, :3, 3], [0.3, 0, 0])
    assert np.all(read_depth(scene.depths[0], scene.params) == 2.0)
    assert read_photo(scene.photos[2], scene.params)[0, 0].tolist() == [20, 50, 200]


def test_intrinsics_beside_the_scene_are_found(tmp_path):
    scene = write_scene(tmp_path / "s")
    (scene / "cam_params.json").rename(tmp_path / "cam_params.json")
    assert load_replica(scene).params.fx == 5.0


def test_unknown_and_saturated_depths_become_zero(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s"))
    raw = np.full((6, 8), 1500, np.uint16)
    raw[0, 0], raw[1, 1] = 0, 65535
    Image.fromarray(raw).save(scene.depths[0])
    depth = read_depth(scene.depths[0], scene.params)
    assert depth[0, 0] == 0 and depth[1, 1] == 0 and depth[2, 2] == 1.5


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ({}, (4.0, 3.0)),  # 3.5 of 8: Replica's own way, counted from the first pixel's centre
        ({"cx": 4.0, "cy": 3.0}, (4.0, 3.0)),  # exactly half: counted from the corner
        ({"cx": 3.9, "cy": 3.0}, (4.4, 3.5)),  # a calibration: OpenCV's integer centres
    ],
)
def test_the_convention_of_pixel_centres_is_told_by_the_principal_point(tmp_path, camera, expected):
    params = load_replica(write_scene(tmp_path / "s", camera={**CAMERA, **camera})).params
    assert params.principal_point("auto") == pytest.approx(expected)
    assert params.principal_point("half") == (params.cx, params.cy)


def test_missing_folder_and_files_are_named(tmp_path):
    assert "no such folder" in fault(tmp_path / "none")
    scene = write_scene(tmp_path / "s")
    assert "contains the scenes s: name one" in fault(tmp_path)
    (scene / "traj.txt").rename(scene / "other.txt")
    assert "traj.txt: not found" in fault(scene)
    (scene / "other.txt").rename(scene / "traj.txt")
    (scene / "cam_params.json").unlink()
    text = fault(scene)
    assert str(scene / "cam_params.json") in text and str(tmp_path / "cam_params.json") in text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not valid JSON"),
        ("{}", 'no "camera" entry'),
        (json.dumps({"camera": {k: v for k, v in CAMERA.items() if k != "fy"}}), '"fy" is None'),
        (json.dumps({"camera": {**CAMERA, "fx": -1.0}}), '"fx" is -1.0; expected a positive number'),
        (json.dumps({"camera": {**CAMERA, "scale": float("nan")}}), '"scale" is nan'),
        (json.dumps({"camera": {**CAMERA, "w": "8"}}), "\"w\" is '8'; expected a number"),
        (json.dumps({"camera": {**CAMERA, "h": 6.5}}), "whole number of pixels"),
    ],
)
def test_bad_intrinsics_are_said(tmp_path, content, words):
    scene = write_scene(tmp_path / "s")
    (scene / "cam_params.json").write_text(content)
    text = fault(scene)
    assert words in text and "cam_params.json" in text


def test_a_line_of_15_numbers_and_one_of_words_are_named(tmp_path):
    scene = write_scene(tmp_path / "s")
    edit_line(scene, 3, " ".join(["0"] * 15))
    assert "line 3 has 15 values" in fault(scene)
    edit_line(scene, 3, " ".join(["x"] * 16))
    assert "line 3: could not convert" in fault(scene)


def test_counts_that_differ_name_the_missing_photo(tmp_path):
    scene = write_scene(tmp_path / "s")
    (scene / "results" / "frame000002.png").unlink()
    text = fault(scene)
    assert "4 poses for 3 photos" in text and "missing: frame000002" in text


def test_a_missing_depth_image_is_named_but_none_at_all_is_fine(tmp_path):
    scene = write_scene(tmp_path / "s")
    (scene / "results" / "depth000001.png").unlink()
    assert "1 of 4 photos have no depth image (depth000001.png)" in fault(scene)
    assert load_replica(write_scene(tmp_path / "t", depth=False)).depths is None


def test_lost_poses_are_dropped_and_their_lines_said(tmp_path, caplog):
    scene = write_scene(tmp_path / "s")
    edit_line(scene, 2, " ".join(["-inf"] * 16))
    edit_line(scene, 4, " ".join(["nan"] * 12 + ["0", "0", "0", "1"]))
    with caplog.at_level(logging.WARNING):
        loaded = load_replica(scene)
    assert loaded.numbers == (0, 2)
    assert "2 of 4 poses" in caplog.text and "line 2, 4" in caplog.text
    for line in (1, 3):
        edit_line(scene, line, " ".join(["nan"] * 16))
    assert "none of the 4 poses is finite" in fault(scene)


@pytest.mark.parametrize("number", ["1e300", "-1e300", "1e39", "1e999", "1e19"])
def test_a_pose_beyond_float32_is_dropped_as_a_lost_one(tmp_path, caplog, number):
    scene = write_scene(tmp_path / "s")
    edit_line(scene, 2, f"1 0 0 {number} 0 1 0 0 0 0 1 0 0 0 0 1")
    with caplog.at_level(logging.WARNING):
        loaded = load_replica(scene)
    assert loaded.numbers == (0, 2, 3) and np.isfinite(loaded.poses.astype(np.float32)).all()
    assert "1 of 4 poses" in caplog.text and "line 2" in caplog.text


def test_a_16_bit_grey_photo_is_refused_and_not_read_modulo_256(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s"))
    Image.fromarray(np.full((6, 8), 300, np.uint16)).save(scene.photos[1])
    with pytest.raises(DataError, match="frame000001.png: pixels of mode I.*expected 8 bits a channel"):
        read_photo(scene.photos[1], scene.params)


def test_gaps_in_the_numbering_are_fine_where_counts_agree(tmp_path):
    scene = write_scene(tmp_path / "s")
    for kind in ("frame", "depth"):
        (scene / "results" / f"{kind}000003.png").rename(scene / "results" / f"{kind}000030.png")
    assert load_replica(scene).numbers == (0, 1, 2, 30)


def test_small_drift_is_removed_and_a_scaled_or_mirrored_matrix_refused(tmp_path):
    scene = write_scene(tmp_path / "s")
    pose = np.eye(4)
    pose[:3, :3] += 1e-3
    edit_line(scene, 2, " ".join(map(str, pose.reshape(-1))))
    rotation = load_replica(scene).poses[1, :3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)  # float64 SVD
    edit_line(scene, 2, " ".join(map(str, np.diag([1.1, 1.1, 1.1, 1]).reshape(-1))))
    assert "line 2 is not a rigid pose" in fault(scene)
    edit_line(scene, 2, " ".join(map(str, np.diag([1, 1, -1, 1]).reshape(-1))))
    assert "line 2 mirrors the axes" in fault(scene)


def test_a_matrix_written_column_by_column_is_refused(tmp_path):
    scene = write_scene(tmp_path / "s")
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    edit_line(scene, 1, " ".join(map(str, pose.T.reshape(-1))))
    assert "line 1 ends in 1 2 3 1; expected 0 0 0 1" in fault(scene)


def test_wrong_sizes_and_broken_pictures_are_named(tmp_path):
    scene = write_scene(tmp_path / "s")
    loaded = load_replica(scene)
    photo, depth = loaded.photos[1], loaded.depths[1]
    Image.new("RGB", (9, 6)).save(photo)
    assert "frame000001.png: 9 x 6 pixels; expected 8 x 6" in fault(scene)
    photo.write_bytes(b"")
    assert "frame000001.png: not a readable picture" in fault(scene)
    Image.new("L", (8, 6)).save(depth)
    with pytest.raises(DataError, match="expected a 16-bit grey"):
        read_depth(depth, loaded.params)
    noise = np.random.default_rng(0).integers(0, 65535, (6, 8)).astype(np.uint16)
    Image.fromarray(noise).save(depth)
    depth.write_bytes(depth.read_bytes()[:-40])
    with pytest.raises(DataError, match="broken picture"):
        read_depth(depth, loaded.params)


def test_two_photos_of_one_number_are_refused(tmp_path):
    scene = write_scene(tmp_path / "s")
    Image.new("RGB", (8, 6)).save(scene / "results" / "frame000001.jpg")
    assert "frame000001.jpg and frame000001.png have the same number" in fault(scene)


def test_seed_points_lie_on_the_plane_that_the_depth_shows(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s"))
    xyz, rgb = fuse_depth(scene, 1000, scene.params.principal_point())
    assert len(xyz) == 4 * 6 * 8 and rgb.dtype == np.uint8
    assert np.all(xyz[:, 2] == 2.0)
    # The first pixel of frame 0: (0 - 3.5) / 5 * 2.
    assert xyz[:, 0].min() == pytest.approx(-1.4) and xyz[:, 1].max() == pytest.approx(1.0)


def test_seed_points_avoid_outlines_and_unknown_pixels(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s", frames=1))
    raw = np.full((6, 8), 1000, np.uint16)
    raw[:, 4:], raw[0, 0] = 3000, 0
    Image.fromarray(raw).save(scene.depths[0])
    xyz, _ = fuse_depth(scene, 1000, scene.params.principal_point())
    # Lost: the columns on both sides of the step, the unknown pixel and its two other neighbours.
    assert len(xyz) == 6 * 6 - 3 and set(np.unique(xyz[:, 2])) == {1.0, 3.0}


def test_seed_points_of_a_scene_without_depth_are_refused(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s"))
    with pytest.raises(DataError, match="no depth images"):
        fuse_depth(replace(scene, depths=None), 1000, scene.params.principal_point())


def test_thinning_is_even_bounded_and_keeps_means():
    rng = np.random.default_rng(3)
    # A plane whose left half was seen 20 times as often as its right half.
    dense, sparse = rng.uniform((-1, -1), (0, 1), (40_000, 2)), rng.uniform((0, -1), (1, 1), (2_000, 2))
    xyz = np.concatenate([dense, sparse])
    xyz = np.concatenate([xyz, np.zeros((len(xyz), 1))], axis=1).astype(np.float32)
    rgb = np.full((len(xyz), 3), 77, np.uint8)
    points, colors = voxel_thin(xyz, rgb, 400)
    assert 350 < len(points) <= 400  # the voxel size is bisected to 1 %, one step of whole columns is 5 %
    left = int((points[:, 0] < 0).sum())
    assert abs(left - len(points) / 2) < 0.1 * len(points)
    assert np.all(colors == 77) and np.all(points[:, 2] == 0)


def test_thinning_holds_far_from_the_origin_and_for_coincident_points():
    cloud = np.random.default_rng(0).normal(size=(500, 3))
    far, _ = voxel_thin((cloud + 1e4).astype(np.float32), np.zeros((500, 3), np.uint8), 100)
    assert np.isfinite(far).all() and 50 < len(far) <= 100
    assert np.all(np.abs(far - 1e4) < 5)  # the cloud's own extent, 3 to 4 sigma
    same, _ = voxel_thin(np.full((500, 3), 7.5, np.float32), np.zeros((500, 3), np.uint8), 100)
    assert same.tolist() == [[7.5, 7.5, 7.5]]
