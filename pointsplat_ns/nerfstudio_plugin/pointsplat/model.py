"""The PointSplat model: a dense scene is pruned once, refined by one network, and rendered.

To nerfstudio's viewer and exporter it is a Splatfacto model, whose Gaussians are the refined ones
of one scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor
from tyro.conf import arg

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.metrics import PIXEL_LOSSES, ImageError, PixelLoss, psnr
from pointsplat_ns.metrics.lpips import LpipsUnavailable, cached_lpips
from pointsplat_ns.nerfstudio_plugin.cameras import RasterizerOptions, carried, need_pinhole
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.pieces import ScenePiece
from pointsplat_ns.pipeline.trained_refiner import (
    NETWORK_OPTIONS,
    load_refiner,
    network_options,
)
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refinement import Refiner, Structure, refiner_preset
from pointsplat_ns.refinement.augmentation import random_transform
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import in_unit_range

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManager


@dataclass
class PointSplatModelConfig(RasterizerOptions, ModelConfig):
    """Which Gaussians are kept, and the network that repairs them"""

    _target: type = field(default_factory=lambda: PointSplatModel)
    keep: str = "30%"
    """Gaussians to keep, as of the command: a percentage (30%), a ratio (0.3), or a count (50000,
    50k, 10gaussians)."""
    more_keeps: tuple[str, ...] = ()
    """Further values of keep. Each training step draws one of all values at random, so that one
    network learns to repair scenes of several budgets. Evaluation uses keep."""
    augment: bool = False
    """Rotate, mirror and recolour each training scene at random, so that the network learns neither
    the up direction nor the colours of the training scenes. The target images do not change. A
    scene's neighbour tables are then computed anew at each step."""
    by: str = "paper"
    """Pruning method. paper keeps the Gaussians with the highest score of eq. 3; authors takes the
    formula of the released code, and opacity, coverage and random are other scores. merge, which is
    not the paper's, replaces neighbours by one Gaussian each. lightgaussian and pup score by views,
    which a training does not have; pointsplat prune has them."""
    opacity_weight: Annotated[
        float | None, arg(aliases=("--lambda", "--pipeline.model.lambda"))
    ] = None
    """Lambda of paper and authors, in [0, 1]: the weight of opacity against volume; by default the
    paper's 0.3."""
    size: Literal["tiny", "small", "full"] = "small"
    """Size of the network: full is the paper's and needs a GPU; small and tiny are for a CPU."""
    encoder: Literal["dual", "concat"] = "dual"
    """dual is the paper's dual-branch encoder; concat feeds one concatenated vector, as SplatFormer
    does."""
    use_appearance: bool = True
    """Gate the geometry branch by the appearance branch (the paper's Table 4); dual encoder
    only."""
    use_position: bool = True
    """Add the positional term delta to both branches (the paper's Table 4); dual encoder only."""
    units: Literal["scene", "local"] = "scene"
    """Unit of positions, sizes and their residuals: the scene's extent, as published, or the
    distance of each Gaussian to its neighbours, so that a piece and a whole scene mean the same."""
    norm: Literal["scene", "batch", "layer"] | None = None
    """Normalisation outside the attention blocks. scene: statistics of the current scene, also in
    evaluation. batch: the published one, with running averages over the training scenes in
    evaluation. layer: of each Gaussian by itself. By default layer with local units, else scene."""
    enc_depths: tuple[int, ...] | None = None
    """Blocks in each stage of the backbone's encoder; by default those of size."""
    stem: Literal["conv", "linear"] = "conv"
    """First layer of the backbone: a convolution over neighbours, or a linear layer (the authors'
    code)."""
    raw_inputs: bool = False
    """Give the network log-scales and opacity logits as they are, not brought to order 1. With the
    encoder concat this is the imbalance of features that the paper speaks of."""
    means_reach: float | None = None
    """Largest move of a mean along an axis, as a share of the scene's extent (the authors' code:
    1), or in local units; by default 0.05, or 0.5 in local units."""
    train_encoder: bool = True
    """Train the encoder. The authors' code leaves it at its random weights."""
    pixel_loss: PixelLoss = "l1"
    """Pixel loss: mean absolute difference, or root mean squared difference, which determines the
    PSNR."""
    lpips_weight: float = 0.1
    """Weight of LPIPS in the loss; the pixel loss has weight 1."""
    lpips_net: Literal["auto", "alex", "vgg"] = "auto"
    """Network of LPIPS in the training loss. auto is vgg on CUDA, and elsewhere alex, which is
    thirty times cheaper."""

    init: str | None = None
    """Weights to start from; set by --init, which takes the options of that network, too."""

    sh_degree: ClassVar[int] = 3
    """Read by ``ns-export``: above 0, colours are SH coefficients. A scene may have any degree."""

    def prune_settings(self, keep: str | float | None = None) -> PruneSettings:
        """How scenes are pruned; ``keep`` is the config's own by default, and a number in runs of
        earlier versions. Raises PointSplatError if the settings fit no scene."""
        keep = self.keep if keep is None else keep
        return PruneSettings.of(keep, self.by, self.opacity_weight)


