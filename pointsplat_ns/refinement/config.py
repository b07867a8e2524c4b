"""Configuration of the refiner: all settings of the network, and three presets."""

from __future__ import annotations

import dataclasses
import reprlib
from dataclasses import dataclass
from typing import Any, Literal

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refinement.local_units import APPEARANCE, GEOMETRY
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE

_NAMES = {
    "encoder": ("dual", "concat"),
    "norm": ("scene", "batch", "layer"),
    "units": ("scene", "local"),
    "stem": ("conv", "linear"),
    "curves": ("z", "z-trans", "hilbert", "hilbert-trans"),
}

_LAYERS = (
    "enc_channels",
    "enc_depths",
    "enc_heads",
    "dec_channels",
    "dec_depths",
    "dec_heads",
    "mlp_ratio",
    "feature_dim",
    "head_width",
    "head_depth",
)
"""Fields that make the size of a network."""

_RANGES = {
    "sh_degree": (0, MAX_SH_DEGREE),
    "grid": (1, 512),
    "head_depth": (2, 1 << 16),
    "means_reach": (0.0, 1e3),
    "drop_path": (0.0, 0.99),
}


class RefinerConfigError(PointSplatError, ValueError):
    """An invalid refiner configuration."""


@dataclass
class RefinerConfig:
    """All settings of a refiner's network.

    The defaults are the preset ``full``, the published network. Tuples of the encoder have one
    entry per stage, finest first; ``strides`` and the tuples of the decoder one fewer. Raises
    RefinerConfigError if fields contradict others.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.RefinerConfig().enc_channels
        (64, 96, 128, 256, 512)
    """

    sh_degree: int = MAX_SH_DEGREE
    """Highest SH degree of the network's input and output; scenes of a lower degree are padded with
    zeros."""
    encoder: Literal["dual", "concat"] = "dual"
    """``dual`` gates geometry by appearance (paper eq. 4 to 6); ``concat`` is one concatenated
    vector (SplatFormer)."""
    use_appearance: bool = True
    """Gate the geometry branch by the appearance branch (Table 4, column f^(a)); dual encoder
    only."""
    use_position: bool = True
    """Add the position encoding to both branches (Table 4, column delta); dual encoder only."""
    feature_dim: int = 32
    """Channels of each encoder branch."""
    unit_gate: bool = False
    """Multiply the softmax gate by its number of channels, so that gates average 1: training is
    faster."""
    color_hidden: int = 32
    """Hidden channels of the MLP that reduces the SH coefficients of degree 1 and higher."""
    color_dim: int = 8
    """Output channels of that MLP."""
    raw_inputs: bool = False
    """Give the encoder log-scales in units of the cube and opacity logits as they are, not brought
    to order 1."""
    stem: Literal["conv", "linear"] = "conv"
    """First layer of the backbone, before its norm and GELU: a 3x3x3 convolution, or a linear layer
    of each point (the published code)."""
    grid: int | None = 384
    """Cells along the unit cube at the finest level (at most 512); None adapts the cell to the
    spacing of the scene."""
    strides: tuple[int, ...] = (1, 2, 2, 2)
    """Growth of the cells from stage to stage, powers of two; 1 only merges points that share a
    cell."""
    enc_channels: tuple[int, ...] = (64, 96, 128, 256, 512)
    """Channels of the encoder stages."""
    enc_depths: tuple[int, ...] = (2, 2, 2, 4, 2)
    """Blocks of the encoder stages."""
    enc_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    """Attention heads of the encoder stages."""
    dec_channels: tuple[int, ...] = (96, 96, 128, 256)
    """Channels of the decoder stages."""
    dec_depths: tuple[int, ...] = (2, 2, 2, 2)
    """Blocks of the decoder stages."""
    dec_heads: tuple[int, ...] = (4, 4, 4, 4)
    """Attention heads of the decoder stages."""
    patch: int = 1024
    """Number of points in an attention patch."""
    mlp_ratio: int = 4
    """Hidden width of a block's MLP over its channels."""
    drop_path: float = 0.3
    """Probability of dropping the deepest block's branch for a point in training; shallower blocks
    have less."""
    curves: tuple[str, ...] = ("hilbert", "hilbert-trans", "z", "z-trans")
    """Serialization curves; block i of a stage uses curve i (shuffled in training). Memory is laid
    out by the first."""
    norm: Literal["scene", "batch", "layer"] = "scene"
    """Normalisation outside the attention blocks, by each channel's mean and variance over the
    points of the current scene. In evaluation the published ``batch`` uses running averages over
    scenes, which fit no single scene. ``layer`` normalises each point by itself, so that its result
    does not depend on the rest of the scene."""
    units: Literal["scene", "local"] = "scene"
    """Unit of positions, sizes and their residuals: the scene's extent (published), or ``local``,
    the distance to the nearest neighbours. The encoder then gets statistics of these distances and
    the share of the dense scene's Gaussians that remains."""
    head_width: int = 128
    """Hidden width of the output heads."""
    head_depth: int = 4
    """Number of linear layers of the output heads."""
    means_reach: float = 0.05
    """Largest move of a mean along an axis, as a share of the scene's extent (1.0 in the published
    code), or in local units."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            value = tuple(value) if isinstance(value, list) else value
            setattr(self, field.name, value)
            _check(field.name, str(field.type), value)
        stages = len(self.enc_channels)
        _require(stages >= 1, "enc_channels is empty; expected one entry per stage")
        for name in (
            "enc_depths",
            "enc_heads",
            "strides",
            "dec_channels",
            "dec_depths",
            "dec_heads",
        ):
            entries = len(getattr(self, name))
            size = stages if name.startswith("enc") else stages - 1
            _require(
                entries == size,
                f"{name} has {entries} entries; expected {size} for {stages} encoder stages",
            )
        for part in ("enc", "dec"):
            for c, h in zip(
                getattr(self, f"{part}_channels"), getattr(self, f"{part}_heads"), strict=True
            ):
                _require(c % h == 0, f"{part}: {c} channels do not divide into {h} heads")
        for s in self.strides:
            _require(s & (s - 1) == 0, f"strides holds {s}; expected powers of two")
        _require(bool(self.curves), f"curves is (); expected {', '.join(_NAMES['curves'])}")
        _require(
            self.encoder == "dual" or (self.use_appearance and self.use_position),
            "use_appearance and use_position are switches of the encoder 'dual'; encoder 'concat' "
            "expects both on",
        )

    @property
    def num_rest(self) -> int:
        """SH coefficients of degree 1 and higher for each colour channel."""
        return (self.sh_degree + 1) ** 2 - 1

    @property
    def encoded_dim(self) -> int:
        """Channels per Gaussian that leave the encoder."""
        if self.encoder == "dual":
            return self.feature_dim
        attributes = GEOMETRY + APPEARANCE if self.units == "local" else 14
        return attributes + 3 * self.num_rest

    @property
    def backbone_dim(self) -> int:
        """Channels per Gaussian that leave the backbone."""
        return self.dec_channels[0] if self.dec_channels else self.enc_channels[0]

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> RefinerConfig:
        """The configuration of a file. Raises RefinerConfigError if a field is unknown or fields
        contradict others."""
        unknown = sorted(set(values) - {field.name for field in dataclasses.fields(cls)})
        _require(
            not unknown,
            f"unknown refiner settings {', '.join(unknown)}; a newer version may have written them",
        )
        return cls(**values)


def _check(name: str, kind: str, value: Any) -> None:
    """Check a setting, which files may hold anything for, against its annotation, its names and its
    range."""
    if value is None and "None" in kind:
        return
    parts = value if isinstance(value, tuple) else (value,)
    if name in _NAMES:
        fits = all(part in _NAMES[name] for part in parts)
        expected = ", ".join(_NAMES[name])
    elif kind == "bool":
        fits = isinstance(value, bool)
        expected = "true or false"
    else:
        least, most = _RANGES.get(name, (1, 1 << 16))  # the published network has 1024 at most
        types: Any = (int, float) if kind == "float" else int
        # NaN is in no range
        fits = all(
            isinstance(n, types) and not isinstance(n, bool) and least <= n <= most for n in parts
        )
        expected = f"{'numbers' if kind == 'float' else 'whole numbers'} from {least} to {most}"
    of_its_kind = isinstance(value, tuple) == kind.startswith("tuple")
    _require(fits and of_its_kind, f"{name} is {reprlib.repr(value)}; expected {expected}")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise RefinerConfigError(message)


def refiner_preset(name: str, **changes: Any) -> RefinerConfig:
    """The configuration of a named size, with ``changes`` applied.

    ``full``: the published sizes, 42,762,819 parameters.
    ``small``: 2,414,339 parameters, grid adapted to the scene.
    ``tiny``: 664,563 parameters, grid adapted to the scene.

    Args:
        name: "full", "small" or "tiny".
        changes: fields of :class:`RefinerConfig` that differ from the preset.

    Raises:
        RefinerConfigError: if there is no such preset, or the changes do not fit it.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.refiner_preset("tiny", patch=64).patch
        64
    """
    if name not in PRESETS:
        raise RefinerConfigError(f"no refiner size {name!r}; expected one of {', '.join(PRESETS)}")
    units = LOCAL if changes.get("units") == "local" else {}
    return RefinerConfig(**{**PRESETS[name], **units, **changes})


"""Its name within the package."""


def preset_of(config: RefinerConfig) -> str | None:
    """The preset whose layers a configuration has, whatever its other settings are; None if there
    is none."""
    for name in PRESETS:
        layers = refiner_preset(name)
        if all(getattr(layers, field) == getattr(config, field) for field in _LAYERS):
            return name
    return None


PRESETS: dict[str, dict[str, Any]] = {
    "full": {},
    "small": {
        "grid": None,
        "strides": (2, 2, 2),
        "enc_channels": (32, 64, 96, 96),
        "enc_depths": (2, 2, 2, 2),
        "enc_heads": (2, 4, 6, 6),
        "dec_channels": (48, 64, 80),
        "dec_depths": (1, 1, 1),
        "dec_heads": (3, 4, 5),
        "patch": 256,
        "mlp_ratio": 2,
        "drop_path": 0.0,
        "unit_gate": True,
        "head_width": 96,
    },
    "tiny": {
        "grid": None,
        "strides": (2, 2),
        "enc_channels": (32, 48, 64),
        "enc_depths": (1, 1, 2),
        "enc_heads": (2, 3, 4),
        "dec_channels": (32, 48),
        "dec_depths": (1, 1),
        "dec_heads": (2, 3),
        "patch": 128,
        "mlp_ratio": 2,
        "drop_path": 0.0,
        "unit_gate": True,
        "head_width": 64,
    },
}
"""Values of each size that differ from the defaults of :class:`RefinerConfig`."""

LOCAL: dict[str, Any] = {"units": "local", "norm": "layer", "means_reach": 0.5}
"""Values that differ from these defaults in networks of any size with local units."""
