"""The options of ``ns-train pointsplat``: each is obeyed, and those that cannot be are refused."""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from making import small_config
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig

MODEL = "--pipeline.model."


def test_every_option_of_the_model_is_read_in_a_training(trained_walls, no_lpips):
    config = pointsplat_config()
    kind = tyro.conf.SuppressFixed[tyro.conf.FlagConversionOff[type(config)]]  # as ns-train takes it
    words = [name for action in tyro.extras.get_parser(kind, default=config)._actions for name in action.option_strings]
    options = {word.removeprefix(MODEL).replace("-", "_") for word in words if word.startswith(MODEL)}
    assert {"keep", "size", "quality"} <= options
    read = set()

    @dataclass
    class Recorded(PointSplatModelConfig):
        def __getattribute__(self, name: str):
            read.add(name)
            return super().__getattribute__(name)

    config = small_config(trained_walls, Path("unused"), 1, lpips_weight=0.1)
    config.pipeline.model = Recorded(**{name: getattr(config.pipeline.model, name) for name in options})
    read.clear()
    config.pipeline.setup(device="cpu", test_mode="val").get_train_loss_dict(0)
    assert options <= read


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
        ({"by": "beauty"}, "no method is called 'beauty'; expected one of merge"),
        ({"encoder": "concat", "use_position": False}, "switches of the encoder 'dual'; encoder 'concat' expects both"),
        ({"keep": 0.0}, "keep is .*expected a ratio above 0"),
        ({"more_keeps": (0.3, 1.5)}, "keep is 1.5"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_and_leave_no_folder(trained_walls, tmp_path, changes, message):
    config = small_config(trained_walls, tmp_path / "outputs", 1, **changes)
    config.save_config()
    with pytest.raises(PointSplatError, match=message):
        config.setup(local_rank=0, world_size=1).setup()
    assert not (tmp_path / "outputs").exists()
