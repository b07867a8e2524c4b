"""Small scenes for stability.py, each with one property driven over decades."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views

WIDTH = 40
HEIGHT = 32
FOCAL = 44.0
DEPTH = 3.0
"""How far from the camera the scene's centre is, scene units."""

PIXEL = DEPTH / FOCAL
"""Side of a pixel at that distance, scene units."""

GAUSSIANS = 40


@dataclass(frozen=True)
class Case:
    """A scene and the camera that looks at it. All tensors are float64."""

    means: Tensor  # [N, 3] scene units
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] standard deviations, scene units
    opacities: Tensor  # [N] in [0, 1]
    sh: Tensor  # [N, 16, 3]
    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] pixels
    near: float = 0.01
    antialiased: bool = False

    def rounded(self, dtype: torch.dtype) -> Case:
        """The same, as far as ``dtype`` holds it; the camera is never held to less than float32."""
        camera = torch.promote_types(dtype, torch.float32)
        kinds = dict.fromkeys(("means", "quats", "scales", "opacities", "sh"), dtype)
        kinds |= dict.fromkeys(("viewmat", "K"), camera)
        return replace(
            self, **{name: getattr(self, name).to(kind).double() for name, kind in kinds.items()}
        )

    def gaussians(self, dtype: torch.dtype) -> Gaussians:
        """The scene with logarithms and logits, rounded to ``dtype``."""
        logits = torch.logit(self.opacities)[:, None]
        return Gaussians(
            self.means, self.scales.log(), self.quats, logits, self.sh[:, 0], self.sh[:, 1:]
        ).to(dtype)

    def views(self, count: int = 2) -> Views:
        """This camera and others a little beside it."""
        viewmats = self.viewmat.repeat(count, 1, 1)
        viewmats[:, 0, 3] += 0.2 * self.means.std(0).max() * torch.arange(count)
        grey = torch.full((3,), 0.3)
        return Views(
            viewmats, self.K.repeat(count, 1, 1), WIDTH, HEIGHT, grey, near_plane=self.near
        )


