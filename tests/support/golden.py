"""Golden scenes with all that pictures depend on, drawn by the float64 reference and by the fast
path."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from lab.numerics.reference import rasterize_reference
from pointsplat_ns.rendering import rasterization

# twelve tiles, some of them cut off: compiled kernels are used from eight on
WIDTH = 26
HEIGHT = 18
COUNT = 16
NAMES = ("means", "quats", "scales", "opacities", "colors")

TOLERANCES = {torch.float32: (1e-5, 1e-4), torch.float64: (1e-9, 1e-8)}
"""Of the largest value of an image, and of a gradient's norm. For float32 ten times what was seen:
an image is rounded by some tens of layers, and a gradient is a sum over pixels that partly cancel.
For float64 it is another order."""


@dataclass(frozen=True)
class Golden:
    """What a scene is like and how it is drawn."""

    seed: int
    sh_degree: int | None = 3
    channels: int = 3
    mode: str = "classic"
    render_mode: str = "RGB"
    background: tuple[float, ...] | None = None
    principal: tuple[float, float] = (13.5, 8.4)
    focal: tuple[float, float] = (24.0, 25.0)
    change: Callable[[Tensor, Tensor, Tensor], dict] = field(
        default=lambda means, scales, opacities: {}
    )


ONES = torch.ones(COUNT, dtype=torch.float64)
NEEDLE = torch.tensor([2.0, 1e-3, 1e-3], dtype=torch.float64).repeat(COUNT, 1)
BEHIND = torch.tensor([[0.0, 0.0, -2.9], [0.0, 0.0, 0.0]], dtype=torch.float64).repeat(
    COUNT // 2, 1
)
"""Half are moved: some behind the camera, some before the near plane, some beside the field of
view."""

SCENES = {
    "colours": Golden(0, sh_degree=None),
    "degree 0 over a background": Golden(1, sh_degree=0, background=(0.9, 0.5, 0.1)),
    "degree 1": Golden(2, sh_degree=1),
    "degree 2 with depth": Golden(3, sh_degree=2, render_mode="RGB+D"),
    "degree 3 with expected depth": Golden(4, render_mode="RGB+ED", background=(0.2, 0.3, 0.4)),
    "seven channels": Golden(
        5, sh_degree=None, channels=7, background=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
    ),
    "antialiased": Golden(6, mode="antialiased"),
    "antialiased below a pixel": Golden(
        7, mode="antialiased", change=lambda _, s, __: {"scales": 0.1 * s, "opacities": ONES}
    ),
    "needles": Golden(8, sh_degree=1, change=lambda *_: {"scales": NEEDLE}),
    "opaque": Golden(
        9,
        1,
        background=(1.0, 1.0, 1.0),
        change=lambda _, s, __: {"scales": 2.5 * s, "opacities": ONES},
    ),
    "large and faint": Golden(
        10, 2, mode="antialiased", change=lambda _, s, o: {"scales": 8 * s, "opacities": 0.3 * o}
    ),
    "around the camera": Golden(
        11,
        None,
        principal=(30.0, -4.0),
        focal=(15.0, 22.0),
        change=lambda m, s, _: {"means": m + BEHIND, "scales": 0.5 * s},
    ),
}


@functools.cache
def made(name: str) -> dict[str, Tensor]:
    """The tensors of one of :data:`SCENES`, in numbers that float32 holds."""
    golden = SCENES[name]
    random = np.random.RandomState(golden.seed)  # whose numbers never change

    def normal(*shape: int) -> Tensor:
        return torch.from_numpy(random.standard_normal(shape))

    depth = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    if golden.sh_degree is None:
        colors = torch.from_numpy(random.uniform(size=(COUNT, golden.channels)))
    else:
        colors = 0.3 * normal(COUNT, (golden.sh_degree + 1) ** 2, 3)
    scene = {
        "means": normal(COUNT, 3) * torch.tensor([0.9, 0.6, 0.5], dtype=torch.float64) + depth,
        "quats": normal(COUNT, 4),
        "scales": torch.exp(0.6 * normal(COUNT, 3) - 1.6),
        "opacities": torch.from_numpy(random.uniform(0.2, 0.98, COUNT)),
        "colors": colors,
    }
    scene |= golden.change(scene["means"], scene["scales"], scene["opacities"])
    cos = math.cos(0.15)
    sin = math.sin(0.15)
    rows = [
        [cos, 0.0, sin, -0.4],
        [0.0, 1.0, 0.0, 0.05],
        [-sin, 0.0, cos, 0.1],
        [0.0, 0.0, 0.0, 1.0],
    ]
    view = torch.tensor(rows, dtype=torch.float64)
    (fx, fy) = golden.focal
    (cx, cy) = golden.principal
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return {
        name: value.float().double() for name, value in {**scene, "viewmat": view, "K": K}.items()
    }


def with_gradients(image: Tensor, alphas: Tensor, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    """Image (H, W, channels) and alphas (H, W, 1), and gradients of a sum over both that is neither
    symmetric nor of one sign; float64 on the CPU."""
    both = torch.cat([image, alphas], dim=-1)
    weights = torch.cos(torch.arange(both.numel(), dtype=torch.float64)).view(both.shape)
    grads = torch.autograd.grad(
        (both * weights.to(both)).sum(), [*leaves.values()], materialize_grads=True
    )
    found = {"image": image, "alphas": alphas} | dict(
        zip((f"grad of {name}" for name in NAMES), grads, strict=True)
    )
    return {name: value.detach().to("cpu", torch.float64) for name, value in found.items()}


@functools.cache
def drawn_by_reference(name: str) -> dict[str, Tensor]:
    """One of :data:`SCENES` as :func:`with_gradients`, by the reference."""
    golden = SCENES[name]
    scene = made(name)
    leaves = {name: scene[name].clone().requires_grad_() for name in NAMES}
    image, alphas, depths = rasterize_reference(
        *leaves.values(),
        scene["viewmat"],
        scene["K"],
        WIDTH,
        HEIGHT,
        sh_degree=golden.sh_degree,
        antialiased=golden.mode == "antialiased",
    )
    if golden.background is not None:
        image = image + (1 - alphas) * torch.tensor(golden.background, dtype=torch.float64)
    if golden.render_mode == "RGB+D":
        image = torch.cat([image, depths], dim=-1)
    if golden.render_mode == "RGB+ED":
        image = torch.cat([image, depths / alphas.clamp_min(1e-10)], dim=-1)
    return with_gradients(image, alphas, leaves)


def drawn(
    name: str, dtype: torch.dtype, device: torch.device | str = "cpu", **options
) -> dict[str, Tensor]:
    """As :func:`drawn_by_reference`, by the fast path in some precision on a device; ``options``
    are those of :func:`pointsplat_ns.rasterization`."""
    golden = SCENES[name]
    scene = made(name)
    leaves = {name: scene[name].to(device, dtype, copy=True).requires_grad_() for name in NAMES}
    background = (
        None
        if golden.background is None
        else torch.tensor([golden.background], device=device, dtype=dtype)
    )
    renders, alphas, _ = rasterization(
        *leaves.values(),
        scene["viewmat"][None].to(leaves["means"]),
        scene["K"][None].to(leaves["means"]),
        WIDTH,
        HEIGHT,
        sh_degree=golden.sh_degree,
        backgrounds=background,
        render_mode=golden.render_mode,
        rasterize_mode=golden.mode,
        **options,
    )
    return with_gradients(renders[0], alphas[0], leaves)


def compare(
    found: dict[str, Tensor], wanted: dict[str, Tensor], image: float, gradient: float
) -> None:
    """Raise AssertionError unless images agree to a share of the largest value, and gradients of
    their norm."""
    for name in ("image", "alphas"):
        off = (found[name] - wanted[name]).abs().max() / wanted[name].abs().max()
        assert off <= image, (name, float(off))
    for name in (f"grad of {part}" for part in NAMES):
        off = (found[name] - wanted[name]).norm() / wanted[name].norm()
        assert off <= gradient, (name, float(off))
