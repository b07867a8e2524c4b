"""The refiner: a network that repairs all parameters of a pruned scene (paper eq. 4 to 7)."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import zero_as_identity
from pointsplat_ns.refinement.config import RefinerConfig, preset_of
from pointsplat_ns.refinement.local_units import (
    LocalUnits,
    local_features,
    moved_in_local_units,
)
from pointsplat_ns.refinement.network import (
    ConcatEncoder,
    DualBranchEncoder,
    Features,
    PointTransformer,
    ResidualHeads,
)
from pointsplat_ns.refinement.sparse_ops import permute
from pointsplat_ns.refinement.structure import Structure, UnitCube, build_structure, structure_key
from pointsplat_ns.scene.gaussians import Gaussians


class Refiner(nn.Module):
    """Adds a residual, computed by one feed-forward network, to every parameter of a scene.

    In an untrained network all residuals are zero and the scene is unchanged to the bit, except
    that zero quaternions become the identity.

    Gaussians that cannot be drawn (see :meth:`~pointsplat_ns.scene.gaussians.Gaussians.usable`) are
    returned unchanged and do not affect the others. In evaluation a Gaussian is also returned
    unchanged if its refined values could not be drawn. In training such values are returned, so
    that they show in the loss.

    Residuals do not depend on the scene's unit and position, on the order of its Gaussians (in
    evaluation; exact duplicates are interchangeable) or on the signs of its quaternions.

    Args:
        config: the network's layers.
        device: where its parameters, float32, are made; "meta" for shapes without memory.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.Refiner(ps.refiner_preset("tiny"))
        Refiner(tiny, 664,563 parameters, encoder dual, units scene, cpu)
    """

    def __init__(self, config: RefinerConfig, device: torch.device | str = "cpu"):
        super().__init__()
        self.config = config
        with torch.device(device):
            self.encoder = (
                DualBranchEncoder(config) if config.encoder == "dual" else ConcatEncoder()
            )
            self.backbone = PointTransformer(config.encoded_dim, config)
            self.heads = ResidualHeads(config.backbone_dim + config.encoded_dim, config)

    def __repr__(self) -> str:
        """One line, where torch would print every layer."""
        count = sum(parameter.numel() for parameter in self.parameters())
        return (
            f"{type(self).__name__}({preset_of(self.config) or 'own size'}, {count:,} parameters, "
            f"encoder {self.config.encoder}, units {self.config.units}, {self.device})"
        )

    def prepare(self, scene: Gaussians) -> Structure | None:
        """Build the neighbour tables of a scene's positions, on the scene's device.

        Build them once for a scene and pass them to :meth:`forward` at every step. None if no
        Gaussian can be drawn. Raises SceneError if the SH degree exceeds the network's.
        """
        if scene.sh_degree > self.config.sh_degree:
            raise SceneError(
                f"the scene has SH degree {scene.sh_degree}; this refiner was built for at most "
                f"{self.config.sh_degree}"
            )
        usable = scene.usable()
        if usable.all():
            return build_structure(scene, self.config) if len(scene) else None
        if not usable.any():
            return None
        return dataclasses.replace(build_structure(scene[usable], self.config), usable=usable)

    def forward(
        self, scene: Gaussians, structure: Structure | None = None, kept: float = 0.1
    ) -> Gaussians:
        """The refined scene, in the frame, dtype and order of ``scene``.

        Args:
            scene: N Gaussians of at most the network's SH degree.
            structure: the result of :meth:`prepare` for these positions; None builds it here.
            kept: share of the dense scene's Gaussians that the scene holds, in (0, 1]; networks
                with local units use it.

        Raises:
            SceneError: if the scene cannot be refined (see :meth:`prepare`).
            ValueError: if the structure is of another number of Gaussians or configuration.
        """
        if structure is None:
            structure = self.prepare(scene)
        if structure is None:
            return scene
        if structure.total != len(scene) or structure.built_for != structure_key(self.config):
            raise ValueError(
                f"structure of {structure.total} Gaussians and settings {structure.built_for} "
                f"given for {len(scene)} Gaussians and settings {structure_key(self.config)}; call "
                "prepare(scene) again"
            )
        some = scene if structure.usable is None else scene[structure.usable]
        if structure.local is not None:
            refined = self._in_local_units(some, structure, structure.local, kept)
        else:
            raw = self.config.raw_inputs
            features = gaussian_features(
                some, structure.cube, self.config.num_rest, self.dtype, raw
            )
            residuals = self.residuals(features, structure)
            refined = _moved(some, residuals, features.quat_scale, structure.cube.extent)
        if not self.training and not (sound := refined.usable()).all():
            refined = _put_back(refined[sound], sound, some)
        return refined if structure.usable is None else _put_back(refined, structure.usable, scene)

    def residuals(self, features: Features, structure: Structure) -> dict[str, Tensor]:
        """Residuals by attribute, in the network's units and the scene's order. # {name: [N,
        size]}"""
        in_memory = {
            name: permute(value, structure.order, structure.inverse)
            for name, value in vars(features).items()
        }
        encoded = self.encoder(Features(**in_memory))
        residuals = self.heads(torch.cat([self.backbone(encoded, structure), encoded], dim=1))
        return {
            name: permute(value, structure.inverse, structure.order)
            for name, value in residuals.items()
        }

    def _in_local_units(
        self, scene: Gaussians, structure: Structure, units: LocalUnits, kept: float
    ) -> Gaussians:
        """The refined scene, of usable Gaussians, by a network with local units."""
        in_memory = scene[structure.order]
        features = local_features(in_memory, units, self.config.num_rest, kept, self.dtype)
        encoded = self.encoder(features)
        residuals = self.heads(torch.cat([self.backbone(encoded, structure), encoded], dim=1))
        return moved_in_local_units(in_memory, units, residuals)[structure.inverse]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by name of their learning rate: ``encoder``, ``backbone``, and the attribute
        of each head."""
        groups = {
            "encoder": list(self.encoder.parameters()),
            "backbone": list(self.backbone.parameters()),
        }
        groups.update({name: list(mlp.parameters()) for name, mlp in self.heads.mlps.items()})
        return {name: parameters for name, parameters in groups.items() if parameters}

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the network."""
        return next(self.parameters()).dtype

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return next(self.parameters()).device


def _moved(
    scene: Gaussians, residuals: dict[str, Tensor], quat_scale: Tensor, extent: Tensor
) -> Gaussians:
    """A scene with residuals in the network's units added."""
    steps = {
        name: residual.to(scene.dtype) for name, residual in residuals.items() if name != "means"
    }
    steps["means"] = (residuals["means"].double() * extent).to(scene.dtype)
    steps["quats"] = steps["quats"] * quat_scale
    if "features_rest" in steps:
        steps["features_rest"] = steps["features_rest"].view(len(scene), -1, 3)[
            :, : scene.features_rest.shape[1]
        ]
    start = scene.replace(quats=zero_as_identity(scene.quats))
    return scene.replace(**{name: getattr(start, name) + step for name, step in steps.items()})


