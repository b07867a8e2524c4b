"""Files of weights, also hostile ones, and configurations."""

import json
import math
import re
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from making import move_zero_layers, normal_scene, same
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refinement import (
    Refiner,
    RefinerConfigError,
    WeightsError,
    read_metadata,
    read_refiner,
    refiner_preset,
    save_refiner,
)
from pointsplat_ns.refinement.weights import REFINER_FORMAT


def trained(**changes) -> Refiner:
    torch.manual_seed(0)
    return move_zero_layers(Refiner(refiner_preset("tiny", enc_depths=(1, 1, 1), **changes)))


@pytest.mark.parametrize(
    "changes", [{"norm": "scene"}, {"norm": "batch", "stem": "linear", "raw_inputs": True}], ids=str
)
def test_a_refiner_survives_a_round_trip_to_the_bit(tmp_path, changes):
    refiner = trained(**changes).train()
    refiner(normal_scene(50))  # moves running statistics
    path = tmp_path / "new folder" / "refiner.safetensors"
    metadata = {"steps": 10, "command": "train --x 'y'", "psnr": [1.5, None]}
    save_refiner(refiner, path, metadata)
    loaded = read_refiner(path)
    assert loaded.config == refiner.config and not loaded.training
    assert read_metadata(path) == metadata
    assert same(refiner.eval()(normal_scene(50)), loaded(normal_scene(50)))
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_full_disk_is_one_error_and_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch):
    def full(state, part, **_):
        Path(part).write_bytes(b"half")
        raise SafetensorError(
            "Error while serializing: I/O error: No space left on device (os error 28)"
        )

    path = tmp_path / "refiner.safetensors"
    save_refiner(trained(), path)
    before = path.read_bytes()
    monkeypatch.setattr("safetensors.torch.save_file", full)
    with pytest.raises(
        PointSplatError, match="refiner.safetensors: cannot be written .*No space left on device"
    ):
        save_refiner(trained(), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_missing_foreign_and_truncated_files_are_named(tmp_path):
    path = tmp_path / "refiner.safetensors"
    with pytest.raises(WeightsError, match="refiner.safetensors: no such file"):
        read_refiner(path)
    path.write_bytes(b"not a safetensors file at all")
    with pytest.raises(WeightsError, match="refiner.safetensors: not a readable safetensors file"):
        read_refiner(path)
    save_file({"x": torch.zeros(2)}, path)
    with pytest.raises(WeightsError, match="format None; expected 'pointsplat-refiner/1'"):
        read_refiner(path)
    save_file({"x": torch.zeros(2)}, path, metadata={"format": REFINER_FORMAT})
    with pytest.raises(WeightsError, match="lacks the entry 'config'"):
        read_refiner(path)
    save_refiner(trained(), path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        read_refiner(path)


def rewrite(path, config=None, **tensors):
    """The file with another configuration or other tensors; a tensor of None is left out."""
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        header = file.metadata()
    state = {k: v for k, v in {**load_file(path), **tensors}.items() if v is not None}
    save_file(
        state,
        path,
        metadata={**header, **({"config": json.dumps(config)} if config is not None else {})},
    )


def test_files_whose_contents_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "refiner.safetensors"
    name = "heads.mlps.means.6.bias"

    def check(message, **changes):
        save_refiner(trained(), path)
        rewrite(path, **changes)
        with pytest.raises(WeightsError, match=message):
            read_refiner(path)

    check(f"1 tensors do not fit, first {name}: found nothing, expected \\(3,\\)", **{name: None})
    check(f"{name}: found \\(4,\\), expected \\(3,\\)", **{name: torch.zeros(4)})
    check("first extra: found \\(1,\\), expected nothing", extra=torch.zeros(1))
    check(f"{name} holds NaN or Inf", **{name: torch.tensor([0.0, torch.nan, 0])})
    check("unknown refiner settings flavour", config={"flavour": 1})
    check(f"{name} is of type I32", **{name: torch.zeros(3, dtype=torch.int32)})
    check("config is list; expected a JSON object", config=[1])
    check("configuration not understood", config={"enc_channels": 3})


HUGE = [
    {"enc_channels": [1 << 40, 48, 64]},
    {"feature_dim": 1 << 16, "color_hidden": 1 << 16, "color_dim": 1 << 16},
    {"head_depth": 1 << 40},
    {"enc_depths": [1 << 16, 1, 1]},
    {"patch": 1 << 40},
]

WRONG = [
    0,
    -1,
    1.5,
    math.nan,
    math.inf,
    True,
    None,
    "1",
    [],
    [1],
    [[1]],
    {},
    {"a": 1},
    [None],
    "x" * 10_000,
]


@pytest.fixture()
def little_memory():
    """Room for 2 GB more than this process has now: more than that is refused, as on a machine that
    has no more."""
    resource = pytest.importorskip("resource")
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
@pytest.mark.parametrize("changes", HUGE, ids=str)
def test_a_configuration_too_large_for_its_file_takes_no_memory(changes, tmp_path, little_memory):
    path = tmp_path / "refiner.safetensors"
    save_refiner(trained(), path)
    rewrite(path, config={**vars(trained().config), **changes})
    with pytest.raises(WeightsError, match="refiner.safetensors: "):
        read_refiner(path)


@pytest.mark.parametrize("name", sorted(vars(trained().config)))
def test_settings_of_a_wrong_type_are_one_error(name, tmp_path):
    path = tmp_path / "refiner.safetensors"
    save_refiner(trained(), path)
    right = vars(trained().config)
    refused = 0
    for value in WRONG:
        rewrite(path, config={**right, name: value})
        try:
            assert getattr(read_refiner(path).config, name) == value, "read as something else"
        except WeightsError as error:
            refused += 1
            assert any(text in str(error) for text in (name, "do not fit", "layers", "stages"))
            assert len(str(error)) < 600 and "\n" not in str(error)
    assert refused >= len(WRONG) - 4  # 0, 1.5 or 1 may be valid


@pytest.mark.parametrize(
    "text",
    ["", "{", "[" * 100_000, '{"a":' * 100_000, "9" * 5000, "null", '"keep"', "3", "\ud800"],
    ids=lambda t: t[:9],
)
@pytest.mark.parametrize("key", ["config", "metadata"])
def test_a_header_that_is_no_json_object_is_one_error(key, text, tmp_path):
    path = tmp_path / "refiner.safetensors"
    save_refiner(trained(), path)
    header = {
        "format": REFINER_FORMAT,
        "config": json.dumps(vars(trained().config)),
        "metadata": "{}",
    }
    save_file(
        load_file(path), path, metadata={**header, key: text.encode("utf-8", "replace").decode()}
    )
    with pytest.raises(WeightsError, match=f"refiner.safetensors: {key} is "):
        (read_refiner if key == "config" else read_metadata)(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"enc_depths": (1, 1)}, "enc_depths has 2 entries; expected 3"),
        ({"dec_heads": (5, 3)}, "dec: 32 channels do not divide into 5 heads"),
        ({"strides": (2, 3)}, "strides holds 3; expected powers of two"),
        ({"curves": ("z", "peano")}, "expected z, z-trans"),
        ({"sh_degree": 4}, "sh_degree is 4"),
        ({"encoder": "concat", "use_appearance": False}, "encoder 'concat' expects both on"),
        ({"norm": "group"}, "norm is 'group'; expected scene, batch"),
    ],
)
def test_contradictory_settings_are_refused_by_name(changes, message):
    with pytest.raises(RefinerConfigError, match=re.escape(message)):
        refiner_preset("tiny", **changes)


def test_an_unknown_size_is_refused():
    with pytest.raises(
        PointSplatError, match="no refiner size 'huge'; expected one of full, small, tiny"
    ):
        refiner_preset("huge")
