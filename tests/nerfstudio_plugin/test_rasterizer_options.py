"""The line of the log that says what draws."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from pointsplat_ns.metrics import structural_similarity
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModelConfig
from pointsplat_ns.rasterizer.compiled import blending, colors, projection, tiles

USED = {
    "projection": projection,
    "colours": colors,
    "lists of tiles": tiles,
    "blending": blending,
    "SSIM": structural_similarity,
}
"""What a training of splatfacto-cpu uses, by its name in the log."""


@pytest.fixture()
def engine(monkeypatch):
    """A function that gives the line where some kernels are missing."""

    def line(config, **missing: str) -> str:
        for module in USED.values():
            name = module.__name__.rpartition(".")[2]
            monkeypatch.setattr(module, "KERNELS", SimpleNamespace(why_missing=missing.get(name, "")))
        return config.engine(torch.device("cpu"))

    return line


def test_a_training_is_compiled_if_all_that_it_uses_is(engine):
    assert engine(SplatfactoCpuModelConfig()) == "rasterizer: compiled"


@pytest.mark.parametrize("what", USED)
def test_a_training_says_which_kernels_it_lacks_and_why(what, engine):
    name = USED[what].__name__.rpartition(".")[2]
    line = engine(SplatfactoCpuModelConfig(), **{name: "the disk is full"})
    assert line == f"rasterizer: compiled, but torch does {what}, which is slower: the disk is full"


def test_what_a_training_does_not_use_is_not_asked_for(engine):
    assert engine(PointSplatModelConfig(), structural_similarity="the disk is full") == "rasterizer: compiled"


def test_one_reason_for_all_is_said_once(engine):
    missing = {module.__name__.rpartition(".")[2]: "there is no C++ compiler" for module in USED.values()}
    slower = "rasterizer: torch, several times slower than compiled kernels: "
    assert engine(SplatfactoCpuModelConfig(), **missing) == slower + "there is no C++ compiler"
    left_out = engine(SplatfactoCpuModelConfig(compiled=False))
    assert left_out == slower + "as --pipeline.model.compiled is False"
