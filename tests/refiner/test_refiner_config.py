import re

import pytest

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refiner import PRESETS, Refiner, RefinerConfig, RefinerConfigError, preset


@pytest.mark.parametrize("size", PRESETS)
def test_presets_have_the_parameter_counts_that_their_docstring_says(size):
    said = re.search(rf"``{size}``.*?([\d,]+) parameters", preset.__doc__, re.S).group(1)
    assert sum(p.numel() for p in Refiner(preset(size)).parameters()) == int(said.replace(",", ""))


def test_a_configuration_survives_json():
    import json

    config = preset("small", patch=77, use_position=False)
    assert RefinerConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"enc_depths": (1, 1)}, "enc_depths has 2 entries; expected 3"),
        ({"dec_heads": (5, 3)}, "dec: 32 channels do not divide into 5 heads"),
        ({"strides": (2, 3)}, "strides holds 3; expected powers of two"),
        ({"curves": ("z", "peano")}, "expected names out of z, z-trans"),
        ({"curves": ()}, "expected names out of"),
        ({"sh_degree": 4}, "sh_degree is 4"),
        ({"grid": 1000}, "grid is 1000"),
        ({"encoder": "single"}, "encoder is 'single'"),
        ({"encoder": "concat", "use_appearance": False}, "encoder 'concat' expects both on"),
        ({"encoder": "concat", "use_position": False}, "encoder 'concat' expects both on"),
        ({"norm": "group"}, "norm is 'group'"),
        ({"patch": 0}, "patch is 0"),
        ({"drop_path": 1.0}, "drop_path is 1.0"),
        ({"head_depth": 1}, "head_depth is 1"),
    ],
)
def test_contradictory_settings_are_refused_by_name(changes, message):
    with pytest.raises(RefinerConfigError, match=re.escape(message)):
        preset("tiny", **changes)


def test_unknown_names_are_refused():
    with pytest.raises(PointSplatError, match="no refiner size 'huge'; expected one of full, small, tiny"):
        preset("huge")
    with pytest.raises(RefinerConfigError, match="unknown refiner settings color_space"):
        RefinerConfig.from_dict({"color_space": 1})
