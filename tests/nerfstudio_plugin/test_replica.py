"""The ``replica-data`` dataparser and the Replica layout on disk: what is read, and what each fault
says."""

import json
import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from refusing import fails

from making import SHARED_DATA
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig, fuse_depth
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth, read_photo
from replica_scenes import CAMERA, line_of, write_scene

ROOM0 = SHARED_DATA / "replica_room0" / "room0"


@pytest.fixture()
def row(tmp_path):
    return write_scene(tmp_path / "room", frames=12, step=1.0)


def parse(folder, split="train", **options):
    return ReplicaDataParserConfig(data=folder, **options).setup().get_dataparser_outputs(split)


def test_frames_are_held_out_by_step(row):
    def numbers(split, **options):
        return [int(path.stem[5:]) for path in parse(row, split, **options).image_filenames]

    assert numbers("val") == numbers("test") == [0, 10]
    assert numbers("train") == [1, 2, 3, 4, 5, 6, 7, 8, 9, 11]
    assert numbers("val", frame_stride=2, eval_every=3) == [0, 6]
    assert numbers("train", frame_stride=2, eval_every=3) == [2, 4, 8, 10]
    for options, words in (
        ({"eval_every": 1}, "--eval-every 1"),
        ({"frame_stride": 0}, "--frame-stride 0"),
        ({"frame_stride": 12}, "leave 0 for training"),
    ):
        with pytest.raises(DataError, match=words):
            parse(row, **options)


def test_cameras_follow_nerfstudio_axes_and_pixel_centres(row):
    cameras = parse(row, "val").cameras
    # Facing +z with y down (OpenCV) is facing -(-z) with y up: the y and z columns are negated.
    expected = torch.tensor([[1.0, 0, 0, 10.0], [0, -1, 0, 0], [0, 0, -1, 0]])
    assert torch.equal(cameras.camera_to_worlds[1], expected)
    # nerfstudio's own ray through the middle of the picture goes along the optical axis, +z here.
    ray = cameras.generate_rays(camera_indices=0, coords=torch.tensor([[3.0, 4.0]]))
    assert torch.allclose(ray.directions[0], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)


def test_seed_points_come_from_training_frames_alone_always_the_same(row):
    outputs = parse(row)
    xyz = outputs.metadata["points3D_xyz"]
    rgb = outputs.metadata["points3D_rgb"]
    assert xyz.dtype == torch.float32 and rgb.dtype == torch.uint8
    assert torch.all(xyz[:, 2] == 2.0)
    assert float(xyz[:, 0].min()) == pytest.approx(1 - 1.4)  # frame 1, not frame 0, starts the row
    assert (rgb[:, 0] > 0).all()  # frame 0 alone has no red
    assert "points3D_xyz" not in parse(row, "val").metadata
    assert "points3D_xyz" not in parse(row, load_seed_points=False).metadata
    first, again = (parse(row, num_seed_points=50).metadata for _ in range(2))
    assert len(first["points3D_xyz"]) <= 50
    assert all(torch.equal(first[name], again[name]) for name in ("points3D_xyz", "points3D_rgb"))


@pytest.fixture()
def scene(tmp_path):
    return write_scene(tmp_path / "rooms" / "s")


def edit_line(scene: Path, line: int, text: str) -> None:
    lines = (scene / "traj.txt").read_text().splitlines()
    lines[line - 1] = text
    (scene / "traj.txt").write_text("\n".join(lines) + "\n")


def test_a_whole_scene_is_read_as_written(scene):
    loaded = load_replica(scene)
    assert (
        len(loaded) == 4
        and loaded.depths is not None
        and loaded.depths[2].name == "depth000002.png"
    )
    assert np.allclose(loaded.poses[3, :3, 3], [0.3, 0, 0])
    assert np.all(read_depth(loaded.depths[0], loaded.params) == 2.0)
    assert read_photo(loaded.photos[2], loaded.params)[0, 0].tolist() == [20, 50, 200]
    raw = np.full((6, 8), 1500, np.uint16)
    # unknown and saturated
    raw[0, 0] = 0
    raw[1, 1] = 65535
    Image.fromarray(raw).save(loaded.depths[0])
    depth = read_depth(loaded.depths[0], loaded.params)
    assert depth[0, 0] == 0 and depth[1, 1] == 0 and depth[2, 2] == 1.5
    (scene / "cam_params.json").rename(scene.parent / "cam_params.json")
    for kind in ("frame", "depth"):
        (scene / "results" / f"{kind}000003.png").rename(scene / "results" / f"{kind}000030.png")
    moved = load_replica(scene)
    assert moved.params.fx == 5.0 and moved.photos[3].stem == "frame000030", (
        "gaps are fine where counts agree"
    )
    moved.depths[1].unlink()
    assert load_replica(scene).depths is None


