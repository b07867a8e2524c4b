"""The line of the log that says what draws."""

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


def test_a_training_is_compiled_if_all_that_it_uses_is_and_else_says_what_it_lacks_and_why(engine):
    assert engine(SplatfactoCpuModelConfig()) == "rasterizer: compiled"
    assert engine(PointSplatModelConfig(), structural_similarity="the disk is full") == "rasterizer: compiled"
    for what, module in USED.items():
        line = engine(SplatfactoCpuModelConfig(), **{module.__name__.rpartition(".")[2]: "the disk is full"})
        assert line == f"rasterizer: compiled, but torch does {what}, which is slower: the disk is full"
    missing = {module.__name__.rpartition(".")[2]: "there is no C++ compiler" for module in USED.values()}
    slower = "rasterizer: torch, several times slower than compiled kernels: "
    assert engine(SplatfactoCpuModelConfig(), **missing) == slower + "there is no C++ compiler"
    left_out = engine(SplatfactoCpuModelConfig(compiled=False))
    assert left_out == slower + "as --pipeline.model.compiled is False"
