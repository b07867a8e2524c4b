"""The container of a 3D Gaussian scene.

Parameters are stored as in Splatfacto and the 3DGS PLY (natural-log scales, opacity logits,
unnormalised wxyz quaternions, SH coefficients), so that reading and writing lose nothing. Activated
values are computed properties.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import AXES, Direction
from pointsplat_ns.system.tensors import DOUBLES

MAX_SH_DEGREE = 3

PARAMETERS = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
"""Names of the parameters, also in checkpoints and in Splatfacto's optimisers."""


def sh_degree_of(num_rest: int) -> int:
    """SH degree of a scene with ``num_rest`` coefficients of degree 1 and higher per channel.

    Raises:
        SceneError: if no degree from 0 to 3 has this number of coefficients.
    """
    for degree in range(MAX_SH_DEGREE + 1):
        if (degree + 1) ** 2 - 1 == num_rest:
            return degree
    raise SceneError(
        f"features_rest has {num_rest} coefficients a channel; expected 0, 3, 8 or 15 (SH degree "
        f"0 to {MAX_SH_DEGREE})"
    )


def is_direction(up: Any) -> bool:
    """Whether a value is three finite numbers, not all 0, whose squares fit into a float."""
    return (
        isinstance(up, tuple)
        and len(up) == 3
        and all(isinstance(part, float) for part in up)
        and 1e-100 < math.hypot(*up) < 1e100
    )


def up_in_json(value: Any) -> str | Direction | None:
    """The up direction that a value of a JSON file gives: the name of an axis, or a list of three
    numbers; None if it is neither."""
    if isinstance(value, list):
        value = tuple(value)
    return value if (isinstance(value, str) and value in AXES) or is_direction(value) else None


Offset = tuple[float, float, float]
"""Origin of a scene in the frame of its file, scene units."""


class Traits(NamedTuple):
    """Properties that files declare of a scene beside its Gaussians; see :class:`Gaussians`."""

    antialiased: bool = False
    up: str | Direction | None = None
    offset: Offset | None = None


PLAIN = Traits()
"""Traits of a scene whose file declares none."""


