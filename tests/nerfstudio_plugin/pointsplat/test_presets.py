"""The methods pointsplat-paper and pointsplat-authors against their sources, and trained for two
steps."""

from functools import reduce
from unittest import mock

import pytest
import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import equal, small_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.presets import authors_config, paper_config
from pointsplat_ns.pipeline.trained_refiner import load_refiner
from pointsplat_ns.refinement import Refiner
from pointsplat_ns.refinement.weights import read_metadata
from pointsplat_ns.scene.runs import RUN_FILES

pytestmark = pytest.mark.usefixtures("quick")

PRESETS = {"paper": paper_config, "authors": authors_config}

# The paper's text and what is known of the released code, read independently of presets.py.
FIELDS = {
    "max_num_iterations": (10_000, 10_000),
    "schedule": ("step", "step"),
    "drop_at": (0.6, 0.7),
    "global_norm": (None, 2.0),
    "rate_factor": (1.0, 1.0),
    "pipeline.datamanager.images_per_step": (2, 2),
    "pipeline.model.by": ("paper", "authors"),
    "pipeline.model.keep": ("30%", "30%"),
    "pipeline.model.raw_inputs": (True, True),
    "pipeline.model.norm": ("batch", "batch"),
    "pipeline.model.enc_depths": (None, (2, 2, 2, 6, 2)),
    "pipeline.model.stem": ("conv", "linear"),
    "pipeline.model.means_reach": (1.0, 1.0),
    "pipeline.model.train_encoder": (True, False),
    "pipeline.model.lpips_weight": (0.1, 0.1),
    "pipeline.model.lpips_net": ("vgg", "vgg"),
}

BY_PART = {  # learning rates; the released optimiser does not have the encoder
    **dict.fromkeys(("encoder", "backbone", "opacities", "features_dc"), (1e-5, 3e-5)),
    **dict.fromkeys(("means", "scales", "quats"), (1e-5, 1e-5)),
    "features_rest": (1e-5, 1e-6),
}


@pytest.mark.parametrize(("name", "column"), [("paper", 0), ("authors", 1)])
def test_each_field_of_a_preset_is_that_of_its_source(name, column):
    config = PRESETS[name]()
    found = {path: reduce(getattr, path.split("."), config) for path in FIELDS}
    assert found == {path: values[column] for path, values in FIELDS.items()}
    trainer = config.setup(local_rank=0, world_size=1)  # applies rates
    optimizers = {part: group["optimizer"] for part, group in trainer.config.optimizers.items()}
    assert {part: optimizer.lr for part, optimizer in optimizers.items()} == {
        p: v[column] for p, v in BY_PART.items()
    }
    assert {(o.eps, o.max_norm, o.weight_decay) for o in optimizers.values()} == {
        ((1e-8, 1e-15)[column], None, 0)
    }


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_trains_and_its_run_and_weights_open_again(
    trained_walls, run_training, tmp_path, no_lpips, name
):
    config = PRESETS[name]()
    config.machine.device_type = "cpu"
    config.output_dir = tmp_path
    config.max_num_iterations = 2
    config.experiment_name = "refiner"
    config.pipeline.datamanager.data = trained_walls
    config.pipeline.model.size = "tiny"
    config.pipeline.model.enc_depths = None if name == "paper" else (1, 2, 1)
    config.set_timestamp()
    started = []
    build = Refiner.__init__

    def recorded(self, *arguments, **options):
        build(self, *arguments, **options)
        started.append({key: value.clone() for key, value in self.named_parameters()})

    with mock.patch.object(Refiner, "__init__", recorded):
        trainer, losses = run_training(config)
    refiner = trainer.pipeline.model.refiner
    assert len(losses) == 2 and not trainer.skipped
    assert "vgg" in trainer.pipeline.model.no_lpips_reason.lower(), "it says that LPIPS is left out"
    moved = {
        key.split(".")[0]
        for key, value in refiner.named_parameters()
        if not torch.equal(value, started[0][key])
    }
    assert moved == ({"encoder"} if name == "paper" else set()) | {"backbone", "heads"}
    untrained = [key for key, value in refiner.named_parameters() if value.grad is None]
    assert all(key.startswith("encoder.") for key in untrained) and bool(untrained) == (
        name == "authors"
    )
    assert set(BY_PART) - set(trainer.optimizers.optimizers) == (
        set() if name == "paper" else {"encoder"}
    )
    trainer.config.max_num_iterations = 10_000
    drop = {"paper": 6000, "authors": 7000}[name]
    factor = trainer.optimizers.schedulers["means"].lr_lambdas[0]
    assert [factor(step) for step in (0, drop - 1, drop, 9999)] == [1.0, 1.0, 0.1, 0.1]
    assert config.get_base_dir().parts[-2] == f"pointsplat-{name}"
    with mock.patch.dict(all_methods, {config.method_name: PRESETS[name]()}):
        again = eval_setup(config.get_base_dir() / "config.yml")[1]
    weights = config.get_base_dir() / RUN_FILES.refiner
    for opened in (
        load_refiner(config.get_base_dir()).network,
        load_refiner(weights).network,
        again.model.refiner,
    ):
        assert opened.config == refiner.config and equal(opened.state_dict(), refiner.state_dict())
    about = read_metadata(weights)
    assert all(
        about[key] == getattr(config, key) for key in ("method_name", "drop_at", "global_norm")
    )
    assert about["train_encoder"] == (name == "paper")


def test_one_norm_limits_all_gradients_together(trained_walls, tmp_path):
    config = small_config(trained_walls, tmp_path, 2)
    config.global_norm = 1e-3
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    assert {group["optimizer"].max_norm for group in trainer.config.optimizers.values()} == {None}
    parameters = [p for group in trainer.pipeline.model.get_param_groups().values() for p in group]
    for number, parameter in enumerate(parameters):
        parameter.grad = torch.full_like(parameter, number)
    total = torch.cat([p.grad.flatten() for p in parameters]).norm()
    trainer.update(0, skipped=False)
    for number, parameter in enumerate(parameters):
        torch.testing.assert_close(
            parameter.grad, torch.full_like(parameter, number * 1e-3 / total), rtol=1e-3, atol=0
        )
