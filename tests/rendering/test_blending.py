"""Options of blending that must not change the image, or change it by what they say."""

import importlib
import pkgutil

import pytest
import torch
from torch.autograd.function import once_differentiable

from making import splats_in_view
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.rendering.constants import QUALITIES

# neither is a multiple of the tile
WIDTH = 70
HEIGHT = 45


def make_scene(n, size=-2.2):
    return splats_in_view(n, 0, torch.float32, scale=size, spread=0.7)


def draw(scene, **options):
    """The image."""
    K = torch.tensor([[50.0, 0, 33], [0, 52, 21], [0, 0, 1]])
    return rasterization(
        *scene, torch.eye(4)[None], K[None], WIDTH, HEIGHT, sh_degree=3, **options
    )[0]


def test_every_gradient_of_the_package_is_once_differentiable():
    for part in ("rendering", "refinement", "metrics"):
        package = importlib.import_module(f"pointsplat_ns.{part}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    ours = [
        kind
        for kind in torch.autograd.Function.__subclasses__()
        if kind.__module__.startswith("pointsplat_ns.")
    ]
    assert {"Blend", "Project", "Color", "CompiledSimilarity"} <= {kind.__name__ for kind in ours}
    marked = once_differentiable(lambda ctx: None).__code__  # that of the wrapper, one for all
    assert [kind for kind in ours if kind.backward.__code__ is not marked] == []


@pytest.mark.parametrize("compiled", [False, None])
def test_a_tall_stack_is_blended_front_to_back(compiled):
    """2,000 Gaussians on one spot: one tile, long chunks; the closed form is 1 - (1 - a)^n until
    the pixel stops."""
    n = 2000
    alpha = 0.01
    scene = [
        torch.tensor([[0.0, 0.0, 2.0]]).repeat(n, 1),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 5.0),
        torch.full((n,), alpha),
        torch.ones(n, 3),
    ]
    K = torch.tensor([[50.0, 0, 3.5], [0, 50, 3.5], [0, 0, 1]])
    image, alphas, _ = rasterization(*scene, torch.eye(4)[None], K[None], 8, 8, compiled=compiled)
    drawn = 916  # the first n with 0.99^n <= 1e-4 is 917: that one is not drawn
    wanted = 1 - (1 - alpha) ** drawn
    assert abs(float(alphas[0, 3, 3, 0]) - wanted) < 1e-5  # float32 product of 916 factors
    assert abs(float(image[0, 3, 3, 0]) - wanted) < 1e-5


@pytest.mark.parametrize("compiled", [False, None])
def test_lower_qualities_are_within_the_error_they_state_and_in_order(compiled):
    scene = make_scene(n=2000, size=-3.0)
    exact = draw(scene, compiled=compiled)
    errors = {
        name: float((draw(scene, quality=name, compiled=compiled) - exact).square().mean())
        for name in QUALITIES
    }
    assert errors["exact"] == 0
    assert 0 < errors["balanced"] < errors["fast"]
    assert errors["balanced"] < 10 ** (
        -45 / 10
    )  # 53 dB and more on trained scenes; this one is all edges
    with pytest.raises(ValueError, match="quality is 'worst'"):
        draw(scene, quality="worst")


def test_gsplat_gets_cameras_of_the_gaussians_type(monkeypatch):
    """It knows no float64, and raised where ours takes such cameras beside float32 Gaussians."""
    import gsplat.rendering

    given = {}

    def positional(means, quats, scales, opacities, colors, viewmats, Ks, *rest):
        given.update(means=means.dtype, viewmats=viewmats.dtype, Ks=Ks.dtype)

    monkeypatch.setattr(gsplat.rendering, "rasterization", positional)
    monkeypatch.setattr("pointsplat_ns.rendering.rasterize.use_gsplat", lambda *_: True)
    eyes = torch.eye(4, dtype=torch.float64)[None], torch.eye(3, dtype=torch.float64)[None]
    rasterization(*make_scene(5), *eyes, WIDTH, HEIGHT, sh_degree=3, backend="gsplat")
    assert given == dict.fromkeys(given, torch.float32) and len(given) == 3


def test_gsplat_on_a_cpu_is_refused_in_one_line_and_auto_draws_with_torch():
    scene = make_scene(n=20)
    with pytest.raises(
        PointSplatError, match="backend gsplat: the Gaussians are on cpu .* use auto or torch"
    ):
        draw(scene, backend="gsplat")
    with pytest.raises(ValueError, match="expected torch, gsplat or auto"):
        draw(scene, backend="vulkan")
    assert torch.equal(draw(scene, backend="auto"), draw(scene))