def test_the_convention_of_pixel_centres_is_told_by_the_principal_point(tmp_path):
    for number, (camera, expected) in enumerate(
        (
            ({}, (4.0, 3.0)),  # 3.5 of 8: Replica's own way, counted from the first pixel's centre
            ({"cx": 4.0, "cy": 3.0}, (4.0, 3.0)),  # exactly half: counted from the corner
            ({"cx": 3.9, "cy": 3.0}, (4.4, 3.5)),  # a calibration: OpenCV's integer centres
        )
    ):
        params = load_replica(
            write_scene(tmp_path / str(number), camera={**CAMERA, **camera})
        ).params
        assert params.principal_point == pytest.approx(expected)


def removed(name: str):
    return lambda scene: (scene / name).unlink()


def camera(content):
    text = content if isinstance(content, str) else json.dumps({"camera": {**CAMERA, **content}})
    return lambda scene: (scene / "cam_params.json").write_text(text)


def line(number: int, text: str):
    return lambda scene: edit_line(scene, number, text)


COLUMN_BY_COLUMN = np.eye(4)
COLUMN_BY_COLUMN[3, :3] = 1, 2, 3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda scene: scene.rename(scene.with_name("none")), ["no traj.txt or traj_w_c.txt"]),
        (removed("cam_params.json"), ["s/cam_params.json", "rooms/cam_params.json"]),
        (removed("results/frame000002.png"), ["4 poses for 3 photos"]),
        (camera("{"), ["JSONDecodeError", "cam_params.json"]),
        (camera("{}"), ["KeyError: 'camera'; expected {\"camera\""]),
        (camera({"fx": 10**400}), ["OverflowError: "]),
        (camera({"fx": -1.0}), ["'fx': -1.0", "with positive numbers"]),
        (camera({"cy": float("inf")}), ["'cy': inf"]),
        (camera({"h": 6.5}), ["'h': 6.5", "whole ones of pixels"]),
        (line(3, " ".join(["0"] * 15)), ["line 3: 15 values"]),
        (line(3, " ".join(["x"] * 16)), ["line 3: could not convert"]),
        (line(2, line_of(np.diag([1.1, 1.1, 1.1, 1]))), ["line 2 is no rigid pose"]),
        (line(2, line_of(np.diag([1, 1, -1, 1]))), ["line 2 is no rigid pose"]),
        (line(1, line_of(COLUMN_BY_COLUMN)), ["line 1 is no rigid pose", "last row 0 0 0 1"]),
        (
            lambda scene: [edit_line(scene, i, " ".join(["nan"] * 16)) for i in (1, 2, 3, 4)],
            ["4 of 4 poses hold NaN"],
        ),
    ],
)
def test_what_is_missing_or_cannot_be_used_is_named_in_one_line(scene, spoil, words):
    spoil(scene)
    fails(lambda: load_replica(scene), *words, error=DataError)


def test_pictures_of_another_kind_or_size_and_broken_ones_are_refused(scene):
    loaded = load_replica(scene)
    photo = loaded.photos[1]
    for spoil, message in (
        (
            lambda: Image.new("RGB", (9, 6)).save(photo),
            "frame000001.png: 9 x 6 pixels; expected 8 x 6",
        ),
        (lambda: photo.write_bytes(b""), "not a readable picture"),
        (photo.unlink, "frame000001.png: .*No such file"),
    ):
        spoil()
        with pytest.raises(DataError, match=message):
            read_photo(photo, loaded.params)
    depth = loaded.depths[1]
    depth.write_bytes(depth.read_bytes()[:-30])
    with pytest.raises(DataError, match="broken picture"):
        read_depth(depth, loaded.params)
    Image.new("L", (8, 6)).save(depth)
    with pytest.raises(DataError, match="expected a 16-bit grey"):
        read_depth(depth, loaded.params)


def test_seed_points_avoid_outlines_and_unknown_pixels(tmp_path):
    scene = load_replica(write_scene(tmp_path / "s", frames=1))
    raw = np.full((6, 8), 1000, np.uint16)
    raw[:, 4:] = 3000
    raw[0, 0] = 0
    Image.fromarray(raw).save(scene.depths[0])
    xyz, _ = fuse_depth(scene, 1000)
    # Lost: the columns on both sides of the step, the unknown pixel and its two other neighbours.
    assert len(xyz) == 6 * 6 - 3 and set(np.unique(xyz[:, 2])) == {1.0, 3.0}


