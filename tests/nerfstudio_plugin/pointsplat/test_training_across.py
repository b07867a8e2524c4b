"""Training across scenes without photos: dense supervision, exact resuming, accumulation, rates and schedules."""

from __future__ import annotations

import copy
import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import box_room
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io import write_ply
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import RATES, pointsplat_config


def config_of(data: Path, output_dir: Path, steps: int):
    """The method as registered, tiny, on tiny pictures, without LPIPS."""
    config = pointsplat_config()
    config.machine.device_type, config.experiment_name = "cpu", "refiner"
    config.output_dir, config.max_num_iterations, config.steps_per_eval_image = output_dir, steps, 3
    config.pipeline.datamanager.data = config.data = data
    config.pipeline.datamanager.sampled_poses, config.pipeline.datamanager.sampled_size = 6, (48, 36)
    model = config.pipeline.model
    model.size, model.keep, model.by, model.lpips_weight = "tiny", 0.4, "paper", 0.0
    config.set_timestamp()
    return config


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    """A folder of three PLY files and nothing else."""
    folder = tmp_path_factory.mktemp("rooms")
    for seed in range(3):
        write_ply(box_room(seed, size=0.12, smooth=True), folder / f"room{seed}.ply")
    return folder


@pytest.fixture(scope="module")
def trained(rooms, run_training, tmp_path_factory):
    """A short training on two of the rooms: its config and trainer."""
    config = config_of(rooms, tmp_path_factory.mktemp("refined"), steps=16)
    for group in config.optimizers.values():
        group["optimizer"].lr *= 10  # tests take few steps
    config.pipeline.datamanager.eval_scenes = ("room2",)
    trainer, _ = run_training(config)
    return config, trainer


# dense supervision


def test_a_folder_of_ply_files_trains_the_refiner(trained, no_lpips):
    config, trainer = trained
    pipeline = trainer.pipeline
    report = pipeline.get_average_eval_image_metrics()
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert report["supervision"] == "dense" and report["reference"] == "dense renders"
    for name, block in report["scenes"].items():
        assert block["reference"] == "dense renders" and block["views"] == 1
        assert block["seen_in_training"] == (name != "room2")
        assert block["dense"]["psnr"] is None or block["dense"]["psnr"] > 100, "it is the reference: float32 noise"
        # dB; 16 steps give the training scenes 1.5 or more
        assert block["refined"]["psnr"] > block["pruned"]["psnr"] + (0.5 if name != "room2" else 0.0)


def test_the_evaluation_of_the_saved_run_is_that_of_the_training(trained, no_lpips):
    from nerfstudio.utils.eval_utils import eval_setup

    config, trainer = trained
    opened = eval_setup(config.get_base_dir() / "config.yml")[1].get_average_eval_image_metrics()
    assert opened["scenes"]["room2"]["seen_in_training"] is False
    assert opened["psnr"] == trainer.pipeline.get_average_eval_image_metrics()["psnr"]


def test_ns_export_writes_the_refined_scene_of_a_ply(trained, tmp_path):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    from pointsplat_ns.io import read_ply

    config, trainer = trained
    ExportGaussianSplat(load_config=config.get_base_dir() / "config.yml", output_dir=tmp_path).main()
    written, expected = read_ply(tmp_path / "splat.ply"), trainer.pipeline.eval().model.gaussians
    assert len(written) == len(expected) and torch.equal(written.means, expected.means)
    assert trainer.pipeline.datamanager.scenes[trainer.pipeline.model.shown].name == "room2"


