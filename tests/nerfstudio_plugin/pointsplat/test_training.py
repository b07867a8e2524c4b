"""Training, also with steps that are skipped."""

import copy
import shutil
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from broken_steps import broken
from making import dense_config, equal
from pointsplat_ns.errors import DataError
from pointsplat_ns.io import read_ply, write_ply
from pointsplat_ns.io.runs import RUN_FILES
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import MODEL_METADATA
from pointsplat_ns.refiner import read_refiner
from pointsplat_ns.refiner.weights import read_metadata


def test_the_checkpoint_holds_the_network_and_nothing_else(trained):
    config, trainer, _ = trained
    (path,) = config.get_checkpoint_dir().iterdir()
    state = torch.load(path, map_location="cpu", weights_only=True)
    refiner = trainer.pipeline.model.refiner
    names = {f"_model.refiner.{name}" for name in refiner.state_dict()}
    assert set(state["pipeline"]) == names | {"_model.device_indicator_param", "_extra_state"}
    assert [name.split("/")[0] for name in state["pipeline"]["_extra_state"]["trained_on"]] == ["wall-a"]
    assert all(torch.equal(state["pipeline"][f"_model.refiner.{n}"], v) for n, v in refiner.state_dict().items())
    parameters = sum(p.numel() for p in refiner.parameters())
    assert path.stat().st_size < 4 * 3 * parameters + 500_000, "three floats a parameter: itself and Adam's two"
    assert set(state["optimizers"]) == set(REFINER_RATES)
    trained_numbers = {p for g in trainer.optimizers.optimizers.values() for s in g.param_groups for p in s["params"]}
    assert trained_numbers == set(refiner.parameters()), "every parameter has a learning rate"


def test_the_network_is_saved_by_itself_at_the_end(trained):
    config, trainer, _ = trained
    path = config.get_base_dir() / RUN_FILES.refiner
    loaded = read_refiner(path).state_dict()
    expected = trainer.pipeline.model.refiner.state_dict()
    assert loaded.keys() == expected.keys() and all(torch.equal(loaded[n], v) for n, v in expected.items())
    about = read_metadata(path)
    model = {name: getattr(config.pipeline.model, name) for name in MODEL_METADATA}
    assert {name: about[name] for name in model} == {**model, "more_keeps": list(model["more_keeps"])}
    assert (about["steps"], about["scenes"], about["keep"], about["by"]) == (10, "wall-a", 0.5, "paper")
    assert (about["supervision"], about["rate_factor"]) == ("photos", config.rate_factor)
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000009.ckpt"]


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
        ("nan", "the loss l1 is nan"),
        ("gradient", "the gradient of the scales is not finite"),
    ],
)
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(three_rooms, tmp_path, kind, said):
    config = dense_config(three_rooms, tmp_path, 4)
    config.pipeline.model.norm = "batch"  # has running statistics
    with broken(kind, {1}), mock.patch("pointsplat_ns.nerfstudio_plugin.trainer.CONSOLE.log") as log:
        trainer, history = step_by_step(config, range(3))
    weights, states, metrics = zip(*history, strict=True)
    assert equal(weights[1], weights[0]) and equal(states[1], states[0])
    assert any("running" in name for name in weights[0])
    moved = [name for name in weights[0] if not torch.equal(weights[2][name], weights[1][name])]
    assert any("running" in name for name in moved) and any("heads" in name for name in moved)
    scene = trainer.pipeline.datamanager.scenes[metrics[1]["scene"]].name
    assert trainer.skipped == {scene: 1} and [m["skipped_steps"] for m in metrics] == [0, 1, 1]
    text = f"step 1 is skipped: {scene}: {said} (said once for each)"
    assert [call.args[0] for call in log.call_args_list if "skipped" in call.args[0]] == [text]
    assert all(schedule.last_epoch == 3 for schedule in trainer.optimizers.schedulers.values()), "it counts steps"


def test_losses_do_not_depend_on_what_stays_in_memory(three_rooms, run_training, tmp_path):
    results = []
    for gigabytes in (None, 0.0):
        config = dense_config(three_rooms, tmp_path / str(gigabytes), 7)
        config.pipeline.model.more_keeps = (0.3,)
        config.pipeline.datamanager.cache_gigabytes = gigabytes
        trainer, losses = run_training(config)
        results.append((losses, trainer.pipeline.model.refiner.state_dict()))
    assert results[0][0] == results[1][0] and equal(results[0][1], results[1][1])


def test_a_scene_that_cannot_be_used_ends_the_training_at_its_turn(three_rooms, run_training, tmp_path):
    shutil.copytree(three_rooms, tmp_path / "rooms")
    config = dense_config(tmp_path / "rooms", tmp_path / "outputs", 3)
    order = [config.pipeline.setup(device="cpu").datamanager.scene_at(step) for step in range(3)]
    path = tmp_path / "rooms" / f"room{order[-1]}.ply"
    scene = read_ply(path)
    scene.means.fill_(float("nan"))
    path.unlink()
    write_ply(scene, path)
    steps, losses = [], PointSplatModel.losses
    with (
        mock.patch.object(PointSplatModel, "losses", lambda *given: steps.append(given) or losses(*given)),
        pytest.raises(DataError, match=f"^{path}: "),
    ):
        run_training(config)
    assert 2 <= len(steps) <= 3
