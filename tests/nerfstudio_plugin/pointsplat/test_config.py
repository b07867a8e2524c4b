"""The options of ``ns-train pointsplat``: those that it obeys, and no other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro
from nerfstudio.models.splatfacto import SplatfactoModelConfig

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from making import small_config
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig

MODEL_OPTIONS = {
    *("keep", "more_keeps", "by", "opacity_weight", "pruned_folder"),  # how scenes are pruned
    *("size", "encoder", "use_appearance", "use_position", "norm"),  # the network
    *("augment", "pixel_loss", "lpips_weight", "lpips_net"),  # what it learns from
    *("backend", "compiled", "quality"),  # the rasterizer
}
DATAMANAGER_OPTIONS = {
    *("data", "supervision", "sampled_poses", "sampled_size", "eval_scenes"),
    *("images_per_step", "cache_gigabytes", "seed"),
}


def method():
    """The method as ns-train takes it: a bool takes its value in words, and what is fixed is no option."""
    config = pointsplat_config()
    return tyro.conf.SuppressFixed[tyro.conf.FlagConversionOff[type(config)]], config


def options(prefix: str) -> set[str]:
    """Names of the options that begin so."""
    kind, config = method()
    actions = tyro.extras.get_parser(kind, default=config)._actions
    names = {name for action in actions for name in action.option_strings if name.startswith(prefix)}
    return {name.removeprefix(prefix).replace("-", "_") for name in names}


def refusal(capsys, *words: str) -> str:
    """What is said of a command line that is refused."""
    kind, config = method()
    with pytest.raises(SystemExit) as caught:
        tyro.cli(kind, default=config, args=words)
    assert caught.value.code != 0
    said = capsys.readouterr()
    return said.out + said.err


@pytest.mark.parametrize(
    ("prefix", "names"),
    [
        ("--pipeline.model.", MODEL_OPTIONS),
        ("--pipeline.datamanager.", DATAMANAGER_OPTIONS),
        ("--prompt", set()),
    ],
)  # fmt: skip
def test_options_are_those_that_are_obeyed(prefix, names):
    assert options(prefix) == names


def test_every_option_of_the_model_is_read_in_a_training(trained_walls, no_lpips):
    read = set()

    @dataclass
    class Recorded(PointSplatModelConfig):
        def __getattribute__(self, name: str):
            read.add(name)
            return super().__getattribute__(name)

    config = small_config(trained_walls, Path("unused"), 1, lpips_weight=0.1)
    config.pipeline.model = Recorded(**{name: getattr(config.pipeline.model, name) for name in MODEL_OPTIONS})
    read.clear()
    config.pipeline.setup(device="cpu", test_mode="val").get_train_loss_dict(0)
    assert MODEL_OPTIONS <= read


@pytest.mark.parametrize(
    ("option", "value"),
    [("rasterize-mode", "antialiased"), ("background-color", "white"), ("ssim-lambda", "0.3"), ("sh-degree", "2")],
)
def test_an_option_of_splatfacto_is_refused_by_name(capsys, option, value):
    assert hasattr(SplatfactoModelConfig, option.replace("-", "_")), "proves too little"
    said = refusal(capsys, f"--pipeline.model.{option}", value)
    assert "Unrecognized" in said and f"--pipeline.model.{option}" in said


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lpips_weight": 0.0, "lpips_net": "vgg"}, "lpips-net vgg: at --pipeline.model.lpips-weight 0"),
        ({"lpips_weight": -0.1}, "lpips-weight -0.1: expected a finite number, 0 or above"),
        ({"lpips_weight": math.nan}, "lpips-weight nan: expected a finite number, 0 or above"),
        ({"backend": "gsplat", "compiled": True}, "compiled True: has no effect on --pipeline.model.backend gsplat"),
        ({"backend": "gsplat", "quality": "fast"}, "quality fast: has no effect on --pipeline.model.backend gsplat"),
        ({"by": "merge", "opacity_weight": 0.3}, "opacity weight 0.3: merge does not weigh opacity"),
        ({"by": "pup"}, "pup looks at a scene from poses; expected a method that needs none"),
        ({"encoder": "concat", "use_position": False}, "switches of the encoder 'dual'; encoder 'concat' expects both"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_and_leave_no_folder(trained_walls, tmp_path, changes, message):
    config = small_config(trained_walls, tmp_path / "outputs", 1, **changes)
    config.save_config()
    with pytest.raises(PointSplatError, match=message):
        config.setup(local_rank=0, world_size=1).setup()
    assert not (tmp_path / "outputs").exists()


def test_the_saved_settings_are_those_of_the_model_and_no_others(tmp_path):
    from pointsplat_ns.io.inert_yaml import read_config

    config = small_config(tmp_path, tmp_path / "outputs", 1)
    config.save_config()
    saved = read_config(config.get_base_dir() / "config.yml").fields["pipeline"].fields["model"].fields
    assert MODEL_OPTIONS <= set(saved) and not {"rasterize_mode", "ssim_lambda", "sh_degree"} & set(saved)