def test_no_mean_mixes_photos_and_dense_renders(trained_walls, rooms, tmp_path, no_lpips):
    shutil.copytree(trained_walls, tmp_path / "all")
    shutil.copy(rooms / "room0.ply", tmp_path / "all")
    config = config_of(tmp_path / "all", tmp_path, 1)
    config.pipeline.datamanager.supervision = "dense"
    report = config.pipeline.setup(device="cpu", test_mode="test").eval().get_average_eval_image_metrics(get_std=True)
    json.dumps(report, allow_nan=False)
    scenes, other = report["scenes"], report["against_dense_renders"]
    references = {name: block["reference"] for name, block in scenes.items()}
    assert references == {"wall-a": "photos", "wall-b": "photos", "room0": "dense renders"}
    walls = [scenes[name]["refined"]["psnr"] for name in ("wall-a", "wall-b")]
    assert report["reference"] == "photos" and report["psnr"] == pytest.approx(sum(walls) / 2)
    assert other["reference"] == "dense renders" and other["psnr"] == scenes["room0"]["refined"]["psnr"]
    assert report["average"]["refined"]["psnr"] == report["psnr"] and "scenes" not in other


def test_the_loss_is_against_the_dense_scene_even_where_there_are_photos(trained_walls):
    config = config_of(trained_walls, Path("unused"), 1)
    config.pipeline.model.keep = 1.0
    losses = {}
    for supervision in ("photos", "dense"):
        config.pipeline.datamanager.supervision = supervision
        pipeline = config.pipeline.setup(device="cpu", test_mode="val")
        losses[supervision] = float(pipeline.get_train_loss_dict(0)[1]["l1"].detach())
    # an untrained refiner that keeps all is the dense scene, but for the rounding of its renders to 8 bits
    assert losses["dense"] < 0.5 / 255 and losses["photos"] > 5 / 255


def test_pruned_scenes_are_kept_within_the_bound_and_made_again_alike(rooms):
    config = config_of(rooms, Path("unused"), 1)
    config.pipeline.datamanager.cache_gigabytes = 0.0
    none_kept = config.pipeline.setup(device="cpu", test_mode="test").model
    config.pipeline.datamanager.cache_gigabytes = 0.05
    pipeline = config.pipeline.setup(device="cpu", test_mode="test")
    kept = pipeline.model
    first = [kept.pruned_scene(index) for index in range(3)]
    again = [none_kept.pruned_scene(index) for index in (0, 1, 2, 0)]
    assert all(kept.pruned_scene(index) is first[index] for index in range(3))
    assert again[3] is not again[0] and none_kept.pruned_scene(0) is again[3], "the latest is there in any case"
    for one, other in ((again[3], again[0]), (again[1], first[1])):
        assert all(torch.equal(a, b) for (_, a), (_, b) in zip(one.pruned.items(), other.pruned.items(), strict=True))
    structures = first[0].structure
    smallest = structures.order.numel() * 8 + sum(v.numel() * 4 for _, v in first[0].pruned.items())
    assert pipeline.datamanager.cache.num_bytes > 3 * smallest, "neighbour tables count, too"


# resuming


@pytest.mark.parametrize(("stop", "accumulate", "schedule"), [(4, 3, "step"), (3, 1, "cosine")])
def test_an_interrupted_training_has_the_losses_of_an_unbroken_one(
    rooms, run_training, tmp_path, stop, accumulate, schedule
):
    def config(name, steps):
        changed = config_of(rooms, tmp_path / name, steps)
        changed.gradient_accumulation_steps, changed.schedule = {"all": accumulate}, schedule
        changed.steps_per_save, changed.save_only_latest_checkpoint = stop, False
        return changed

    whole, losses = run_training(config("whole", 8))
    assert len(set(losses)) == 8
    rest = config("rest", 8 - stop - 1)
    rest.load_dir, rest.load_step = whole.checkpoint_dir, stop
    resumed, last_losses = run_training(rest)
    assert last_losses == losses[stop + 1 :]
    for name, value in whole.pipeline.model.refiner.state_dict().items():
        assert torch.equal(resumed.pipeline.model.refiner.state_dict()[name], value), name
    rates = [t.optimizers.optimizers["means"].param_groups[0]["lr"] for t in (whole, resumed)]
    assert rates[0] == rates[1]
    state = torch.load(whole.checkpoint_dir / f"step-{stop:09d}.ckpt", weights_only=True)["pipeline"]["_extra_state"]
    assert ("gradients" in state) == (accumulate == 3), "only gradients that wait for their update are saved"


