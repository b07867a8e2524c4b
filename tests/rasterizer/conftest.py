"""Compiled kernels that are compiled quickly."""

import functools

import pytest

from pointsplat_ns.rasterizer import blending, compiled, frame


@pytest.fixture()
def kernels_of_four(monkeypatch):
    """Within the test, compiled kernels take four Gaussians at once instead of 16: a loop unrolled so many times takes
    the compiler minutes."""
    for module in (blending, compiled, frame):
        monkeypatch.setattr(module, "CHUNK", 4)
    monkeypatch.setattr(compiled, "kernels", functools.cache(compiled.kernels.__wrapped__))
    monkeypatch.setattr(frame, "kernels", compiled.kernels)
