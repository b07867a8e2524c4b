"""The choices of the paper's Table 4, the concatenating baseline and the published norm, as settings of a training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import tyro
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import small_config
from pointsplat_ns.compression.trained_refiner import load_refiner
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.refiner import RefinerConfigError

POSITION = 3 * 32 + 32 + 32 * 32 + 32
APPEARANCE = 45 * 32 + 32 + 32 * 8 + 8 + 12 * 32 + 32 + 2 * 32 + 32 * 32 + 32
GEOMETRY = 10 * 32 + 32 + 2 * 32 + 32 * 32 + 32
CONCAT = (59 - 32) * (27 * 32 + 6 * 64)
"""What wider input costs: in the first convolution, of 27 cells, and in the first layer of six heads."""

NETWORKS = {
    "II": ({"use_appearance": False, "use_position": False}, -POSITION - APPEARANCE),
    "III": ({"use_appearance": False}, -APPEARANCE),
    "IV": ({"use_position": False}, -POSITION),
    "V": ({}, 0),
    "concat": ({"encoder": "concat"}, CONCAT - GEOMETRY - POSITION - APPEARANCE),
    "batch norm": ({"norm": "batch"}, 0),
}
"""Settings by row of Table 4 (I is the pruned scene), and parameters beside those of the whole network."""


def config_of(data: Path, output_dir: Path, **model):
    return small_config(data, output_dir, 2, **model)


@pytest.mark.parametrize("row", NETWORKS)
def test_each_network_trains_and_its_run_opens_again(trained_walls, run_training, tmp_path, no_lpips, row):
    changes, more = NETWORKS[row]
    config = config_of(trained_walls, tmp_path, **changes)
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


def test_a_run_that_says_another_network_than_its_weights_are_is_refused(make_refined_run, trained_walls, tmp_path):
    run = make_refined_run(tmp_path, trained_walls)
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(text.replace("use_position: true", "use_position: false"))
    with pytest.raises(SceneError, match="not a usable pointsplat checkpoint"):
        load_refiner(run)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder": "concat", "use_position": False}, "switches of the encoder 'dual'; encoder 'concat' expects both"),
        ({"encoder": "concat", "use_appearance": False}, "switches of the encoder 'dual'"),
        ({"norm": "group"}, "norm is 'group'; expected one of scene, batch, layer"),
    ],
)
def test_settings_that_describe_no_network_are_refused_and_leave_no_folder(trained_walls, tmp_path, changes, message):
    config = config_of(trained_walls, tmp_path / "outputs", **changes)
    config.save_config()
    with pytest.raises(RefinerConfigError, match=message):
        config.setup(local_rank=0, world_size=1).setup()
    assert not (tmp_path / "outputs").exists()


def test_weights_of_another_switch_are_refused_by_name(trained_walls):
    states = {
        row: config_of(trained_walls, Path("unused"), **NETWORKS[row][0]).pipeline.setup(device="cpu")
        for row in ("V", "IV", "batch norm")
    }
    for row in ("IV", "batch norm"):
        with pytest.raises(SceneError, match="does not hold a network of size tiny with encoder dual, use_appearance"):
            states["V"].load_pipeline(states[row].state_dict(), 1)


def test_the_command_line_reaches_every_switch():
    config = pointsplat_config()
    words = "--pipeline.model.use-appearance False --pipeline.model.use-position False --pipeline.model.norm batch"
    words += " --pipeline.model.encoder dual --max-skipped-steps 3"
    # as ns-train does: a bool takes its value in words
    wrapped = tyro.conf.FlagConversionOff[type(config)]
    parsed = tyro.cli(wrapped, default=config, args=words.split())
    model = parsed.pipeline.model
    assert (model.use_appearance, model.use_position, model.norm) == (False, False, "batch")
    assert parsed.max_skipped_steps == 3
