"""What makes a training vary (budgets, transforms, rates that fit)."""

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import move_zero_layers, small_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES


def test_one_network_learns_at_several_budgets_and_shows_the_first(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 12, more_keeps=(0.25, 40.0))
    pipeline = config.pipeline.setup(device="cpu", test_mode="val").train()
    model, cache = pipeline.model, pipeline.datamanager.cache

    def met(keep: float) -> bool:
        return any(cache.get(("pruned", s.name, model.config.prune_settings(keep))) for s in model.scenes)

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


def test_the_factor_multiplies_every_rate(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 1)
    config.rate_factor = 3.0
    trainer = config.setup(local_rank=0, world_size=1)
    for name, group in trainer.config.optimizers.items():
        assert group["optimizer"].lr == pytest.approx(3 * REFINER_RATES[name])
    assert config.optimizers["encoder"]["optimizer"].lr == REFINER_RATES["encoder"], "the config given is left as it is"