def take_network_of(init: str, config: PointSplatModelConfig) -> None:
    """Start from a trained refiner (``shipped``, a file or a run): set the config to the options of
    its network. Raises WeightsError or SceneError if there is no such refiner, and SceneError if no
    options give its network."""
    trained = load_refiner(init, "cpu", config.by)
    for name in ("size", *NETWORK_OPTIONS):
        if name in trained.options:
            setattr(config, name, trained.options[name])
    if refiner_preset(config.size, **network_options(vars(config))) != trained.network.config:
        raise SceneError(
            f"--init {init}: no options of ns-train give its network; expected one that ns-train "
            "pointsplat trained"
        )
    config.init = init


class PrunedScene(NamedTuple):
    """A pruned scene, on the device of the network, its neighbour tables, None if it is empty, and
    the share of the dense scene's Gaussians that was kept."""

    pruned: Gaussians
    structure: Structure | None
    kept: float


class PointSplatModel(SplatfactoModel):
    """Prunes, refines and draws the scenes of the ``datamanager`` that it is given."""

    config: PointSplatModelConfig  # type: ignore[assignment]  # Splatfacto's options would have no effect here

    def populate_modules(self) -> None:
        """Build the network. The Gaussians of scenes are not parameters of the model."""
        config = self.config
        for keep in (config.keep, *config.more_keeps):
            config.prune_settings(keep)
        manager: ScenesDataManager = self.kwargs["datamanager"]
        self.refiner = Refiner(refiner_preset(config.size, **network_options(vars(config))))
        if config.init is not None and manager.test_mode == "val":
            trained = load_refiner(config.init, "cpu", config.by)
            self.refiner.load_state_dict(trained.network.state_dict())
        self.refiner.encoder.requires_grad_(config.train_encoder)
        self.crop_box: OrientedBox | None = None
        manager.prune_settings = tuple(
            config.prune_settings(keep) for keep in (config.keep, *config.more_keeps)
        )
        self.scenes = manager.scenes
        self.shown = manager.shown
        self._cache = manager.cache
        self.no_lpips_reason: str | None = None
        """Why LPIPS is left out of the loss; None while it is part of it."""
        self._refined: tuple[int, Gaussians] | None = None

    def load_state_dict(self, dict, **kwargs):  # type: ignore[override]
        """Load the network's weights. Raises SceneError if they are those of another network;
        nerfstudio would load the part that fits."""
        self._refined = None
        try:
            return torch.nn.Module.load_state_dict(self, dict, **{**kwargs, "strict": True})
        except RuntimeError as error:
            options = ", ".join(
                f"{name} {value}" for name, value in network_options(vars(self.config)).items()
            )
            raise SceneError(
                f"the checkpoint does not hold a network of size {self.config.size} with "
                f"{options}; expected the settings that it was trained with"
            ) from error

    def get_training_callbacks(self, training_callback_attributes) -> list:
        """None: there is no densification."""
        return []

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """The network's parameters that are trained, by part: encoder, backbone and one head per
        attribute."""
        groups = self.refiner.parameter_groups()
        return {
            name: parts
            for name, parts in groups.items()
            if name != "encoder" or self.config.train_encoder
        }

    def pruned_scene(
        self, index: int, dense: Gaussians | None = None, keep: str | float | None = None
    ) -> PrunedScene:
        """A pruned scene by its index, from memory if it was pruned before. ``dense`` are its
        Gaussians, if they have been read; ``keep`` is by default the config's. Raises a
        PointSplatError that names the scene if the settings do not fit it."""
        scene = self.scenes[index]
        settings = self.config.prune_settings(keep)
        key = "pruned", scene.name, settings
        found = self._cache.get(key)
        if found is None:
            try:
                smaller, kept = scene.pruned(settings, dense)
            except PointSplatError as error:
                raise type(error)(f"{scene.source}: {error}") from error
            if not isinstance(scene, ScenePiece):
                log(f"{scene.name}: kept {len(smaller):,} Gaussians, {kept:.1%}")
            smaller = smaller.to(self.device)
            # An augmented piece gets tables of its own at each step.
            piece = self.config.augment and isinstance(scene, ScenePiece)
            found = PrunedScene(smaller, None if piece else self.refiner.prepare(smaller), kept)
            self._cache.put(key, found)
        return found

    def refine(self, index: int) -> Gaussians:
        """The refined scene; differentiable in training, cached in evaluation."""
        if self.training:
            self._refined = None
            keeps: tuple[str | float, ...] = (self.config.keep, *self.config.more_keeps)
            # the first random number of a step, if there are several budgets
            drawn = int(torch.randint(len(keeps), (), device="cpu")) if len(keeps) > 1 else 0
            scene = self.pruned_scene(index, keep=keeps[drawn])
            if not self.config.augment:
                return self.refiner(*scene)
            transform = random_transform()
            return transform.undo(self.refiner(transform.apply(scene.pruned), kept=scene.kept))
        if self._refined is None or self._refined[0] != index:
            scene = self.pruned_scene(index)
            with torch.no_grad():
                self._refined = index, self.refiner(*scene)
        return self._refined[1]

    def draw(
        self,
        gaussians: Gaussians,
        scene: DenseScene,
        camera: Cameras,
        background: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Render Gaussians as a scene is drawn, from a camera of shape (1,): ``rgb`` (H, W, 3) in
        [0, 1], ``accumulation`` (H, W, 1), ``background`` (H, W, 3), and in evaluation ``depth``
        (H, W, 1) in scene units. The ``background`` (3,) or (H, W, 3) is by default the scene's."""
        width = int(camera.width.item())
        height = int(camera.height.item())
        image, alpha, _ = self.config.rasterize(
            training=self.training,
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.stds,
            opacities=gaussians.alphas,
            colors=(gaussians.features_dc, gaussians.features_rest),
            viewmats=viewmats_from_opengl(camera.camera_to_worlds),
            Ks=camera.get_intrinsics_matrices(),
            width=width,
            height=height,
            **carried(camera),
            sh_degree=gaussians.sh_degree,
            render_mode="RGB" if self.training else "RGB+ED",
            rasterize_mode="antialiased" if gaussians.antialiased else scene.rasterize_mode,
        )
        background = (scene.background if background is None else background).to(image)
        outputs = {
            "rgb": (image[0, ..., :3] + (1 - alpha[0]) * background).clamp(0, 1),
            "accumulation": alpha[0],
            "background": background.expand(height, width, 3),
        }
        if not self.training:
            depth = image[0, ..., 3:]
            outputs["depth"] = torch.where(alpha[0] > 0, depth, depth.max())
        return outputs

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:  # type: ignore[override]  # models of rays take those
        """The shown scene, refined, from one camera; inside the viewer's crop box if there is
        one."""
        need_pinhole(camera)
        gaussians = self.gaussians
        if self.crop_box is not None and not self.training:
            gaussians = gaussians[self.crop_box.within(gaussians.means).reshape(-1)]
        return self.draw(gaussians, self.scenes[self.shown], camera)

    def losses(
        self, index: int, frames: list[tuple[Cameras, dict]]
    ) -> tuple[dict, dict[str, Tensor], dict]:
        """Refine a scene, by its index, and compare its renders with photos from their cameras of
        shape (1,): outputs of the last photo's camera; the pixel loss and the weighted LPIPS,
        averaged over the photos; and metrics to log. Once LPIPS could not be computed it stays left
        out, so that the loss does not change back."""
        config = self.config
        refined = self.refine(index)
        scene = self.scenes[index]
        outputs: dict[str, Tensor] = {}
        pairs = []
        for camera, data in frames:
            outputs = self.draw(refined, scene, camera, scene.training_background(data))
            mask = data.get("mask", 1)
            pairs.append((outputs["rgb"] * mask, self.photo_of(data, outputs["background"]) * mask))
        pixel_loss = torch.stack(
            [PIXEL_LOSSES[config.pixel_loss](render - photo) for render, photo in pairs]
        ).mean()
        losses: dict[str, Tensor] = {config.pixel_loss: pixel_loss}
        if config.lpips_weight > 0 and self.no_lpips_reason is None:
            cheap: Literal["alex", "vgg"] = "vgg" if self.device.type == "cuda" else "alex"
            try:
                lpips = cached_lpips(
                    cheap if config.lpips_net == "auto" else config.lpips_net, pairs[0][0].device
                )
                losses["lpips"] = (
                    config.lpips_weight * torch.stack([lpips(*pair) for pair in pairs]).mean()
                )
            except (
                LpipsUnavailable,
                ImageError,
            ) as error:  # no weights, or a picture too small for the network
                self.no_lpips_reason = str(error)
                log(f"going on without LPIPS in the loss: {error}")
        quality = torch.stack([psnr(render.detach(), photo) for render, photo in pairs]).mean()
        return outputs, losses, {"psnr": quality, "gaussian_count": len(refined)}

    def photo_of(self, data: dict[str, Any], background: Tensor) -> Tensor:
        """A photo (H, W, 3) in [0, 1], composited over ``background`` if it has an alpha
        channel."""
        return self.composite_with_background(
            in_unit_range(data["image"]).to(self.device), background
        )

    @property
    def gaussians(self) -> Gaussians:
        """The shown scene, refined as in evaluation also while a training is looked at."""
        training = self.training
        self.eval()
        try:
            return self.refine(self.shown).detach()
        finally:
            self.train(training)

    @property
    def gauss_params(self) -> dict[str, Tensor]:  # type: ignore[override]
        """The shown scene's parameters by Splatfacto's names, for nerfstudio's viewer and
        exporter."""
        return dict(self.gaussians.items())
