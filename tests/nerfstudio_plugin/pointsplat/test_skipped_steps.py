"""Training steps whose loss or gradients are not finite are skipped, counted, and too many stop the training."""

import copy
from pathlib import Path
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from broken_steps import broken
from making import dense_config, equal
from pointsplat_ns.errors import PointSplatError, SceneError


def constant(config):
    """The config without schedules: what an update does then depends on its gradients alone."""
    for group in config.optimizers.values():
        group["scheduler"] = None
    return config


def step_by_step(config, steps):
    """A trainer, and after each of the steps its weights with running statistics, its optimisers' state, metrics."""
    torch.manual_seed(1)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    history = []
    for step in steps:
        _, _, metrics = trainer.pipeline.train() and trainer.train_iteration(step)
        optimizers = {name: o.state_dict()["state"] for name, o in trainer.optimizers.optimizers.items()}
        history.append(copy.deepcopy((trainer.pipeline.model.refiner.state_dict(), optimizers, metrics)))
    return trainer, history


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("nan", "the l1 loss is nan"),
        ("infinite", "the l1 loss is inf"),
        ("gradient", "the gradient of the scales is not finite"),
    ],
)
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(three_rooms, tmp_path, kind, said):
    config = dense_config(three_rooms, tmp_path, 4)
    config.pipeline.model.norm = "batch"  # has running statistics
    with broken(kind, {1}), mock.patch("pointsplat_ns.nerfstudio_plugin.pointsplat.trainer.CONSOLE.log") as log:
        trainer, history = step_by_step(config, range(3))
    weights, states, metrics = zip(*history, strict=True)
    assert equal(weights[1], weights[0]) and equal(states[1], states[0])
    assert any("running" in name for name in weights[0])
    moved = [name for name in weights[0] if not torch.equal(weights[2][name], weights[1][name])]
    assert any("running" in name for name in moved) and any("heads" in name for name in moved)
    scene = trainer.pipeline.datamanager.scenes[metrics[1]["scene"]].name
    assert trainer.pipeline.training_state.skipped == {scene: 1} and [m["skipped_steps"] for m in metrics] == [0, 1, 1]
    text = f"step 1 is skipped: {scene}: {said} (1 skipped so far; more than 10 stop)"
    assert [call.args[0] for call in log.call_args_list if "skipped" in call.args[0]] == [text]
    assert all(schedule.last_epoch == 3 for schedule in trainer.optimizers.schedulers.values()), "it counts steps"


@pytest.mark.parametrize(("kind", "bad"), [("nan", 0), ("gradient", 1)])
def test_a_skipped_step_is_left_out_of_the_mean_of_accumulated_gradients(three_rooms, tmp_path, kind, bad):
    config = constant(dense_config(three_rooms, tmp_path, 2))
    _, alone = step_by_step(config, [1 - bad])
    config.gradient_accumulation_steps = {"all": 2}
    with broken(kind, {bad}):
        _, pair = step_by_step(config, range(2))
    assert equal(pair[1][0], alone[0][0]) and equal(pair[1][1], alone[0][1])
    assert not equal(pair[1][0], pair[0][0])


def test_after_too_many_skipped_steps_training_stops_and_names_the_scenes(three_rooms, run_training, tmp_path):
    config = dense_config(three_rooms, tmp_path, 50)
    config.max_skipped_steps = 3
    message = (
        r"training stopped at step 3: losses or gradients were not finite in 4 steps, which were skipped "
        r"\(room\d: 2, room\d: 1, room\d: 1\); .*lower the learning rates; .*--load-dir .*--max-skipped-steps than 3"
    )
    with broken("nan", set(range(50))), pytest.raises(SceneError, match=message) as caught:
        run_training(config)
    assert "\n" not in str(caught.value)
    saved = torch.load(config.get_checkpoint_dir() / "step-000000003.ckpt", weights_only=True)
    skipped = saved["pipeline"]["_extra_state"]["skipped"]
    assert sorted(skipped) == ["room0", "room1", "room2"] and sum(skipped.values()) == 4
    # what was done so far is kept, and can be gone on from where it is allowed
    rest = dense_config(three_rooms, tmp_path / "rest", 2)
    rest.load_dir, rest.max_skipped_steps = config.get_checkpoint_dir(), 4
    resumed, losses = run_training(rest)
    assert len(losses) == 2 and resumed.pipeline.training_state.skipped.total() == 4
    rest.max_skipped_steps = -1
    with pytest.raises(PointSplatError, match="--max-skipped-steps -1: expected at least 0"):
        rest.setup(local_rank=0, world_size=1).setup()


def test_the_count_of_a_scene_that_is_gone_is_gone(three_rooms):
    pipeline = dense_config(three_rooms, Path("unused"), 1).pipeline.setup(device="cpu", test_mode="val")
    pipeline.set_extra_state({"trained_on": [], "skipped": {"room1": 3, "cellar": 8}})
    assert pipeline.training_state.skipped == {"room1": 3}
