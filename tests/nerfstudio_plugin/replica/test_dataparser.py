"""The ``replica-data`` dataparser, on small scenes made here and on real ones where they are at hand."""

from pathlib import Path

import pytest
import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig, read_eval_list
from replica_scenes import write_scene


@pytest.fixture()
def scene(tmp_path):
    return write_scene(tmp_path / "room", frames=12, step=1.0)


def parse(folder, split="train", **options):
    return ReplicaDataParserConfig(data=folder, **options).setup().get_dataparser_outputs(split)


def numbers(outputs):
    return [int(path.stem[5:]) for path in outputs.image_filenames]


def test_every_tenth_used_frame_is_held_out(scene):
    assert numbers(parse(scene, "val")) == numbers(parse(scene, "test")) == [0, 10]
    assert numbers(parse(scene)) == [1, 2, 3, 4, 5, 6, 7, 8, 9, 11]
    assert numbers(parse(scene, "val", frame_stride=2, eval_every=3)) == [0, 6]
    assert numbers(parse(scene, frame_stride=2, eval_every=3)) == [2, 4, 8, 10]


def test_frames_are_held_out_by_number_or_by_a_list_file(scene, tmp_path):
    assert numbers(parse(scene, "test", eval_frames=(7, 3))) == [3, 7]
    assert 7 not in numbers(parse(scene, eval_frames=(7, 3)))
    listed = tmp_path / "held_out.txt"
    listed.write_text("# two frames\nframe000005.png\n\n9  # the ninth\n")
    assert numbers(parse(scene, "test", eval_list=listed, frame_stride=4)) == [5, 9]
    listed.write_text("results/frame000005.png\nkitchen\n")
    with pytest.raises(DataError, match="line 2 is 'kitchen'"):
        read_eval_list(listed)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"eval_frames": (3, 99)}, "frame 99 is not among the 12 usable frames"),
        ({"eval_every": 1}, "--eval-every 1"),
        ({"frame_stride": 0}, "--frame-stride 0"),
        ({"scale_factor": float("nan")}, "--scale-factor nan"),
        ({"frame_stride": 12}, "leave 0 for training"),
        ({"eval_frames": (1,), "eval_list": Path("x")}, "both given"),
    ],
)
def test_options_that_cannot_work_are_refused_in_one_line(scene, options, words):
    with pytest.raises(DataError, match=words):
        parse(scene, **options)


def test_cameras_follow_nerfstudio_axes_and_pixel_centres(scene):
    cameras = parse(scene, "val").cameras
    # Facing +z with y down (OpenCV) is facing -(-z) with y up: the y and z columns are negated.
    expected = torch.tensor([[1.0, 0, 0, 10.0], [0, -1, 0, 0], [0, 0, -1, 0]])
    assert torch.equal(cameras.camera_to_worlds[1], expected)
    assert float(cameras.cx[0]) == 4.0 and float(cameras.cy[0]) == 3.0
    # nerfstudio's own ray through the middle of the picture goes along the optical axis, +z here.
    ray = cameras.generate_rays(camera_indices=0, coords=torch.tensor([[3.0, 4.0]]))
    assert torch.allclose(ray.directions[0], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)


def test_seed_points_come_from_training_frames_alone_always_the_same_and_scale_with_the_cameras(scene):
    outputs = parse(scene, eval_frames=(0,), scale_factor=2.0)
    xyz, rgb = outputs.metadata["points3D_xyz"], outputs.metadata["points3D_rgb"]
    assert xyz.dtype == torch.float32 and rgb.dtype == torch.uint8
    assert torch.all(xyz[:, 2] == 4.0)
    assert float(xyz[:, 0].min()) == pytest.approx(2 * (1 - 1.4))  # frame 1, not frame 0, starts the row
    assert (rgb[:, 0] > 0).all()  # frame 0 alone has no red
    assert outputs.dataparser_scale == 2.0 and float(outputs.cameras.camera_to_worlds[0, 0, 3]) == 2.0
    assert "points3D_xyz" not in parse(scene, "val").metadata
    assert "points3D_xyz" not in parse(scene, load_seed_points=False).metadata
    first, again = (parse(scene, num_seed_points=50).metadata for _ in range(2))
    assert len(first["points3D_xyz"]) <= 50
    assert all(torch.equal(first[name], again[name]) for name in ("points3D_xyz", "points3D_rgb"))
    by_hand = parse(scene, depth_unit_scale_factor=1e-4).metadata
    assert by_hand["depth_unit_scale_factor"] == pytest.approx(1e-4)
    assert torch.allclose(by_hand["points3D_xyz"][:, 2], torch.tensor(0.2))
