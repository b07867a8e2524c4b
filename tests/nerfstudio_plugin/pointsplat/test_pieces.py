"""Training on pieces of scenes, and from the weights of a trained network."""

from unittest import mock

import pytest
import torch

from making import box_room, dense_config, equal, small_config, small_refiner
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.nerfstudio_plugin import console
from pointsplat_ns.nerfstudio_plugin.cameras import views_of_cameras
from pointsplat_ns.nerfstudio_plugin.pointsplat import pieces
from pointsplat_ns.nerfstudio_plugin.pointsplat.pieces import ScenePiece, read_piece
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refinement import WeightsError, read_refiner, save_refiner
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.runs import RUN_FILES


@pytest.fixture(autouse=True)
def few_are_enough(monkeypatch):
    monkeypatch.setattr(pieces, "FEWEST_LEFT", 8)


def pieces_config(data, folder, steps=2, **changes):
    config = dense_config(data, folder, steps)
    config.steps_per_eval_image = 0
    config.pipeline.model.units = "local"
    config.pipeline.model.augment = True
    for name, value in {"pieces": 300, "piece_poses": 2, **changes}.items():
        setattr(config.pipeline.datamanager, name, value)
    return config


def manager_of(data, **changes):
    return pieces_config(data, data, **changes).pipeline.datamanager.setup(test_mode="val")


def rows_of(scene: Gaussians) -> set[tuple]:
    return set(map(tuple, scene.means.tolist()))


@pytest.mark.parametrize("by", ["paper", "merge"])
def test_the_pieces_of_a_cut_are_the_whole_scene_dense_and_pruned(three_rooms, by):
    manager = manager_of(three_rooms, cuts=2)
    assert manager.whole_scenes == 3
    settings = PruneSettings(0.4, by)
    whole = manager.scenes[0]
    smaller = settings.prune(whole.dense(keep=True))
    found = [s for s in manager.scenes if isinstance(s, ScenePiece) and s.of.whole is whole]
    cuts = {piece.of.seed for piece in found}
    assert len(cuts) == 2
    for seed in cuts:
        of_cut = [piece for piece in found if piece.of.seed == seed]
        dense = [piece.read_dense() for piece in of_cut]
        pruned, kept = zip(*(piece.pruned(settings) for piece in of_cut), strict=True)
        for parts, scene in ((dense, whole.dense(keep=True)), (pruned, smaller)):
            assert sum(map(len, parts)) == len(scene)
            assert rows_of(Gaussians.cat(list(parts))) == rows_of(scene)
        assert set(kept) == {0.4}
        assert max(map(len, dense)) <= 300


def test_a_training_on_pieces_keeps_them_and_saves_whole_scenes(
    three_rooms, run_training, tmp_path
):
    config = pieces_config(three_rooms, tmp_path, pieces_folder=tmp_path / "kept")
    trainer, losses = run_training(config)
    assert len(losses) == 2 and all(map(torch.tensor, losses))
    kept = list((tmp_path / "kept").iterdir())
    found = read_piece(kept[0])
    assert (found.images.shape, found.behind.shape) == ((2, 36, 48, 4), (2, 36, 48, 3))
    manager = trainer.pipeline.datamanager
    assert {s.identity for s in manager.scenes[:3]} == trainer.pipeline.trained_on
    summary = trainer.pipeline.get_average_eval_image_metrics()
    assert set(summary["scenes"]) == {"room0", "room1", "room2"}
    # the same pieces from their files
    with mock.patch.object(pieces.RenderedPiece, "_made", side_effect=AssertionError):
        _, again = run_training(
            pieces_config(three_rooms, tmp_path / "again", pieces_folder=tmp_path / "kept")
        )
    assert again == losses


def test_a_damaged_file_of_a_piece_is_made_again(three_rooms, tmp_path):
    manager = manager_of(three_rooms, pieces_folder=tmp_path)
    piece = manager.scenes[3]
    images = piece.rendered["train"].dataset._content().images
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-100])
    assert read_piece(path) is None
    again = manager_of(three_rooms, pieces_folder=tmp_path).scenes[3]
    assert torch.equal(again.rendered["train"].dataset._content().images, images)
    assert read_piece(path) is not None


