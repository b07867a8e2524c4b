"""Captures of all kinds."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetppDataParserConfig
from nerfstudio.pipelines.base_pipeline import Pipeline

from captures import BAD, FRAMES, HELD_OUT, SEEDS, Capture, Lens, colors_at, seen_from
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.frames import Frame
from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig

FISHEYE = Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.003, -0.001), focal=(30.0, 30.5))


@dataclass
class Layout:
    lens: Lens
    write: Callable[[Capture, Path], Path]
    dataparser: Callable[[], DataParserConfig]
    frames: int = FRAMES
    """Photos that are used."""
    wrong: float = 0.002
    """How far photos may be off on average, in [0, 1]: rounding to 8 bits is 0.001; undistorting
    interpolates."""


def as_colmap(capture: Capture, folder: Path) -> Path:
    names = capture.write_photos(folder / "images")
    capture.write_colmap(folder / "colmap/sparse/0", names)
    return folder


LAYOUTS = {
    "nerfstudio-data": Layout(
        Lens(), Capture.write_nerfstudio, lambda: NerfstudioDataParserConfig(load_3D_points=True)
    ),
    "colmap": Layout(
        Lens(distortion=(0.12, -0.05, 0.004, -0.003)), as_colmap, ColmapDataParserConfig
    ),
    "scannetpp-seeded": Layout(
        FISHEYE, Capture.write_scannetpp, SeededScanNetppDataParserConfig, frames=FRAMES - len(BAD)
    ),
}


@pytest.fixture(scope="module", params=LAYOUTS)
def opened(request, wall_config, tmp_path_factory) -> tuple[Capture, Layout, Pipeline]:
    layout = LAYOUTS[request.param]
    capture = Capture(layout.lens)
    folder = tmp_path_factory.mktemp("capture")
    config = wall_config(layout.write(capture, folder / "data"), folder / "outputs", 1)
    config.pipeline.datamanager.dataparser = layout.dataparser()
    return capture, layout, config.pipeline.setup(device="cpu", test_mode="val")


def wrongness(frame: Frame, outputs: DataparserOutputs) -> float:
    """Mean difference, in [0, 1], between a photo and what its camera sees in the room, where no
    mask is."""
    camera, data = frame
    rays = camera.generate_rays(0)
    turn, shift = outputs.dataparser_transform.double().split([3, 1], dim=1)
    eye = (rays.origins[0, 0].double() / outputs.dataparser_scale - shift[:, 0]) @ turn
    seen = colors_at(seen_from(eye.numpy(), (rays.directions.double() @ turn).numpy()))
    difference = np.abs(data["image"].numpy() / 255 - seen).mean(axis=-1)
    if "mask" not in data:
        return float(difference.mean())
    # nerfstudio keeps pixels that are mixed with hidden ones.
    sure = cv2.erode(data["mask"].numpy().astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert 0.5 < sure.mean() < 0.97, "a mask that hides nothing, or all, proves nothing"
    return float(difference[sure].mean())


def test_every_pixel_shows_what_its_camera_sees(opened):
    _, layout, pipeline = opened
    manager = pipeline.datamanager
    outputs = pipeline.datamanager.train_dataparser_outputs
    held_out = manager.fixed_indices_eval_dataloader
    frames = [*manager.train_frames, *held_out]
    assert len(held_out) > 0 and len(frames) == layout.frames
    assert all(wrongness(frame, outputs) < layout.wrong for frame in frames)
    camera, data = frames[0]
    camera.cx = camera.cx + 0.5
    assert wrongness((camera, data), outputs) > layout.wrong, "half a pixel would not be noticed"


def test_a_scene_starts_from_the_points_of_the_capture(opened):
    capture, _, pipeline = opened
    outputs = pipeline.datamanager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double()
    points = torch.from_numpy(capture.seeds)
    placed = (points @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale
    # 1e-5: float32
    torch.testing.assert_close(outputs.metadata["points3D_xyz"].double(), placed, atol=1e-5, rtol=0)
    assert np.array_equal(outputs.metadata["points3D_rgb"].numpy(), capture.seed_colors)
    assert pipeline.model.num_points == SEEDS


TRANSFORMS = "dslr/nerfstudio/transforms.json"


@pytest.mark.parametrize("common", [True, False])
def test_photos_of_several_cameras_of_scannetpp_show_what_their_cameras_see(
    common, wall_config, tmp_path
):
    folder = Capture(FISHEYE).write_scannetpp(tmp_path / "data")
    meta = json.loads((folder / TRANSFORMS).read_text())
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4")
    width = meta["w"]
    for index, frame in enumerate((*meta["frames"], *meta["test_frames"])):
        if index % 2 and common:
            continue  # of the camera of all frames
        cut = 0 if index % 2 else 6  # columns on both sides that a second camera does not have
        frame |= {name: meta[name] for name in names}
        frame |= {"w": meta["w"] - 2 * cut, "cx": meta["cx"] - cut}
        for place in ("resized_images", "resized_anon_masks"):
            path = str(folder / "dslr" / place / frame["file_path"])
            cv2.imwrite(path, cv2.imread(path, cv2.IMREAD_UNCHANGED)[:, cut : width - cut])
    if not common:
        for name in names:
            del meta[name]
    (folder / TRANSFORMS).write_text(json.dumps(meta))
    config = wall_config(folder, tmp_path / "outputs", 1)
    config.pipeline.datamanager.dataparser = SeededScanNetppDataParserConfig()
    manager = config.pipeline.setup(device="cpu", test_mode="val").datamanager
    frames = [*manager.train_frames, *manager.fixed_indices_eval_dataloader]
    assert len(frames) == FRAMES - len(BAD)
    assert len({data["image"].shape for _, data in frames}) == 2
    outputs = manager.train_dataparser_outputs
    wrong = [wrongness(frame, outputs) for frame in frames]
    assert max(wrong) < 0.002, wrong


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return Capture(FISHEYE).write_scannetpp(tmp_path_factory.mktemp("scannetpp") / "0a5c013435")


@pytest.fixture
def own_scene(scene, tmp_path) -> Path:
    return Path(shutil.copytree(scene, tmp_path / "scene"))


def parsed(scene: Path, split: str = "train", **settings) -> DataparserOutputs:
    return (
        SeededScanNetppDataParserConfig(data=scene, **settings)
        .setup()
        .get_dataparser_outputs(split)
    )


def numbers(outputs: DataparserOutputs) -> list[int]:
    return [int(path.stem) for path in outputs.image_filenames]


def test_bad_frames_leave_both_splits_with_their_masks_and_cameras(scene):
    for split, wanted in (("train", set(range(FRAMES)) - set(HELD_OUT)), ("test", set(HELD_OUT))):
        ours = parsed(scene, split)
        every = ScanNetppDataParserConfig(data=scene).setup().get_dataparser_outputs(split)
        assert (
            numbers(ours) == sorted(wanted - set(BAD))
            and len(numbers(every)) == len(numbers(ours)) + 1
        )
        assert [path.stem for path in ours.mask_filenames] == [
            path.stem for path in ours.image_filenames
        ]
        kept = [numbers(every).index(number) for number in numbers(ours)]
        assert torch.equal(ours.cameras.camera_to_worlds, every.cameras.camera_to_worlds[kept])
        assert torch.equal(ours.dataparser_transform, every.dataparser_transform)
        assert numbers(parsed(scene, split, skip_bad=False)) == numbers(every)


def test_without_points_there_are_no_seed_points_and_a_line_says_so(own_scene, capsys):
    (own_scene / "dslr/colmap/points3D.txt").write_text("# none\n")
    assert "points3D_xyz" not in parsed(own_scene).metadata
    shutil.rmtree(own_scene / "dslr/colmap")
    assert "points3D_xyz" not in parsed(own_scene).metadata
    assert " ".join(capsys.readouterr().out.split()).count("so no seed points") == 2


def change(scene: Path, **values) -> None:
    """Change entries of transforms.json; None removes one."""
    meta = json.loads((scene / TRANSFORMS).read_text()) | values
    (scene / TRANSFORMS).write_text(
        json.dumps({name: value for name, value in meta.items() if value is not None})
    )


def rewritten(name: str, before: str, after: str) -> Callable[[Path], object]:
    return lambda scene: (scene / name).write_text(
        (scene / name).read_text().replace(before, after)
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            rewritten(TRANSFORMS, "0.3", "0.4"),
            "poses of 10 photos are not those of transforms.json.*--load-seed-points",
        ),
        (
            rewritten("dslr/colmap/images.txt", ".png", ".jpg"),
            "knows none of the 10 photos by name",
        ),
        (
            rewritten(TRANSFORMS, "false", "true"),
            "train split: all 7 frames are hidden or marked is_bad.*--skip-bad False",
        ),
        (lambda scene: (scene / "dslr/colmap/images.txt").unlink(), r"no images.bin or images.txt"),
        (
            lambda scene: (scene / "dslr/colmap/points3D.txt").write_text("1 2 3\n"),
            "points3D.txt: cannot be read",
        ),
        (
            lambda scene: (scene / TRANSFORMS).unlink(),
            "transforms.json: no such file.*--data names",
        ),
        (
            lambda scene: (scene / "dslr/resized_images/00001.png").unlink(),
            "1 of 7 .* missing, first 00001.png",
        ),
        (
            lambda scene: (scene / TRANSFORMS).write_text("{}"),
            "KeyError: 'frames'; expected JSON with frames",
        ),
        (lambda scene: (scene / TRANSFORMS).write_text("{"), "transforms.json: JSONDecodeError"),
    ],
)
def test_what_cannot_be_used_is_named(own_scene, spoil, message):
    spoil(own_scene)
    with pytest.raises(DataError, match=message):
        parsed(own_scene)


def test_hidden_photos_of_a_test_leave_a_split_of_the_others(own_scene, scene, capsys):
    """Official test scenes publish the poses of their test photos alone."""
    for number in HELD_OUT:
        (own_scene / f"dslr/resized_images/{number:05d}.png").unlink()
        (own_scene / f"dslr/resized_anon_masks/{number:05d}.png").unlink()
    train = parsed(own_scene, skip_bad=False)
    held_out = parsed(own_scene, "test", skip_bad=False)
    assert len(numbers(held_out)) >= 1 and not {*numbers(train)} & {*numbers(held_out)}
    assert {*numbers(train), *numbers(held_out)} == {*range(FRAMES)} - {*HELD_OUT}
    same = torch.equal(train.dataparser_transform, parsed(scene).dataparser_transform)
    assert same, "hidden poses count in the frame"
    assert "photos of the test are hidden" in " ".join(capsys.readouterr().out.split())
    frames = json.loads((scene / TRANSFORMS).read_text())["frames"]
    change(own_scene, frames=frames, test_frames=None)  # no lists either: every tenth is held out
    assert [
        len(numbers(parsed(own_scene, split, skip_bad=False))) for split in ("train", "test")
    ] == [6, 1]


def test_photos_are_held_out_by_the_lists_where_there_are_no_test_frames(own_scene, scene):
    meta = json.loads((own_scene / TRANSFORMS).read_text())
    change(own_scene, frames=meta["frames"] + meta["test_frames"], test_frames=None)
    lists = {"train": [frame["file_path"] for frame in meta["frames"]], "has_masks": True}
    lists["test"] = [frame["file_path"] for frame in meta["test_frames"]]
    (own_scene / "dslr/train_test_lists.json").write_text(json.dumps(lists))
    for split in ("train", "test"):
        assert numbers(parsed(own_scene, split)) == numbers(parsed(scene, split))


def test_a_fraction_splits_as_nerfstudio_splits_colmap_models(scene, tmp_path):
    data = as_colmap(Capture(Lens()), tmp_path / "colmap")
    theirs = ColmapDataParserConfig(
        data=data, eval_mode="fraction", train_split_fraction=0.7, downscale_factor=1
    )
    for split in ("train", "test"):
        ours = parsed(scene, split, skip_bad=False, train_split_fraction=0.7)
        assert numbers(ours) == numbers(theirs.setup().get_dataparser_outputs(split))
    with pytest.raises(DataError, match="--train-split-fraction 1: expected above 0"):
        parsed(scene, train_split_fraction=1)


@pytest.mark.parametrize(
    ("transforms", "photos", "masks", "colmap"),
    [
        (
            "dslr/nerfstudio/transforms_undistorted.json",
            "dslr/undistorted_images",
            "dslr/undistorted_anon_masks",
            None,
        ),
        ("nerfstudio/transforms.json", "images", "masks", "colmap"),
        ("iphone/nerfstudio/transforms.json", "iphone/rgb", "iphone/rgb_masks", "iphone/colmap"),
    ],
)
def test_what_the_toolkit_writes_is_read(own_scene, scene, transforms, photos, masks, colmap):
    if colmap is None:
        change(own_scene, camera_model="PINHOLE", **dict.fromkeys(("k1", "k2", "k3", "k4"), 0.0))
    else:  # names of photos begin with their folder's
        meta = json.loads((own_scene / TRANSFORMS).read_text())
        for frame in (*meta["frames"], *meta["test_frames"]):
            frame["file_path"] = f"{Path(photos).name}/{frame['file_path']}"
        (own_scene / TRANSFORMS).write_text(json.dumps(meta))
        (own_scene / colmap).parent.mkdir(exist_ok=True)
        (own_scene / "dslr/colmap").rename(own_scene / colmap)
    moves = {
        TRANSFORMS: transforms,
        "dslr/resized_images": photos,
        "dslr/resized_anon_masks": masks,
    }
    for before, after in moves.items():
        (own_scene / after).parent.mkdir(exist_ok=True)
        (own_scene / before).rename(own_scene / after)
    for split in ("train", "test"):
        ours = parsed(own_scene, split)
        plain = parsed(scene, split)
        assert numbers(ours) == numbers(plain) and all(
            path.is_file() for path in ours.image_filenames
        )
        assert all(path.is_file() for path in ours.mask_filenames)
        assert torch.equal(ours.cameras.camera_to_worlds, plain.cameras.camera_to_worlds)
        assert ("points3D_xyz" in ours.metadata) == (split == "train")