def test_dropped_paths_and_shuffled_curves_are_those_of_an_unbroken_training(rooms):
    pipeline = config_of(rooms, Path("unused"), 1).pipeline.setup(device="cpu", test_mode="val").train()
    blocks = [m for m in pipeline.model.refiner.modules() if hasattr(m, "drop_path")]
    for block in blocks:
        block.drop_path = 0.5
    for parameter in pipeline.model.refiner.heads.parameters():  # or residuals are zero, whatever is dropped
        torch.nn.init.normal_(parameter, std=0.05)
    first = [float(pipeline.get_train_loss_dict(step)[1]["l1"].detach()) for step in (0, 3, 6, 3)]
    torch.manual_seed(99)
    assert float(pipeline.get_train_loss_dict(3)[1]["l1"].detach()) == first[1] == first[3]
    with mock.patch.object(pipeline.config.datamanager, "seed", 1), torch.random.fork_rng():
        index, frames = pipeline.datamanager.next_train(3)
        torch.manual_seed(5)
        assert float(pipeline.model.losses(index, frames)[1]["l1"].detach()) != first[3], "proves too little"


# steps that are not finite


@contextmanager
def broken(kind: str, steps: set[int]) -> Iterator[None]:
    """Within, these training steps have a photo of NaN or of infinity, or a gradient of NaN with a finite loss."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManager
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline

    next_train, losses_of = ScenesDataManager.next_train, PointSplatPipeline.get_train_loss_dict

    def photos(self, step):
        scene, frames = next_train(self, step)
        if step in steps and kind != "gradient":
            value = {"nan": math.nan, "infinite": math.inf}[kind]
            frames = [(camera, {**data, "image": torch.full((36, 48, 3), value)}) for camera, data in frames]
        return scene, frames

    def losses(self, step):
        outputs, losses, metrics = losses_of(self, step)
        if step in steps and kind == "gradient":
            weight = self.model.refiner.heads.mlps["scales"][-1].weight
            losses["l1"] = losses["l1"] + 0 * (0 * weight.sum()).sqrt()  # a root's slope at 0, times 0
            assert losses["l1"].isfinite()
        return outputs, losses, metrics

    with (
        mock.patch.object(ScenesDataManager, "next_train", photos),
        mock.patch.object(PointSplatPipeline, "get_train_loss_dict", losses),
    ):
        yield


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


def equal(a, b) -> bool:
    """Whether nested dicts of tensors are equal to the bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[name], b[name]) for name in a)
    return torch.equal(a, b)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("nan", "the l1 loss is nan"),
        ("infinite", "the l1 loss is inf"),
        ("gradient", "the gradient of the scales is not finite"),
    ],
)
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(rooms, tmp_path, kind, said):
    config = config_of(rooms, tmp_path, 4)
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


@pytest.mark.parametrize("kind", ["nan", "gradient"])
@pytest.mark.parametrize("bad", [0, 1])
def test_a_skipped_step_is_left_out_of_the_mean_of_accumulated_gradients(rooms, tmp_path, kind, bad):
    config = constant(config_of(rooms, tmp_path, 2))
    _, alone = step_by_step(config, [1 - bad])
    config.gradient_accumulation_steps = {"all": 2}
    with broken(kind, {bad}):
        _, pair = step_by_step(config, range(2))
    assert equal(pair[1][0], alone[0][0]) and equal(pair[1][1], alone[0][1])
    assert not equal(pair[1][0], pair[0][0])