def test_a_piece_over_the_rest_of_its_scene_and_over_any_colour(three_rooms):
    piece = manager_of(three_rooms).scenes[3]
    camera, data = piece.rendered["train"][0]
    image = data["image"].float() / 255

    def drawn(scene: Gaussians, background: torch.Tensor) -> torch.Tensor:
        return render(scene, views_of_cameras(camera, background)[0])

    white = torch.ones(3)
    composited = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
    # colour and opacity are each rounded to 1/255
    assert (drawn(piece.read_dense(), white) - composited).abs().max() < 1.5 / 255
    rest = piece.of.rest(piece.number)
    assert len(rest) == 900 - len(piece.read_dense())
    behind = piece.training_background(data)
    assert (drawn(rest, torch.zeros(3)) - behind).abs().max() <= 0.51 / 255


def test_what_is_not_seen_is_left_out_in_one_line_and_what_is_small_stays_whole(tmp_path):
    room = box_room(2)
    write_ply(box_room(0), tmp_path / "room.ply")
    write_ply(box_room(1)[:50], tmp_path / "few.ply")
    write_ply(room.replace(opacities=room.opacities - 1e3), tmp_path / "clear.ply")
    write_ply(room.replace(means=room.means * torch.nan), tmp_path / "broken.ply")
    with mock.patch.object(console.CONSOLE, "log") as log:
        manager = manager_of(tmp_path)
        names = {manager.scenes[manager.scene_at(step)].name.split("/")[0] for step in range(15)}
    assert names == {"room", "few"}
    said = [str(call.args[0]) for call in log.call_args_list if "left out" in str(call.args[0])]
    assert said[0].startswith("broken is left out")
    assert len(said) > 1 and all(text.startswith("clear/") for text in said[1:])
    assert not any("\n" in text for text in said)


def test_scenes_are_cut_by_default_where_renders_are_the_targets(three_rooms, monkeypatch):
    module = "pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager.PIECES"
    with mock.patch(module, 300):
        cut = manager_of(three_rooms, pieces=None)
        whole = manager_of(three_rooms, pieces=0)
    assert len(cut.train_indices) == 12 and cut.training_names == ["room0", "room1", "room2"]
    assert whole.train_indices == [0, 1, 2]


def test_pieces_are_refused_where_they_mean_nothing(trained_walls, three_rooms):
    config = small_config(trained_walls, trained_walls, 1)
    config.pipeline.datamanager.pieces = 300
    with pytest.raises(DataError, match="supervision dense"):
        config.pipeline.datamanager.setup(test_mode="val")
    with pytest.raises(DataError, match="0 cuts"):
        manager_of(three_rooms, cuts=0)


def test_a_training_starts_from_the_weights_and_options_of_a_network(
    three_rooms, run_training, tmp_path
):
    first = pieces_config(three_rooms, tmp_path / "first")
    run_training(first)
    weights = first.get_base_dir() / RUN_FILES.refiner
    second = dense_config(three_rooms, tmp_path / "second", 1)
    second.init = str(weights)
    second.set_timestamp()
    model = second.pipeline.model
    assert model.units == "local" and model.norm is None
    trainer = second.setup()
    trainer.setup()
    found = trainer.pipeline.model.refiner.state_dict()
    assert equal(found, read_refiner(weights).state_dict())


def test_a_network_to_start_from_that_cannot_be_built_is_refused(three_rooms, tmp_path):
    save_refiner(small_refiner(), tmp_path / "other.safetensors", {"by": "paper", "keep": 0.1})
    config = dense_config(three_rooms, tmp_path, 1)
    for init, error in (("other", SceneError), ("gone", WeightsError)):
        config.init = str(tmp_path / f"{init}.safetensors")
        with pytest.raises(error):
            config.set_timestamp()