@pytest.mark.parametrize(
    "lost", ["-inf " * 16, "nan " * 12 + "0 0 0 1", "1 0 0 1e39 0 1 0 0 0 0 1 0 0 0 0 1"]
)
def test_lost_poses_and_those_beyond_float32_are_dropped_by_line(scene, caplog, lost):
    edit_line(scene, 2, lost)
    with caplog.at_level(logging.WARNING):
        loaded = load_replica(scene)
    assert [int(path.stem[5:]) for path in loaded.photos] == [0, 2, 3]
    assert np.isfinite(loaded.poses.astype(np.float32)).all()
    assert "1 of 4 poses" in caplog.text and "line 2" in caplog.text


def test_sequences_of_semantic_nerf_are_read_as_the_same_scene(row, tmp_path):
    """``Sequence_1`` of Semantic-NeRF's Replica: other names, depth in millimetres, a field of view
    of 90 degrees."""
    sequence = tmp_path / "room_0" / "Sequence_1"
    for folder in ("rgb", "depth"):
        (sequence / folder).mkdir(parents=True)
    ours = load_replica(row)
    for number, (photo, depth) in enumerate(zip(ours.photos, ours.depths, strict=True)):
        Image.open(photo).save(sequence / "rgb" / f"rgb_{number}.png")
        values = np.round(1000 * read_depth(depth, ours.params)).astype(np.uint16)
        Image.fromarray(values).save(sequence / "depth" / f"depth_{number}.png")
    (sequence / "traj_w_c.txt").write_bytes((row / "traj.txt").read_bytes())
    theirs = load_replica(sequence)
    assert len(theirs) == len(ours) == 12 and np.array_equal(theirs.poses, ours.poses)
    assert [path.name for path in theirs.photos][9:] == ["rgb_9.png", "rgb_10.png", "rgb_11.png"]
    assert theirs.params.fx == theirs.params.fy == 4 and theirs.params.principal_point == (4, 3)
    depths = [read_depth(each.depths[3], each.params) for each in (theirs, ours)]
    assert np.allclose(*depths, atol=6e-4), "half a millimetre of rounding"
    assert np.array_equal(
        read_photo(theirs.photos[3], theirs.params), read_photo(ours.photos[3], ours.params)
    )
    with pytest.raises(DataError, match="it contains the scenes Sequence_1: name one of them"):
        load_replica(sequence.parent)
    (sequence / "cam_params.json").write_text(json.dumps({"camera": CAMERA}))
    assert load_replica(sequence).params.fx == CAMERA["fx"]


@pytest.mark.skipif(not ROOM0.is_dir(), reason="needs twenty frames of Replica's room0")
def test_frames_of_replica_itself_are_read_and_agree_with_each_other():
    """The depths of one frame, moved into the pose of another, are the other's depths: the scale,
    the poses, the axes and the pixel centres are read as Replica means them."""
    scene = load_replica(ROOM0)
    params = scene.params
    assert (len(scene), params.width, params.height, params.scale) == (20, 1200, 680, 6553.5)
    assert [len(parse(ROOM0, split).image_filenames) for split in ("train", "val")] == [18, 2]
    cx, cy = params.principal_point
    first, last = (read_depth(scene.depths[index], params) for index in (0, 19))
    # pixel centres at half pixels, as the principal point has them
    x, y = np.meshgrid(np.arange(params.width) + 0.5, np.arange(params.height) + 0.5)
    rays = np.stack([(x - cx) / params.fx, (y - cy) / params.fy, np.ones_like(x)], axis=-1)
    to_last = np.linalg.inv(scene.poses[19]) @ scene.poses[0]
    assert np.linalg.norm(to_last[:3, 3]) > 0.01  # m: the camera has moved
    moved = (rays * first[..., None]).reshape(-1, 3) @ to_last[:3, :3].T + to_last[:3, 3]
    column = np.floor(params.fx * moved[:, 0] / moved[:, 2] + cx).astype(int)
    line = np.floor(params.fy * moved[:, 1] / moved[:, 2] + cy).astype(int)
    inside = (column >= 0) & (column < params.width) & (line >= 0) & (line < params.height)
    assert inside.mean() > 0.7
    there = last[line[inside], column[inside]]
    error = np.abs(moved[inside, 2] - there)
    assert np.median(error) < 0.005, f"{np.median(error)} m"  # half a pixel on slanted walls
    photos = [read_photo(scene.photos[index], params) for index in (0, 19)]
    seen = np.abs(
        photos[0].reshape(-1, 3)[inside].astype(float)
        - photos[1][line[inside], column[inside]].astype(float)
    )
    assert np.median(seen) < 8  # of 255: the same places have the same colours
