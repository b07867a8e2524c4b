"""The ``scannetpp-seeded`` dataparser: a fisheye with masks, bad frames, COLMAP's points."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetppDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as colmap

from captures import BAD, FRAMES, HELD_OUT, SEEDS, Capture, Lens
from making import pipeline_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.measure_tables import paper_dataset
from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig

FISHEYE = Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.003, -0.001), focal=(30.0, 30.5))
TRANSFORMS = "dslr/nerfstudio/transforms.json"


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return Capture(FISHEYE).write_scannetpp(tmp_path_factory.mktemp("scannetpp") / "0a5c013435")


@pytest.fixture
def own_scene(scene, tmp_path) -> Path:
    """A copy to change."""
    return Path(shutil.copytree(scene, tmp_path / "scene"))


def parsed(scene: Path, split: str = "train", **settings) -> DataparserOutputs:
    return SeededScanNetppDataParserConfig(data=scene, **settings).setup().get_dataparser_outputs(split)


def numbers(outputs: DataparserOutputs) -> list[int]:
    return [int(path.stem) for path in outputs.image_filenames]


def test_bad_frames_are_left_out_of_both_splits_with_their_masks_and_cameras(scene):
    for split, wanted in (("train", set(range(FRAMES)) - set(HELD_OUT)), ("test", set(HELD_OUT))):
        ours, every = parsed(scene, split), ScanNetppDataParserConfig(data=scene).setup().get_dataparser_outputs(split)
        assert numbers(ours) == sorted(wanted - set(BAD)) and len(numbers(every)) == len(numbers(ours)) + 1
        assert [path.stem for path in ours.mask_filenames] == [path.stem for path in ours.image_filenames]
        kept = [numbers(every).index(number) for number in numbers(ours)]
        assert torch.equal(ours.cameras.camera_to_worlds, every.cameras.camera_to_worlds[kept])
        assert torch.equal(ours.dataparser_transform, every.dataparser_transform)
        assert numbers(parsed(scene, split, skip_bad=False)) == numbers(every)


def test_points_come_with_the_training_split_alone(scene):
    assert len(parsed(scene).metadata["points3D_xyz"]) == SEEDS
    assert "points3D_xyz" not in parsed(scene, "test").metadata
    assert "points3D_xyz" not in parsed(scene, load_seed_points=False).metadata


def test_binary_files_of_colmap_give_the_same_points(scene, own_scene):
    folder = own_scene / "dslr/colmap"
    for name, write in (("images", colmap.write_images_binary), ("points3D", colmap.write_points3D_binary)):
        read = getattr(colmap, f"read_{name}_text")(folder / f"{name}.txt")
        write(read, folder / f"{name}.bin")
        (folder / f"{name}.txt").unlink()
    for name in ("points3D_xyz", "points3D_rgb"):
        torch.testing.assert_close(parsed(own_scene).metadata[name], parsed(scene).metadata[name])


@pytest.mark.parametrize("gone", ["folder", "points"])
def test_without_points_training_starts_from_random_ones(own_scene, gone, capsys):
    if gone == "folder":
        shutil.rmtree(own_scene / "dslr/colmap")
    else:
        (own_scene / "dslr/colmap/points3D.txt").write_text("# none\n")
    assert "points3D_xyz" not in parsed(own_scene).metadata
    assert "starts from random ones" in " ".join(capsys.readouterr().out.split())


def spoil_pose(scene: Path) -> None:
    meta = json.loads((scene / TRANSFORMS).read_text())
    meta["frames"][4]["transform_matrix"][1][3] += 0.1
    (scene / TRANSFORMS).write_text(json.dumps(meta))


def mark_all(scene: Path) -> None:
    meta = json.loads((scene / TRANSFORMS).read_text())
    meta["frames"] = [{**frame, "is_bad": True} for frame in meta["frames"]]
    (scene / TRANSFORMS).write_text(json.dumps(meta))


def rename_photos(scene: Path) -> None:
    path = scene / "dslr/colmap/images.txt"
    path.write_text(path.read_text().replace(".png", ".jpg"))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (spoil_pose, "poses of 10 photos are not those of transforms.json.*--load-seed-points False"),
        (rename_photos, "knows none of the 10 photos by name"),
        (mark_all, "all 7 frames of the train split are marked is_bad.*--skip-bad False"),
        (lambda scene: (scene / "dslr/colmap/images.txt").unlink(), r"no images.bin or images.txt"),
        (lambda scene: (scene / "dslr/colmap/points3D.txt").write_text("1 2 3\n"), "points3D.txt: cannot be read"),
        (lambda scene: (scene / TRANSFORMS).unlink(), "transforms.json: no such file.*test_frames"),
        (lambda scene: (scene / TRANSFORMS).write_text("{}"), "KeyError: 'frames'; expected JSON with frames"),
        (lambda scene: (scene / TRANSFORMS).write_text("{"), "transforms.json: JSONDecodeError"),
    ],
)
def test_what_cannot_be_used_is_named(own_scene, spoil, message):
    spoil(own_scene)
    with pytest.raises(DataError, match=message):
        parsed(own_scene)


@pytest.mark.parametrize("method", ["splatfacto-cpu", "pointsplat"])
def test_what_a_mask_hides_does_not_count(method, scene, wall_config, run_training, tmp_path):
    config = wall_config(scene, tmp_path, steps=1)
    config.pipeline.datamanager.dataparser = SeededScanNetppDataParserConfig()
    trainer, _ = run_training(config)
    pipeline = trainer.pipeline if method == "splatfacto-cpu" else pipeline_of(config.get_base_dir())
    pipeline.eval()

    def loss(change: torch.Tensor | float) -> float:
        changed = {**data, "image": (data["image"] / 255 + change).clamp(0, 1)}
        if method == "splatfacto-cpu":
            return float(pipeline.model.get_loss_dict(pipeline.model(camera), changed)["main_loss"])
        return float(pipeline.model.losses(0, [(camera, changed)])[1]["l1"])

    manager = pipeline.datamanager
    camera, data = manager.train_frames[0] if method == "splatfacto-cpu" else manager.next_train(0)[1][0]
    hidden = ~data["mask"]
    assert 0.02 < hidden.float().mean() < 0.5
    assert loss(0.5 * hidden) == loss(0.0) != loss(0.5 * ~hidden)


@pytest.mark.parametrize("kind", [ScanNetppDataParserConfig, SeededScanNetppDataParserConfig])
def test_scenes_read_by_either_dataparser_are_known_as_the_datasets(scene, kind):
    assert paper_dataset(SimpleNamespace(dataparser_class=f"a.module.{kind.__name__}", data=scene)) == "ScanNet++"
