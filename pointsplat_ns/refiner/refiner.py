"""The refiner: a network that repairs all parameters of a pruned scene (paper eq. 4 to 7)."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import zero_as_identity
from pointsplat_ns.refiner.config import RefinerConfig
from pointsplat_ns.refiner.encoder import make_encoder
from pointsplat_ns.refiner.heads import ResidualHeads
from pointsplat_ns.refiner.normalize import Features, gaussian_features
from pointsplat_ns.refiner.point_transformer import PointTransformer
from pointsplat_ns.refiner.sparse_ops import permute
from pointsplat_ns.refiner.structure import Structure, build_structure, structure_key


class Refiner(nn.Module):
    """Adds a residual, computed by one feed-forward network, to every parameter of a scene.

    In an untrained network all residuals are zero and the scene is unchanged to the bit, except that zero quaternions
    become the identity.

    Gaussians that cannot be drawn (see :meth:`~pointsplat_ns.gaussians.Gaussians.usable`) are returned unchanged and do
    not affect the others. In evaluation a Gaussian is also returned unchanged if its refined values could not be drawn.
    In training such values are returned, so that they show in the loss.

    Residuals do not depend on the scene's unit and position, on the order of its Gaussians (in evaluation; exact
    duplicates are interchangeable) or on the signs of its quaternions.

    Args:
        config: the network's layers.
        device: where its parameters, float32, are made; "meta" for shapes without memory.

    Example:
        >>> from pointsplat_ns.refiner import Refiner, preset
        >>> refiner = Refiner(preset("tiny")).eval()
        >>> len(refiner(Gaussians.empty(sh_degree=3)))
        0
    """

    def __init__(self, config: RefinerConfig, device: torch.device | str = "cpu"):
        super().__init__()
        self.config = config
        with torch.device(device):
            self.encoder = make_encoder(config)
            self.backbone = PointTransformer(config.encoded_dim, config)
            self.heads = ResidualHeads(config.backbone_dim + config.encoded_dim, config)

    def prepare(self, scene: Gaussians) -> Structure | None:
        """Build the neighbour tables of a scene's positions, on the scene's device.

        Build them once for a scene and pass them to :meth:`forward` at every step. None if no Gaussian can be drawn.
        Raises SceneError if the SH degree exceeds the network's.
        """
        if scene.sh_degree > self.config.sh_degree:
            raise SceneError(
                f"the scene has SH degree {scene.sh_degree}; this refiner was built for at most {self.config.sh_degree}"
            )
        usable = scene.usable()
        if usable.all():
            return build_structure(scene, self.config) if len(scene) else None
        if not usable.any():
            return None
        return dataclasses.replace(build_structure(scene[usable], self.config), usable=usable)

    def forward(self, scene: Gaussians, structure: Structure | None = None) -> Gaussians:
        """The refined scene, in the frame, dtype and order of ``scene``.

        Args:
            scene: N Gaussians of at most the network's SH degree.
            structure: the result of :meth:`prepare` for these positions; None builds it here.

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
                f"structure of {structure.total} Gaussians and settings {structure.built_for} given for "
                f"{len(scene)} Gaussians and settings {structure_key(self.config)}; call prepare(scene) again"
            )
        if structure.usable is None:
            return self._refine(scene, structure)
        return _put_back(self._refine(scene[structure.usable], structure), structure.usable, scene)

    def _refine(self, scene: Gaussians, structure: Structure) -> Gaussians:
        """The refined scene of usable Gaussians."""
        features = gaussian_features(scene, structure.cube, self.config.num_rest, self.dtype)
        refined = self._add(scene, self.residuals(features, structure), features, structure)
        if self.training or (sound := refined.usable()).all():
            return refined
        return _put_back(refined[sound], sound, scene)

    def residuals(self, features: Features, structure: Structure) -> dict[str, Tensor]:
        """Residuals by attribute, in the network's units and the scene's order. # {name: [N, size]}"""
        encoded = self.encoder(features.permute(structure.order, structure.inverse))
        residuals = self.heads(torch.cat([self.backbone(encoded, structure), encoded], dim=1))
        return {name: permute(value, structure.inverse, structure.order) for name, value in residuals.items()}

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by name of their learning rate: ``encoder``, ``backbone``, and the attribute of each head."""
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
        rest = scene.features_rest
        if "features_rest" in residuals:
            wanted = residuals["features_rest"].view(len(scene), -1, 3)[:, : rest.shape[1]]
            rest = rest + wanted.to(scene.dtype)
        return scene.replace(
            means=scene.means + moved,
            scales=scene.scales + residuals["scales"].to(scene.dtype),
            quats=zero_as_identity(scene.quats) + turned,
            opacities=scene.opacities + residuals["opacities"].to(scene.dtype),
            features_dc=scene.features_dc + residuals["features_dc"].to(scene.dtype),
            features_rest=rest,
        )


def _put_back(rows: Gaussians, mask: Tensor, scene: Gaussians) -> Gaussians:
    """``scene`` with the Gaussians of ``mask`` replaced by ``rows``, in order."""
    place = mask.nonzero()[:, 0]
    values = zip(scene.items(), rows.tensors(), strict=True)
    return scene.replace(**{name: before.index_copy(0, place, after) for (name, before), after in values})
