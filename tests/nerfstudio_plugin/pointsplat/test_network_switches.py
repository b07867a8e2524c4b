"""The choices of the paper's Table 4, the concatenating baseline and the published norm, as settings of a training."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import small_config
from pointsplat_ns.compression.trained_refiner import load_refiner

POSITION = 3 * 32 + 32 + 32 * 32 + 32
APPEARANCE = 45 * 32 + 32 + 32 * 8 + 8 + 12 * 32 + 32 + 2 * 32 + 32 * 32 + 32
GEOMETRY = 10 * 32 + 32 + 2 * 32 + 32 * 32 + 32
CONCAT = (59 - 32) * (27 * 32 + 6 * 64)
"""What wider input costs: in the first convolution, of 27 cells, and in the first layer of six heads."""

NETWORKS = {
    "II": ({"use_appearance": False, "use_position": False}, -POSITION - APPEARANCE),
    "V": ({}, 0),
    "concat": ({"encoder": "concat"}, CONCAT - GEOMETRY - POSITION - APPEARANCE),
    "batch norm": ({"norm": "batch"}, 0),
}
"""Settings by row of Table 4, and parameters beside those of the whole network."""


@pytest.mark.parametrize("row", NETWORKS)
def test_each_network_trains_and_its_run_opens_again(trained_walls, run_training, tmp_path, no_lpips, row):
    changes, more = NETWORKS[row]
    config = small_config(trained_walls, tmp_path, 2, **changes)
    trainer, losses = run_training(config)
    refiner = trainer.pipeline.model.refiner
    assert len(losses) == 2 and trainer.pipeline.training_state.skipped.total() == 0
    assert sum(p.numel() for p in refiner.parameters()) == 664_563 + more
    again = eval_setup(config.get_base_dir() / "config.yml")[1]
    for opened in (load_refiner(config.get_base_dir()).network, again.model.refiner):
        assert opened.config == refiner.config
        wanted = refiner.state_dict()
        assert opened.state_dict().keys() == wanted.keys()
        assert all(torch.equal(value, wanted[name]) for name, value in opened.state_dict().items())
    settings = again.get_average_eval_image_metrics()["settings"]
    assert all(settings[name] == value for name, value in changes.items())
    assert {"encoder", "use_appearance", "use_position", "norm"} <= settings.keys()
