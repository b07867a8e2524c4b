"""The refiner: a scene in, the same scene with every parameter repaired out (paper eq. 4 to 7)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.config import RefinerConfig
from pointsplat_ns.refiner.encoder import make_encoder
from pointsplat_ns.refiner.heads import ResidualHeads
from pointsplat_ns.refiner.normalize import Features, gaussian_features
from pointsplat_ns.refiner.point_transformer import PointTransformer
from pointsplat_ns.refiner.sparse_ops import permute
from pointsplat_ns.refiner.structure import Structure, build_structure, structure_key


class Refiner(nn.Module):
    """Adds to every parameter of a scene a residual that one feed-forward network computes.

    Untrained, all residuals are zero and the scene comes out as it went in, to the bit. The one
    exception is a zero quaternion, which comes out as the identity that it stands for.

    Residuals do not depend on the scene's unit and place, on the order of its Gaussians (in
    evaluation; exact duplicates are interchangeable) or on the signs of its quaternions.

    Example:
        >>> from pointsplat_ns.refiner import Refiner, preset
        >>> refiner = Refiner(preset("tiny")).eval()
        >>> len(refiner(Gaussians.empty(sh_degree=3)))
        0
    """

    def __init__(self, config: RefinerConfig):
        super().__init__()
        self.config = config
        self.encoder = make_encoder(config)
        self.backbone = PointTransformer(config.encoded_dim, config)
        self.heads = ResidualHeads(config.backbone_dim + config.encoded_dim, config)

    def prepare(self, scene: Gaussians) -> Structure | None:
        """What the network needs to know of a scene's positions, on the scene's device.

        Build it once per scene and hand it to :meth:`forward` at every step. None for a scene of no
        Gaussians.

        Raises:
            SceneError: if a Gaussian cannot be drawn, or the SH degree exceeds the network's.
        """
        if scene.sh_degree > self.config.sh_degree:
            raise SceneError(
                f"the scene has SH degree {scene.sh_degree}; this refiner was built for at most {self.config.sh_degree}"
            )
        bad = int((~scene.usable()).sum())
        if bad:
            raise SceneError(
                f"{bad} of {len(scene)} Gaussians have NaN or infinite parameters; drop them with scene[scene.usable()]"
            )
        return build_structure(scene, self.config) if len(scene) else None

    def forward(self, scene: Gaussians, structure: Structure | None = None) -> Gaussians:
        """The refined scene, in the space, dtype and order of the given one.

        Args:
            scene: N usable Gaussians of an SH degree up to the configuration's.
            structure: of these positions, from :meth:`prepare`; built here if missing.

        Raises:
            SceneError: if the scene cannot be refined (see :meth:`prepare`).
            ValueError: if the structure belongs to another number of Gaussians or configuration.
        """
        if structure is None:
            structure = self.prepare(scene)
        if structure is None:
            return scene
        if len(structure.order) != len(scene) or structure.built_for != structure_key(self.config):
            raise ValueError(
                f"structure of {len(structure.order)} Gaussians and settings {structure.built_for} given for "
                f"{len(scene)} Gaussians and settings {structure_key(self.config)}; call prepare(scene) again"
            )
        features = gaussian_features(scene, structure.cube, self.config.num_rest, self.dtype)
        residuals = self.residuals(features, structure)
        return self._add(scene, residuals, features, structure)

    def residuals(self, features: Features, structure: Structure) -> dict[str, Tensor]:
        """The network proper: residuals by attribute, in network units and scene order. # {name: [N, size]}"""
        encoded = self.encoder(features.permute(structure.order, structure.inverse))
        residuals = self.heads(torch.cat([self.backbone(encoded, structure), encoded], dim=1))
        return {name: permute(value, structure.inverse, structure.order) for name, value in residuals.items()}

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the name under which a learning rate may be set: ``encoder``, ``backbone`` and the heads'."""
        groups = {"encoder": list(self.encoder.parameters()), "backbone": list(self.backbone.parameters())}
        groups.update({name: list(mlp.parameters()) for name, mlp in self.heads.mlps.items()})
        return {name: parameters for name, parameters in groups.items() if parameters}

    @property
    def dtype(self) -> torch.dtype:
        """Floating type of the network."""
        return next(self.parameters()).dtype

    def _add(
        self, scene: Gaussians, residuals: dict[str, Tensor], features: Features, structure: Structure
    ) -> Gaussians:
        moved = (residuals["means"].double() * structure.cube.extent).to(scene.dtype)
        turned = residuals["quats"].to(scene.dtype) * features.quat_scale
        identity = torch.zeros_like(scene.quats)
        identity[:, 0] = 1
        quats = torch.where((scene.quats == 0).all(dim=1, keepdim=True), identity, scene.quats)
        rest = scene.features_rest
        if "features_rest" in residuals:
            wanted = residuals["features_rest"].view(len(scene), -1, 3)[:, : rest.shape[1]]
            rest = rest + wanted.to(scene.dtype)
        return Gaussians(
            means=scene.means + moved,
            scales=scene.scales + residuals["scales"].to(scene.dtype),
            quats=quats + turned,
            opacities=scene.opacities + residuals["opacities"].to(scene.dtype),
            features_dc=scene.features_dc + residuals["features_dc"].to(scene.dtype),
            features_rest=rest,
        )