class _Activated(torch.autograd.Function):
    """``exp`` or ``sigmoid`` of raw values. The gradient is 0, not NaN, where the result or its
    slope is not finite, because such a Gaussian is not drawn."""

    @staticmethod
    def forward(ctx: Any, raw: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
        value = function(raw)
        ctx.save_for_backward(value)
        ctx.function = function
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (value,) = ctx.saved_tensors
        moved = grad * value if ctx.function is torch.exp else grad * (1 - value) * value
        return torch.where(value.isfinite(), moved, 0.0), None


@dataclass(frozen=True, repr=False)
class Gaussians:
    """A scene of N Gaussians, on one device and of one floating dtype, parametrised as Splatfacto.

    Attributes:
        means: (N, 3) positions, world, scene units.
        scales: (N, 3) natural logarithms of the standard deviations along the Gaussian's own axes,
            in scene units; -Inf is a flat axis. Above 88.7, the deviation overflows float32.
        quats: (N, 4) rotations of those axes into the world, quaternions wxyz of any length; zero
            is the identity.
        opacities: (N, 1) logits; +Inf is opacity 1 and -Inf opacity 0.
        features_dc: (N, 3) constant SH coefficient of red, green and blue: colour = 0.5 +
            :data:`SH_C0` * features_dc.
        features_rest: (N, (d+1)^2 - 1, 3) the other coefficients of SH degree d, from 0 to 3.
        antialiased: whether the scene was trained for antialiased rendering (Mip-Splatting), and is
            drawn antialiased.
        up: the axis that is up, "x", "y", "z", "-x", "-y" or "-z", or a direction along none of
            them as three numbers, if the scene's file declares it; else None.
        offset: origin of ``means`` in the frame of the scene's file and of its poses, scene units,
            for example of a geo-referenced scene; None for (0, 0, 0).

    Raises:
        SceneError: if a parameter is not a tensor, its shape, device or dtype does not match the
            others, no SH degree has this number of coefficients, ``up`` is not a direction, or
            ``offset`` is not three finite numbers.

    Example:
        Two Gaussians: a grey ball of standard deviation 0.1, nearly opaque, beside a red disc.

        >>> import torch
        >>> import pointsplat_ns as ps
        >>> from pointsplat_ns.geometry.harmonics import SH_C0
        >>> scene = ps.Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        ...     scales=torch.tensor([[0.1, 0.1, 0.1], [0.2, 0.2, 0.001]]).log(),
        ...     quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        ...     opacities=torch.logit(torch.tensor([[0.95], [0.5]])),
        ...     features_dc=(torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]) - 0.5) / SH_C0,
        ...     features_rest=torch.zeros(2, 0, 3),
        ... )
        >>> len(scene), scene.sh_degree, scene.alphas.tolist()[1]
        (2, 0, 0.5)
        >>> disc = scene[1]  # a slice, mask or index tensor also gives a scene
        >>> disc.means.tolist()
        [[1.0, 0.0, 0.0]]
    """

    means: Tensor  # [N, 3] scene units
    scales: Tensor  # [N, 3] natural logarithm of the standard deviations, scene units
    quats: Tensor  # [N, 4] wxyz, any length; zero means the identity
    opacities: Tensor  # [N, 1] logit; +-Inf are opacity 1 and 0
    features_dc: Tensor  # [N, 3] constant SH coefficient
    features_rest: Tensor  # [N, (d+1)^2 - 1, 3] the other SH coefficients
    antialiased: bool = dataclasses.field(default=False, kw_only=True)
    up: str | Direction | None = dataclasses.field(default=None, kw_only=True)
    offset: Offset | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        tails = {
            "means": (3,),
            "scales": (3,),
            "quats": (4,),
            "opacities": (1,),
            "features_dc": (3,),
        }
        for name, value in self.items():
            if not isinstance(value, Tensor):
                raise SceneError(
                    f"{name} is a {type(value).__module__}.{type(value).__qualname__}; expected a "
                    "torch.Tensor; convert it with torch.as_tensor"
                )
        n = self.means.shape[0] if self.means.dim() else -1
        for name, tail in tails.items():
            shape = tuple(getattr(self, name).shape)
            if shape != (n, *tail):
                raise SceneError(
                    f"{name} has shape {shape}; expected ({n}, {', '.join(map(str, tail))})"
                )
        rest = tuple(self.features_rest.shape)
        if len(rest) != 3 or rest[0] != n or rest[2] != 3:
            raise SceneError(f"features_rest has shape {rest}; expected ({n}, (d+1)^2 - 1, 3)")
        sh_degree_of(rest[1])
        for name, value in self.items():
            if value.device != self.means.device or value.dtype != self.means.dtype:
                raise SceneError(
                    f"{name} is {value.dtype} on {value.device} but means are {self.means.dtype} "
                    f"on {self.means.device}"
                )
        if not self.means.dtype.is_floating_point:
            raise SceneError(f"parameters are {self.means.dtype}; expected a floating-point type")
        if self.up is not None and up_in_json(self.up) is None:
            raise SceneError(
                f"up is {self.up!r}; expected {', '.join(AXES[:-1])} or {AXES[-1]}, or three "
                "numbers"
            )
        if self.offset is not None and not (
            len(self.offset) == 3 and all(map(math.isfinite, self.offset))
        ):
            raise SceneError(f"offset is {self.offset!r}; expected three finite numbers")

    @classmethod
    def empty(cls, sh_degree: int = 0) -> Gaussians:
        """A scene without Gaussians, float32 on the CPU."""
        shapes = ((0, 3), (0, 3), (0, 4), (0, 1), (0, 3), (0, (sh_degree + 1) ** 2 - 1, 3))
        return cls(*(torch.empty(shape, dtype=torch.float32, device="cpu") for shape in shapes))

    @classmethod
    def cat(cls, scenes: Sequence[Gaussians]) -> Gaussians:
        """All Gaussians of several scenes of one SH degree, in order; antialiased if any of the
        scenes is; up axis and offset of the first."""
        first = scenes[0]
        parts = zip(*(scene.at_offset(first.offset).tensors() for scene in scenes), strict=True)
        traits = first.traits._replace(antialiased=any(scene.antialiased for scene in scenes))
        return cls(*map(torch.cat, parts), **traits._asdict())

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """``(name, tensor)`` of every parameter, in the order of the fields."""
        return ((name, getattr(self, name)) for name in PARAMETERS)

    def tensors(self) -> list[Tensor]:
        """The parameter tensors, in the order of the fields."""
        return [value for _, value in self.items()]

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """A scene with ``function`` applied to every parameter."""
        return Gaussians(*map(function, self.tensors()), **self.traits._asdict())

    def replace(self, **changes: Any) -> Gaussians:
        """A scene with some attributes replaced."""
        return dataclasses.replace(self, **changes)

    def at_offset(self, offset: Offset | None) -> Gaussians:
        """The same scene with positions relative to another offset, converted in float64."""
        old = self.offset or (0.0, 0.0, 0.0)
        new = offset or (0.0, 0.0, 0.0)
        declared = new if any(new) else None
        if old == new:
            return self if self.offset == declared else self.replace(offset=declared)
        shift = torch.tensor([a - b for a, b in zip(old, new, strict=True)], **DOUBLES).to(
            self.device
        )
        return self.replace(means=(self.means.double() + shift).to(self.dtype), offset=declared)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        drawn = ", antialiased" if self.antialiased else ""
        return (
            f"Gaussians({len(self):,}, SH degree {self.sh_degree}, {self.dtype}, "
            f"{self.device}{drawn})"
        )

    def __getitem__(self, index: int | slice | list[int] | Tensor) -> Gaussians:
        """The scene of some Gaussians: by slice, boolean mask (N,), list or tensor of indices (K,),
        or one integer."""
        if isinstance(index, int):
            index = [index]
        return self.map(lambda value: value[index])

    def to(self, *args: Any, **kwargs: Any) -> Gaussians:
        """As ``torch.Tensor.to``, for every parameter."""
        return self.map(lambda value: value.to(*args, **kwargs))

    def detach(self) -> Gaussians:
        """The same parameters outside any autograd graph."""
        return self.map(torch.Tensor.detach)

    @property
    def traits(self) -> Traits:
        """The properties that a file declares of the scene beside its Gaussians."""
        return Traits(self.antialiased, self.up, self.offset)

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return self.means.device

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the parameters."""
        return self.means.dtype

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return sh_degree_of(self.features_rest.shape[1])

    @property
    def sh(self) -> Tensor:
        """All SH coefficients, (N, (d+1)^2, 3)."""
        return torch.cat([self.features_dc[:, None], self.features_rest], dim=1)

    @property
    def alphas(self) -> Tensor:
        """Opacities in [0, 1], (N,). The gradient of a NaN is 0."""
        return _Activated.apply(self.opacities[:, 0], torch.sigmoid)

    @property
    def stds(self) -> Tensor:
        """Standard deviations along the Gaussian's own axes, scene units, (N, 3). The gradient of a
        NaN or Inf is 0."""
        return _Activated.apply(self.scales, torch.exp)

    @property
    def megabytes(self) -> float:
        """Size of the parameters as float32, in MB (10^6 bytes)."""
        return 4e-6 * sum(value.numel() for value in self.tensors())

    def usable(self) -> Tensor:
        """Mask (N,) of drawable Gaussians: no value is NaN or infinite, except opacity logits
        (+-Inf are opacity 1 and 0) and log-scales of -Inf (a flat axis), and standard deviations
        are finite in the scene's dtype: log-scales are at most 88.7 in float32 and bfloat16, 709 in
        float64 and 11 in float16."""
        ok = torch.ones(len(self), dtype=torch.bool, device=self.device)
        for name, value in self.items() if len(self) else ():
            flat = value.reshape(len(self), -1)
            if name == "opacities":
                bad = flat.isnan()
            elif name == "scales":
                bad = ~(flat.detach().exp() < torch.inf)  # True for NaN too
            elif bool(flat.sum().isfinite()):
                # a finite sum has only finite terms; thirty times faster than isfinite per value
                continue
            else:
                bad = ~flat.isfinite()
            ok &= ~bad.any(dim=1)
        return ok
