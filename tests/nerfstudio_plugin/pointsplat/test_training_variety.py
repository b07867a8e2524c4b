"""What makes a training vary (budgets, transforms, rates that fit), and pruned scenes kept on disk."""

import math

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import equal, move_zero_layers, small_config
from pointsplat_ns.compression.trained_refiner import load_refiner
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES
from pointsplat_ns.nerfstudio_plugin.pointsplat.losses import PIXEL_LOSSES
from pointsplat_ns.nerfstudio_plugin.pointsplat.pruned_scenes import PrunedKey, read_pruned, stored_path, write_pruned
from pointsplat_ns.pruning import PruneSettings


def test_one_network_learns_at_several_budgets_and_shows_the_first(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 12, more_keeps=(0.25, 40.0))
    pipeline = config.pipeline.setup(device="cpu", test_mode="val").train()
    model, cache = pipeline.model, pipeline.datamanager.cache

    def met(keep: float) -> bool:
        return any(cache.get(PrunedKey(s.name, model.config.prune_settings(keep))) for s in model.scenes)

    for step in range(40):
        pipeline.get_train_loss_dict(step)
        if all(met(keep) for keep in (0.5, 0.25, 40.0)):
            break
    assert step < 39
    assert len(model.eval().refine(0)) == round(0.5 * len(model.scenes[0].read_dense()))


def test_transforms_change_what_the_network_sees_and_nothing_else(trained_walls, tmp_path):
    """While residuals are zero, as at the beginning, the loss is the same."""

    def losses(augment: bool) -> list[float]:
        config = small_config(trained_walls, tmp_path, 3, augment=augment)
        pipeline = config.pipeline.setup(device="cpu", test_mode="val").train()
        zero = float(pipeline.get_train_loss_dict(1)[1]["l1"].detach())
        torch.manual_seed(3)
        move_zero_layers(pipeline.model.refiner)
        return [zero, float(pipeline.get_train_loss_dict(1)[1]["l1"].detach())]

    plain, moved, again = losses(False), losses(True), losses(True)
    assert moved[0] == pytest.approx(plain[0], rel=1e-4)  # undoing a transform rounds: thresholds flip in few pixels
    assert moved[1] != plain[1]
    assert moved == again, "the same seed draws the same transforms"


@pytest.mark.parametrize(
    "changes", [{"use_appearance": False, "use_position": False}, {"encoder": "concat"}, {"norm": "batch"}], ids=str
)
def test_each_network_trains_and_its_run_opens_again(trained_walls, run_training, tmp_path, no_lpips, changes):
    config = small_config(trained_walls, tmp_path, 2, **changes)
    trainer, losses = run_training(config)
    refiner = trainer.pipeline.model.refiner
    assert len(losses) == 2 and trainer.pipeline.training_state.skipped.total() == 0
    again = eval_setup(config.get_base_dir() / "config.yml")[1]
    for opened in (load_refiner(config.get_base_dir()).network, again.model.refiner):
        assert opened.config == refiner.config and equal(opened.state_dict(), refiner.state_dict())
    settings = again.get_average_eval_image_metrics()["settings"]
    assert all(settings[name] == value for name, value in changes.items())


def test_pruned_scenes_are_taken_from_the_folder(trained_walls, tmp_path, monkeypatch):
    def pruned(**changes):
        config = small_config(trained_walls, tmp_path, 1, pruned_folder=tmp_path / "pruned", **changes)
        return config.pipeline.setup(device="cpu", test_mode="test").model.pruned_scene(0)

    first = pruned()
    files = sorted((tmp_path / "pruned").iterdir())
    assert len(files) == 1 and files[0].suffix == ".safetensors"
    with monkeypatch.context() as patch:
        patch.setattr(PruneSettings, "prune", lambda *a, **k: pytest.fail("pruned again"))
        second = pruned()
    assert all(torch.equal(a, b) for a, b in zip(first.pruned.tensors(), second.pruned.tensors(), strict=True))
    assert (first.dense_count, first.seconds) == (second.dense_count, second.seconds)
    assert len(pruned(keep=0.25).pruned) < len(first.pruned)  # another budget is another file
    assert len(list((tmp_path / "pruned").iterdir())) == 2


def test_files_of_pruned_scenes_that_are_damaged_or_of_another_kind_say_so(tmp_path):
    from safetensors.torch import save_file

    scene = Gaussians.empty(sh_degree=1).replace(antialiased=True)
    path = stored_path(tmp_path, "room", "a5" * 32, PruneSettings(0.5, "paper"))
    write_pruned(path, scene, 7, 0.25)
    found, count, seconds = read_pruned(path)
    assert (len(found), found.sh_degree, found.antialiased, count, seconds) == (0, 1, True, 7, 0.25)
    path.write_bytes(path.read_bytes()[:-3] + b"x")
    with pytest.raises(SceneError, match="not a readable pruned scene"):
        read_pruned(path)
    save_file({"means": torch.zeros(1, 3)}, path)
    with pytest.raises(SceneError, match="format None; expected 'pointsplat-pruned/1'"):
        read_pruned(path)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0])
@pytest.mark.parametrize("name", sorted(PIXEL_LOSSES))
def test_pixel_losses_at_extremes(name, scale):
    """Value and gradient in float32 against float64; nothing differs, next to nothing differs, everything differs."""
    signs = torch.tensor([1.0, -1.0, 0.5]).repeat(16).reshape(4, 4, 3)
    found, exact = ((signs.to(dtype) * scale).requires_grad_() for dtype in (torch.float32, torch.float64))
    values = [PIXEL_LOSSES[name](difference) for difference in (found, exact)]
    for value in values:
        value.backward()
    assert values[0].item() == pytest.approx(values[1].item(), rel=1e-5, abs=1e-9)
    assert found.grad.isfinite().all()
    assert torch.allclose(found.grad.double(), exact.grad, rtol=1e-4, atol=1e-7)


def test_the_factor_multiplies_every_rate_and_is_a_positive_number(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 1)
    config.rate_factor = 3.0
    trainer = config.setup(local_rank=0, world_size=1)
    for name, group in trainer.config.optimizers.items():
        assert group["optimizer"].lr == pytest.approx(3 * REFINER_RATES[name])
    assert config.optimizers["encoder"]["optimizer"].lr == REFINER_RATES["encoder"], "the config given is left as it is"
    for config.rate_factor in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(PointSplatError, match="--rate-factor"):
            config.setup(local_rank=0, world_size=1)