def _put_back(rows: Gaussians, mask: Tensor, scene: Gaussians) -> Gaussians:
    """``scene`` with the Gaussians of ``mask`` replaced by ``rows``, in order."""
    place = mask.nonzero()[:, 0]
    values = zip(scene.items(), rows.tensors(), strict=True)
    return scene.replace(
        **{name: before.index_copy(0, place, after) for (name, before), after in values}
    )


def gaussian_features(
    scene: Gaussians, cube: UnitCube, num_rest: int, dtype: torch.dtype, raw: bool = False
) -> Features:
    """Network input of a scene of N usable Gaussians, with its unit cube, for so many SH
    coefficients of degree 1 and higher a colour channel, in the network's floating type.

    The input does not depend on the scene's unit and position. Only the input is clamped: residuals
    are added to the original parameters. Trained weights depend on these units and limits. With
    ``raw``, log-scales in units of the cube and logits are clamped alike, but neither shifted nor
    scaled to order 1.
    """
    # -5 is a typical log-scale in the unit cube: 4 cm in a room of 6 m
    centre, spread, logit_spread = (0.0, 1.0, 1.0) if raw else (-5.0, 2.0, 4.0)
    log_scales = (scene.scales.double() - cube.extent.log() - centre) / spread
    low, high = ((bound - centre) / spread for bound in (-17.0, 7.0))
    logits = (
        scene.opacities.clamp(-12.0, 12.0) / logit_spread
    )  # beyond 12, opacity is 0 or 1 within 1e-5
    sh_limit = 8.0  # displayable colours need at most 1.8
    quats, quat_scale = canonical_quats(scene.quats)
    rest = scene.features_rest.flatten(1).clamp(-sh_limit, sh_limit).to(dtype)
    return Features(
        positions=cube.positions(scene.means).to(dtype),
        quats=quats.to(dtype),
        scales=log_scales.clamp(low, high).to(dtype),
        opacities=logits.to(dtype),
        features_dc=scene.features_dc.clamp(-sh_limit, sh_limit).to(dtype),
        features_rest=torch.nn.functional.pad(rest, (0, 3 * num_rest - rest.shape[1])),
        quat_scale=quat_scale,
    )


def canonical_quats(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Unit quaternions (N, 4) of one sign, and their signed lengths (N, 1), of finite wxyz of any
    length.

    The first non-zero component of the result is positive. Quaternions shorter than
    :data:`~pointsplat_ns.geometry.transforms.SHORTEST` become the identity, with a length of 1.
    Components are divided by the largest before squaring, so that 1e-30 does not underflow and 1e30
    does not overflow.
    """
    quats = zero_as_identity(quats)
    largest = quats.abs().amax(dim=1, keepdim=True).detach()
    scaled = quats / largest
    length = scaled.norm(dim=1, keepdim=True)
    first = (scaled != 0).to(torch.uint8).argmax(dim=1, keepdim=True)
    sign = torch.where(scaled.gather(1, first) < 0, -1.0, 1.0).to(quats.dtype)
    top = torch.finfo(quats.dtype).max
    signed = (sign * length * largest).clamp(-top, top)
    return scaled * sign / length, signed
