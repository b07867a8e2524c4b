"""The Replica layout on disk: what is read, and what each fault says."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import fuse_depth, voxel_thin
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth, read_photo
from replica_scenes import CAMERA, line_of, write_scene


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


def one_deeper(scene: Path) -> None:
    moved = scene.rename(scene.with_name("moved"))
    scene.mkdir()
    moved.rename(scene / "t")


def removed(name: str):
    return lambda scene: (scene / name).unlink()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda scene: scene.rename(scene.with_name("none")), ["no such folder"]),
        (one_deeper, ["contains the scenes t: name one"]),
        (removed("traj.txt"), ["traj.txt: not found"]),
        (removed("cam_params.json"), ["s/cam_params.json", "rooms/cam_params.json"]),
        (removed("results/frame000002.png"), ["4 poses for 3 photos", "missing: frame000002"]),
        (removed("results/depth000001.png"), ["1 of 4 photos have no depth image (depth000001.png)"]),
        (lambda scene: Image.new("RGB", (8, 6)).save(scene / "results/frame000001.jpg"),
         ["frame000001.jpg and frame000001.png have the same number"]),
        (lambda scene: Image.new("RGB", (9, 6)).save(scene / "results/frame000001.png"),
         ["frame000001.png: 9 x 6 pixels; expected 8 x 6"]),
        (lambda scene: (scene / "results/frame000001.png").write_bytes(b""),
         ["frame000001.png: not a readable picture"]),
    ],
)  # fmt: skip
def test_files_that_are_missing_or_cannot_be_used_are_named(tmp_path, spoil, words):
    scene = write_scene(tmp_path / "rooms" / "s")
    spoil(scene)
    text = fault(scene)
    assert all(some in text for some in words), text


COLUMN_BY_COLUMN = np.eye(4)
COLUMN_BY_COLUMN[3, :3] = 1, 2, 3


@pytest.mark.parametrize(
    ("line", "text", "words"),
    [
        (3, " ".join(["0"] * 15), "line 3 has 15 values"),
        (3, " ".join(["x"] * 16), "line 3: could not convert"),
        (2, line_of(np.diag([1.1, 1.1, 1.1, 1])), "line 2 is not a rigid pose"),
        (2, line_of(np.diag([1, 1, -1, 1])), "line 2 mirrors the axes"),
        (1, line_of(COLUMN_BY_COLUMN), "line 1 ends in 1 2 3 1; expected 0 0 0 1"),
    ],
)
def test_a_line_that_is_no_pose_is_named(tmp_path, line, text, words):
    scene = write_scene(tmp_path / "s")
    edit_line(scene, line, text)
    assert words in fault(scene)


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


def test_small_drift_is_removed(tmp_path):
    scene = write_scene(tmp_path / "s")
    pose = np.eye(4)
    pose[:3, :3] += 1e-3
    edit_line(scene, 2, line_of(pose))
    rotation = load_replica(scene).poses[1, :3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)  # float64 SVD


def test_depth_images_of_another_kind_and_broken_ones_are_refused(tmp_path):
    loaded = load_replica(write_scene(tmp_path / "s"))
    depth = loaded.depths[1]
    Image.new("L", (8, 6)).save(depth)
    with pytest.raises(DataError, match="expected a 16-bit grey"):
        read_depth(depth, loaded.params)
    noise = np.random.default_rng(0).integers(0, 65535, (6, 8)).astype(np.uint16)
    Image.fromarray(noise).save(depth)
    depth.write_bytes(depth.read_bytes()[:-40])
    with pytest.raises(DataError, match="broken picture"):
        read_depth(depth, loaded.params)


def test_a_scene_without_depth_is_read_and_has_no_seed_points(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s", depth=False))
    assert scene.depths is None
    with pytest.raises(DataError, match="no depth images"):
        fuse_depth(scene, 1000, scene.params.principal_point())


def test_seed_points_avoid_outlines_and_unknown_pixels(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s", frames=1))
    raw = np.full((6, 8), 1000, np.uint16)
    raw[:, 4:], raw[0, 0] = 3000, 0
    Image.fromarray(raw).save(scene.depths[0])
    xyz, _ = fuse_depth(scene, 1000, scene.params.principal_point())
    # Lost: the columns on both sides of the step, the unknown pixel and its two other neighbours.
    assert len(xyz) == 6 * 6 - 3 and set(np.unique(xyz[:, 2])) == {1.0, 3.0}


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