def test_where_all_accumulated_steps_are_skipped_there_is_no_update(rooms, tmp_path):
    config = constant(config_of(rooms, tmp_path, 4))
    config.gradient_accumulation_steps = {"all": 2}
    with broken("nan", {0, 1}):
        _, history = step_by_step(config, range(4))
    assert all(not state for state in history[1][1].values()) and all(history[3][1].values())
    assert equal(history[2][0], history[0][0]) and not equal(history[3][0], history[0][0])


def test_a_gradient_scaler_deals_with_its_own_overflows_and_changes_nothing_else(rooms, tmp_path):
    config = config_of(rooms, tmp_path, 6)
    config.gradient_accumulation_steps = {"all": 2}
    _, history = step_by_step(config, range(4))
    with mock.patch("nerfstudio.engine.trainer.GradScaler", lambda enabled: torch.amp.GradScaler("cpu", 1024.0)):
        trainer, scaled = step_by_step(config, range(4))
        for (name, value), wanted in zip(scaled[3][0].items(), history[3][0].values(), strict=True):
            # scaled by a power of two: what differs are rounded subnormals, which Adam's first steps enlarge
            torch.testing.assert_close(value, wanted, rtol=1e-3, atol=1e-6, msg=name)
        with broken("gradient", {1}):
            trainer, scaled = step_by_step(config, range(4))
    assert trainer.grad_scaler.get_scale() == 512.0 and trainer.pipeline.training_state.skipped.total() == 0
    assert equal(scaled[1][0]["heads.mlps.scales.6.weight"], torch.zeros(3, 64)), "the part that overflowed stays"
    assert not equal(scaled[3][0], scaled[1][0])


@pytest.mark.parametrize(("stop", "accumulate"), [(4, 3), (4, 1)])
def test_an_interrupted_training_skips_as_an_unbroken_one(rooms, run_training, tmp_path, stop, accumulate):
    def config(name, steps):
        changed = config_of(rooms, tmp_path / name, steps)
        changed.gradient_accumulation_steps = {"all": accumulate}
        changed.steps_per_save, changed.save_only_latest_checkpoint = stop, False
        return changed

    with broken("nan", {1, 4, 6}):  # of three updates over three steps, two are the mean of fewer
        whole, losses = run_training(config("whole", 8))
        rest = config("rest", 8 - stop - 1)
        rest.load_dir, rest.load_step = whole.checkpoint_dir, stop
        resumed, last_losses = run_training(rest)
    assert [math.isnan(loss) for loss in losses] == [step in (1, 4, 6) for step in range(8)]
    assert str(last_losses) == str(losses[stop + 1 :])
    assert (
        whole.pipeline.training_state.skipped == resumed.pipeline.training_state.skipped
        and whole.pipeline.training_state.skipped.total() == 3
    )
    assert equal(whole.pipeline.model.refiner.state_dict(), resumed.pipeline.model.refiner.state_dict())


def test_after_too_many_skipped_steps_training_stops_and_names_the_scenes(rooms, run_training, tmp_path):
    config = config_of(rooms, tmp_path, 50)
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
    rest = config_of(rooms, tmp_path / "rest", 2)
    rest.load_dir, rest.max_skipped_steps = config.get_checkpoint_dir(), 4
    resumed, losses = run_training(rest)
    assert len(losses) == 2 and resumed.pipeline.training_state.skipped.total() == 4
    rest.max_skipped_steps = -1
    with pytest.raises(PointSplatError, match="--max-skipped-steps -1: expected at least 0"):
        rest.setup(local_rank=0, world_size=1).setup()


def test_the_count_of_a_scene_that_is_gone_is_gone(rooms):
    pipeline = config_of(rooms, Path("unused"), 1).pipeline.setup(device="cpu", test_mode="val")
    pipeline.set_extra_state({"trained_on": [], "skipped": {"room1": 3, "cellar": 8}})
    assert pipeline.training_state.skipped == {"room1": 3}
    pipeline.set_extra_state({"trained_on": []})  # a checkpoint of an earlier version
    assert pipeline.training_state.skipped.total() == 0


