"""The model: scenes pruned once and refined, and what a step costs."""

import math
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import pipeline_of, run_of, same
from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import read_scene
from pointsplat_ns.metrics.lpips import load_lpips
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.pruning import METHODS, prune, score_of, select
from pointsplat_ns.rasterizer import rasterization


def test_by_default_scenes_are_merged(trained_walls):
    assert pointsplat_config().pipeline.model.by == "merge"
    wanted = prune(read_scene(run_of(trained_walls, "wall-a")), 0.25, "merge")
    assert same(pipeline_of(trained_walls, by="merge", keep=0.25).model.pruned_scene(0).pruned, wanted)


def test_untrained_the_refined_scene_is_the_pruned_one_to_the_bit(trained_walls):
    pipeline = pipeline_of(trained_walls)
    for index, scene in enumerate(pipeline.datamanager.scenes):
        dense = scene.read_dense()
        smaller = pipeline.model.pruned_scene(index)
        assert len(smaller.pruned) == math.floor(len(dense) / 2 + 0.5) and smaller.dense_count == len(dense)
        kept = select(score_of(dense, METHODS["paper"], opacity_weight=0.3), len(smaller.pruned))
        assert same(smaller.pruned, dense[kept]), "kept rows are the dense ones"
        assert same(pipeline.model.refine(index), smaller.pruned)
        assert smaller.pruned.sh_degree == dense.sh_degree


def test_a_scene_is_drawn_as_it_was_trained(trained_walls):
    pipeline = pipeline_of(trained_walls)
    modes = []

    def recorded(**arguments):
        modes.append((arguments["rasterize_mode"], arguments["sh_degree"]))
        return rasterization(**arguments)

    place = "pointsplat_ns.nerfstudio_plugin.rasterizer_options.rasterization"
    with mock.patch(place, recorded), torch.no_grad():
        for index in (0, 1):
            pipeline.model.losses(index, [next(pipeline.datamanager.held_out(index))])
    assert modes == [("classic", 3), ("antialiased", 1)]


OTHERS = ({"size": "small"}, {"encoder": "concat"}, {"use_position": False}, {"norm": "batch"})


@pytest.mark.parametrize("other", OTHERS, ids=str)
def test_weights_of_another_network_are_refused(trained, trained_walls, other):
    state = torch.load(next(trained[0].get_checkpoint_dir().iterdir()), weights_only=True)["pipeline"]
    with pytest.raises(SceneError, match="does not hold a network of size .* with encoder .*, use_appearance"):
        pipeline_of(trained_walls, **other).load_pipeline(state, 9)


def test_a_mask_hides_what_it_covers_from_the_loss(trained_walls):
    pipeline = pipeline_of(trained_walls)
    camera, data = next(pipeline.datamanager.held_out(0))
    mask = torch.zeros((48, 64, 1), dtype=torch.bool)
    with torch.no_grad():
        assert float(pipeline.model.losses(0, [(camera, {**data, "mask": mask})])[1]["l1"]) == 0
        assert float(pipeline.model.losses(0, [(camera, data)])[1]["l1"]) > 0


def test_lpips_is_part_of_the_loss_where_it_can_be_had(trained_walls, some_lpips):
    pipeline = pipeline_of(trained_walls, lpips_weight=0.1, lpips_net="alex").train()
    frame = next(pipeline.datamanager.held_out(0))
    _, losses, _ = pipeline.model.losses(0, [frame])
    sum(losses.values()).backward()
    assert all(p.grad.isfinite().all() for p in pipeline.model.refiner.parameters() if p.grad is not None)
    if not some_lpips:
        assert set(losses) == {"l1"} and "no network" in pipeline.model.loss.no_lpips_reason
        return
    with torch.no_grad():
        outputs = pipeline.model.draw(pipeline.model.pruned_scene(0).pruned, pipeline.datamanager.scenes[0], frame[0])
        expected = 0.1 * load_lpips("alex")(outputs["rgb"], frame[1]["image"] / 255)
    assert float(losses["lpips"]) == pytest.approx(float(expected), rel=1e-4)  # float32 sums in another order
    assert not any("lpips" in name for name in pipeline.state_dict())


def test_what_is_shown_follows_the_weights(trained, trained_walls):
    pipeline = pipeline_of(trained_walls)
    model = pipeline.model

    def shown_is_current() -> bool:
        with torch.no_grad():
            return same(model.eval().gaussians, model.refiner(model.pruned_scene(0).pruned))

    untrained = model.gaussians
    assert shown_is_current()
    optimizer = torch.optim.SGD(model.refiner.parameters(), lr=10.0)
    _, losses, _ = pipeline.train().get_train_loss_dict(0)
    losses["l1"].backward()
    optimizer.step()
    assert shown_is_current() and not same(model.gaussians, untrained)
    state = torch.load(next(trained[0].get_checkpoint_dir().iterdir()), weights_only=True)["pipeline"]
    stepped = model.gaussians
    pipeline.load_pipeline(state, 9)
    assert shown_is_current() and not same(model.gaussians, stepped)