def usual(n: int = GAUSSIANS, seed: int = 0) -> Case:
    """Blobs of one to some pixels before a camera that is turned a little, with SH of degree 3."""
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = randn(n, 3) * torch.tensor([0.8, 0.6, 0.4], dtype=torch.float64)
    means[:, 2] += DEPTH
    scales = PIXEL * torch.exp(0.5 * randn(n, 3) + math.log(2.5))
    opacities = 0.1 + 0.85 * torch.rand(n, generator=generator, dtype=torch.float64)
    sh = 0.2 * randn(n, 16, 3)
    sh[:, 0] = 0.5 * randn(n, 3) / SH_C0 * 0.5
    view = torch.eye(4, dtype=torch.float64)
    c = math.cos(0.2)
    s = math.sin(0.2)
    view[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    view[:3, 3] = torch.tensor([-DEPTH * s, -0.05, DEPTH * (1 - c)], dtype=torch.float64)
    K = torch.tensor(
        [[FOCAL, 0, 0.52 * WIDTH], [0, FOCAL, 0.47 * HEIGHT], [0, 0, 1]], dtype=torch.float64
    )
    return Case(means, randn(n, 4), scales, opacities, sh, view, K)


def in_other_units(factor: float) -> Case:
    """The usual scene with all lengths multiplied."""
    case = usual()
    view = case.viewmat.clone()
    view[:3, 3] *= factor
    return replace(
        case,
        means=case.means * factor,
        scales=case.scales * factor,
        viewmat=view,
        near=case.near * factor,
    )


def from_the_origin(distance: float) -> Case:
    """The usual scene and its camera, moved away from the origin by that many scene units."""
    case = usual()
    shift = distance * torch.tensor([0.8, -0.48, 0.36], dtype=torch.float64)
    view = case.viewmat.clone()
    view[:3, 3] -= view[:3, :3] @ shift
    return replace(case, means=case.means + shift, viewmat=view)


def from_the_camera(distance: float) -> Case:
    """The usual scene that many times farther from its camera, whose focal length grows as much:
    the same picture."""
    case = usual()
    view = case.viewmat.clone()
    K = case.K.clone()
    view[2, 3] += DEPTH * (
        distance - 1
    )  # what is at DEPTH stays in the middle, and the size of a pixel there the same
    K[0, 0] *= distance
    K[1, 1] *= distance
    return replace(case, viewmat=view, K=K)


def of_opacity(odds: float) -> Case:
    """The usual scene with one opacity for all, odds / (1 + odds): 1e-2 is just drawn, 1e8 is 1 -
    1e-8."""
    case = usual()
    return replace(case, opacities=torch.full_like(case.opacities, odds / (1 + odds)))


def as_large_as(pixels: float) -> Case:
    """Blobs of that many pixels, faint, so that many are seen through one another."""
    case = usual()
    return replace(
        case,
        scales=case.scales / case.scales.mean() * pixels * PIXEL,
        opacities=0.3 * case.opacities,
    )


def needles(aspect: float) -> Case:
    """One axis as many times longer than the others, which are of 0.3 pixels. Antialiased."""
    case = usual()
    scales = torch.full_like(case.scales, 0.3 * PIXEL)
    scales[:, 0] *= aspect
    return replace(case, scales=scales, antialiased=True)


def discs(aspect: float) -> Case:
    """One axis as many times shorter than the others, which are of 20 pixels. Antialiased."""
    case = usual()
    scales = torch.full_like(case.scales, 20 * PIXEL)
    scales[:, 2] /= aspect
    return replace(case, scales=scales, antialiased=True, opacities=0.3 * case.opacities)


def layers(count: float) -> Case:
    """As many Gaussians, the fainter the more there are, but for a twentieth."""
    case = usual(round(count))
    faint = case.opacities * min(1.0, 30.0 / count) + 0.005
    faint[::20] = case.opacities[::20]
    return replace(case, opacities=faint)


_TYPES = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
PRECISIONS = {torch.finfo(dtype).eps: dtype for dtype in _TYPES}
"""Types by their relative rounding."""


@dataclass(frozen=True)
class Sweep:
    """One property over decades."""

    name: str
    label: str
    values: tuple[float, ...]  # ascending
    case: Callable[[float], Case]
    usual: float = 1.0
    """The value of a common scene, from which limits are looked for on either side."""
    input_precision: bool = False
    """The values are relative roundings of the type that the scene is handed over in, see
    :data:`PRECISIONS`."""

    def dtype(self, value: float) -> torch.dtype:
        """What the scene is handed over in."""
        return PRECISIONS[value] if self.input_precision else torch.float32


def _decades(first: float, last: float, step: float = 1) -> tuple[float, ...]:
    return tuple(10.0 ** (first + step * i) for i in range(round((last - first) / step) + 1))


SWEEPS = (
    Sweep("scale", "unit of length, times the usual", _decades(-36, 36, 6), in_other_units),
    Sweep("origin", "distance from the origin, scene units", _decades(0, 8), from_the_origin),
    Sweep(
        "camera",
        "distance from the camera and focal length, times the usual",
        _decades(0, 8),
        from_the_camera,
    ),
    Sweep("opacity", "opacity / (1 - opacity)", _decades(-2, 8), of_opacity),
    Sweep("size", "size of Gaussians, pixels", _decades(-3, 8), as_large_as),
    Sweep("needles", "length / width of needles 0.3 pixels wide", _decades(0, 7), needles),
    Sweep("discs", "width / thickness of discs 20 pixels wide", _decades(0, 8), discs),
    Sweep("count", "Gaussians", _decades(1, 3, 0.5), layers, 10.0),
    Sweep(
        "precision",
        "relative rounding of the type of the input",
        tuple(PRECISIONS),
        lambda epsilon: usual(),
        torch.finfo(torch.float32).eps,
        True,
    ),
)