# accumulation, rates, schedules


def test_accumulated_gradients_are_averaged_before_they_are_clipped(rooms, run_training, tmp_path):
    pipeline = config_of(rooms, Path("unused"), 1).pipeline.setup(device="cpu", test_mode="val").train()
    for step in range(2):
        (0.5 * pipeline.get_train_loss_dict(step)[1]["l1"]).backward()
    means = {n: [p.grad for p in group] for n, group in pipeline.get_param_groups().items() if n != "encoder"}
    norms = {n: float(torch.cat([g.reshape(-1) for g in grads]).norm()) for n, grads in means.items()}
    assert min(norms["means"], norms["scales"]) > 1e-5, "proves too little"
    config = config_of(rooms, tmp_path, 2)
    config.gradient_accumulation_steps = {"all": 2}
    factors = dict.fromkeys(norms, 1.5) | {
        "scales": 0.5
    }  # of the mean's norm: above it, but below the sum's; and below
    for name, factor in factors.items():
        config.optimizers[name]["optimizer"].max_norm = factor * norms[name]
    trainer, _ = run_training(config)
    groups = trainer.pipeline.get_param_groups()
    for name, grads in means.items():
        for p, mean in zip(groups[name], grads, strict=True):
            wanted = mean * min(1.0, factors[name])
            # float32: a half taken before the sum, and after it; the norm itself is float32
            torch.testing.assert_close(p.grad, wanted, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("steps", [{"hands": 2}, {"encoder": 0}])
def test_an_accumulation_that_means_nothing_is_refused_and_leaves_no_folder(rooms, tmp_path, steps):
    config = config_of(rooms, tmp_path / "outputs", 1)
    config.gradient_accumulation_steps = steps
    config.save_config()
    with pytest.raises(PointSplatError, match="--gradient-accumulation-steps .*expected all or one of encoder"):
        config.setup(local_rank=0, world_size=1).setup()
    assert not (tmp_path / "outputs").exists()


def fitted_of(config):
    with mock.patch.object(config, "_target", lambda fitted, **_: fitted):
        return config.setup().optimizers


def test_published_rates_are_taken_but_for_what_was_set_by_hand():
    config = pointsplat_config()
    assert {n: g["optimizer"].lr for n, g in fitted_of(config).items()} == RATES
    config.optimizers["backbone"]["optimizer"].lr = 7e-4
    expected = {"paper": dict.fromkeys(RATES, 1e-5), "authors": dict.fromkeys(RATES, 3e-5)}
    expected["authors"] |= {"means": 1e-5, "scales": 1e-5, "quats": 1e-5, "features_rest": 1e-6}
    for config.rates in ("paper", "authors"):
        fitted = fitted_of(config)
        assert {n: g["optimizer"].lr for n, g in fitted.items()} == expected[config.rates] | {"backbone": 7e-4}
        assert all(g["optimizer"].eps == 1e-15 and g["optimizer"].max_norm == 2.0 for g in fitted.values())


@pytest.mark.parametrize("steps", [1, 10, 10_000])
def test_the_step_schedule_divides_by_ten_at_sixty_percent(steps):
    config = config_of(Path("unused"), Path("unused"), steps)
    config.schedule = "step"
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1e-5)
    schedule = fitted_of(config)["encoder"]["scheduler"].setup().get_scheduler(optimizer, 1e-5)
    rates = []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step(), schedule.step()
    at = max(1, round(0.6 * steps))
    assert rates[:at] == [1e-5] * at
    assert all(math.isclose(rate, 1e-6, rel_tol=1e-9) for rate in rates[at:])


def test_processes_that_are_not_connected_are_refused(rooms):
    config = config_of(rooms, Path("unused"), 1)
    with pytest.raises(SceneError, match="2 processes are asked for and 1 are connected"):
        config.pipeline.setup(device="cpu", test_mode="val", world_size=2)
