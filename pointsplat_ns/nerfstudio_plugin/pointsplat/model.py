"""The PointSplat model: a dense scene is pruned once, refined by one network, and rendered.

To nerfstudio it is a Splatfacto model whose Gaussians are the refined ones of one scene, so that the
viewer and ``ns-export gaussian-splat`` work on it unchanged. Only the network is trained and saved.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.splatfacto import SH2RGB
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.compression.trained_refiner import network_options
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import viewmats_from_opengl
from pointsplat_ns.metrics import ImageError, psnr
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.nerfstudio_plugin.frames import FrameCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.nerfstudio_plugin.pointsplat.pruned_store import read_pruned, stored_path, write_pruned
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModel, SplatfactoCpuModelConfig
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Refiner, Structure, preset
from pointsplat_ns.refiner.augmentation import random_transform

PIXEL_LOSSES = {
    "l1": lambda difference: difference.abs().mean(),
    # 1e-12 (120 dB) keeps the slope of the root finite where nothing differs.
    "rmse": lambda difference: (difference.square().mean() + 1e-12).sqrt(),
}
"""What a picture's difference (H, W, 3) costs, by the name of the loss."""

_PRUNED = "pruned"
"""Names pruned scenes among what is kept in the cache."""


@dataclass
class PointSplatModelConfig(SplatfactoCpuModelConfig):
    """Which Gaussians are kept, and the network that repairs them"""

    _target: type = field(default_factory=lambda: PointSplatModel)
    keep: float = 0.3
    """Gaussians to keep: a ratio in (0, 1], or a count if above 1."""
    more_keeps: tuple[float, ...] = ()
    """Further amounts to keep, as ``keep``: each training step draws one of them all, so that one network learns to
    repair scenes of many budgets. Evaluation takes ``keep``."""
    augment: bool = False
    """Train on each scene turned, mirrored and repainted at random, so that the network learns neither which way is up
    nor the colours of the training scenes. The pictures it is compared with stay as they are; the price is that
    a scene's neighbour tables are computed at each step."""
    pruned_folder: Path | None = None
    """Folder for pruned scenes, which other trainings on the same scenes then need not make again."""
    by: str = "merge"
    """How they are chosen: merge puts one Gaussian in the place of neighbours; a score leaves Gaussians out: coverage,
    paper (eq. 3), authors, opacity, volume, log-volume, area or random."""
    opacity_weight: float | None = None
    """Lambda of paper, authors and log-volume: the weight of opacity against volume; by default the paper's 0.3."""
    size: Literal["tiny", "small", "full"] = "small"
    """Size of the network: full is the paper's and wants a GPU; small and tiny are for a CPU."""
    encoder: Literal["dual", "concat"] = "dual"
    """dual is the paper's dual-branch encoder; concat feeds one concatenated vector, as SplatFormer does."""
    use_appearance: bool = True
    """Gate the geometry by what a Gaussian looks like (the paper's Table 4); dual encoder only."""
    use_position: bool = True
    """Add the positional term delta to both branches (the paper's Table 4); dual encoder only."""
    norm: Literal["scene", "batch", "layer"] = "scene"
    """Normalisation outside the attention blocks: scene takes statistics of the scene at hand, in evaluation too; batch
    is the published one, which evaluates with running averages over the training scenes; layer is by Gaussian."""
    pixel_loss: Literal["l1", "rmse"] = "l1"
    """What the loss compares pixels by: their mean difference, or the root of the mean squared one, which PSNR is
    measured by."""
    lpips_weight: float = 0.1
    """Weight of LPIPS in the loss, beside that of pixels."""
    lpips_net: Literal["auto", "alex", "vgg"] = "auto"
    """Network of the training loss's LPIPS; auto is vgg on CUDA and alex, thirty times cheaper, elsewhere."""


@dataclass
class PrunedScene:
    """What training and evaluation need of a scene, made once."""

    scene: DenseScene
    dense_count: int
    pruned: Gaussians
    structure: Structure | None
    seconds: float  # to choose and select, without reading


def tensors_in(value: Any) -> Iterator[Tensor]:
    """Every tensor held by a dataclass, tuple or list, however deep."""
    if isinstance(value, Tensor):
        yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for entry in dataclasses.fields(value):
            yield from tensors_in(getattr(value, entry.name))
    elif isinstance(value, (tuple, list)):
        for entry in value:
            yield from tensors_in(entry)


def settings_of(config: PointSplatModelConfig, keep: float | None = None) -> PruneSettings:
    """How a config asks for scenes to be pruned, at its own ``keep`` by default."""
    return PruneSettings(config.keep if keep is None else keep, config.by, config.opacity_weight)


class PointSplatModel(SplatfactoCpuModel):
    """See the module. The pipeline hands over the scenes with :meth:`attach` before anything is drawn."""

    config: PointSplatModelConfig

    def populate_modules(self) -> None:
        """Build the network; nothing of a scene is a parameter.

        Raises:
            PointSplatError: if no scene could be pruned as the config asks, or its settings describe no network.
        """
        for keep in (self.config.keep, *self.config.more_keeps):
            settings_of(self.config, keep)
        self.refiner = Refiner(preset(self.config.size, **network_options(vars(self.config))))
        self.camera_optimizer = CameraOptimizerConfig(mode="off").setup(num_cameras=1, device="cpu")
        self.crop_box = None
        self.step = 0
        self.scenes: list[DenseScene] = []
        self.shown = 0
        self._cache = FrameCache(0)
        self._latest: tuple[tuple[int, float], PrunedScene] | None = None
        self._refined: tuple[int, Gaussians] | None = None
        self._lpips: dict[str, Lpips | None] = {}
        self.lpips_reason: str | None = None
        """Why there is no LPIPS, once that is known."""

    def attach(self, scenes: list[DenseScene], shown: int, cache: FrameCache) -> None:
        """Take the scenes to work on, which of them is the model's own to the viewer and the exporter, and where pruned
        scenes are kept."""
        self.scenes, self.shown, self._cache, self._latest = scenes, shown, cache, None

    def load_state_dict(self, dict, **kwargs):  # type: ignore[override]
        """The network's weights; Splatfacto's own method would look for Gaussians.

        Raises:
            SceneError: if they are those of another network. nerfstudio would go on with the part that fits.
        """
        self._refined = None
        try:
            return torch.nn.Module.load_state_dict(self, dict, **{**kwargs, "strict": True})
        except RuntimeError as error:
            options = ", ".join(f"{name} {value}" for name, value in network_options(vars(self.config)).items())
            raise SceneError(
                f"the checkpoint does not hold a network of size {self.config.size} with {options}; expected the "
                "settings that it was trained with"
            ) from error

    def get_training_callbacks(self, training_callback_attributes) -> list:
        """None: there is no densification."""
        return []

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """The network's parameters by part: encoder, backbone and one head per attribute."""
        return self.refiner.parameter_groups()

    def pruned_scene(self, index: int, dense: Gaussians | None = None, keep: float | None = None) -> PrunedScene:
        """A scene, pruned and serialized; kept while the cache has room for it, the latest in any case. Who has read
        the dense scene may give it; ``keep`` is the config's by default."""
        key = (index, self.config.keep if keep is None else keep)
        if self._latest is None or self._latest[0] != key:
            known = self._cache.get((_PRUNED, *key))
            self._latest = (key, self._prune(*key, dense) if known is None else known[0])  # type: ignore[arg-type]
        return self._latest[1]

    def _prune(self, index: int, keep: float, dense: Gaussians | None) -> PrunedScene:
        scene = self.scenes[index]
        settings = settings_of(self.config, keep)
        stored = stored_path(self.config.pruned_folder, scene.identity, settings)
        if stored is not None and stored.is_file():
            pruned, dense_count, seconds = read_pruned(stored)
        else:
            dense = scene.dense(keep=False) if dense is None else dense
            start = time.perf_counter()
            try:
                pruned = settings.prune(dense)
            except PointSplatError as error:
                raise type(error)(f"{scene.source}: {error}") from error
            dense_count, seconds = len(dense), time.perf_counter() - start
            if stored is not None:
                write_pruned(stored, pruned, dense_count, seconds)
        pruned = pruned.to(self.device)
        structure = self.refiner.prepare(pruned)
        made = PrunedScene(scene, dense_count, pruned, structure, seconds)
        self._cache.put((_PRUNED, index, keep), (made, dict(enumerate(tensors_in(made)))))  # type: ignore[arg-type]
        CONSOLE.log(f"{scene.name}: kept {len(pruned):,} of {dense_count:,} Gaussians")
        return made

    def refine(self, index: int) -> Gaussians:
        """The refined scene; differentiable in training, computed once for the same weights in evaluation."""
        if self.training:
            self._refined = None
            keeps = (self.config.keep, *self.config.more_keeps)
            made = self.pruned_scene(index, keep=keeps[int(torch.randint(len(keeps), ()))] if len(keeps) > 1 else None)
            if not self.config.augment:
                return self.refiner(made.pruned, made.structure)
            transform = random_transform()
            return transform.undo(self.refiner(transform.apply(made.pruned)))
        made = self.pruned_scene(index)
        if self._refined is None or self._refined[0] != index:
            with torch.no_grad():
                self._refined = (index, self.refiner(made.pruned, made.structure))
        return self._refined[1]

    def timed_refine(self, index: int) -> tuple[Gaussians, float]:
        """As :meth:`refine` in evaluation, computed anew, and the seconds that it took."""
        self.pruned_scene(index)
        self._refined = None
        start = time.perf_counter()
        refined = self.refine(index)
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return refined, time.perf_counter() - start

    def draw(self, gaussians: Gaussians, scene: DenseScene, camera: Cameras) -> dict[str, Tensor]:
        """Render a scene as its run was rendered.

        Args:
            camera: of shape (1,), on the model's device.

        Returns:
            ``rgb`` (H, W, 3) in [0, 1], ``accumulation`` (H, W, 1), ``depth`` (H, W, 1) in scene units, ``background``.
        """
        width, height = int(camera.width.item()), int(camera.height.item())
        image, alpha, _ = self._rasterization(
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.stds,
            opacities=gaussians.alphas,
            colors=gaussians.sh,
            viewmats=viewmats_from_opengl(camera.camera_to_worlds),
            Ks=camera.get_intrinsics_matrices().to(self.device),
            width=width,
            height=height,
            sh_degree=gaussians.sh_degree,
            render_mode="RGB" if self.training else "RGB+ED",
            rasterize_mode=scene.rasterize_mode,
        )
        background = scene.background.to(image)
        outputs = {
            "rgb": (image[0, ..., :3] + (1 - alpha[0]) * background).clamp(0, 1),
            "accumulation": alpha[0],
            "background": background.expand(height, width, 3),
        }
        if not self.training:
            depth = image[0, ..., 3:]
            outputs["depth"] = torch.where(alpha[0] > 0, depth, depth.max())
        return outputs

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        """The shown scene, refined, from one camera; cropped where the viewer asks for it."""
        if not isinstance(camera, Cameras):
            return {}
        gaussians = self.gaussians
        if self.crop_box is not None and not self.training:
            gaussians = gaussians[self.crop_box.within(gaussians.means).reshape(-1)]
        return self.draw(gaussians, self.scenes[self.shown], camera)

    def lpips_of(self, net: str) -> Lpips | None:
        """LPIPS with a backbone, loaded once; None, with ``lpips_reason`` set, where it cannot be had."""
        if net not in self._lpips:
            try:
                self._lpips[net] = load_lpips(net).to(self.device)  # type: ignore[arg-type]
            except LpipsUnavailable as error:
                self._lpips[net], self.lpips_reason = None, str(error)
                CONSOLE.log(f"going on without LPIPS: {error}")
        return self._lpips[net]

    def losses(self, index: int, frames: list[tuple[Cameras, dict]]) -> tuple[dict, dict[str, Tensor], dict]:
        """Refine a scene and compare its renders with photos.

        Returns:
            Outputs of the last photo's camera, the losses (of pixels and weighted LPIPS, averaged over the photos), and
            metrics to log. A loss may be NaN or infinite: the trainer then skips the step.
        """
        refined, scene = self.refine(index), self.scenes[index]
        net = self.config.lpips_net
        net = ("vgg" if self.device.type == "cuda" else "alex") if net == "auto" else net
        lpips = self.lpips_of(net) if self.config.lpips_weight > 0 else None
        outputs: dict[str, Tensor] = {}
        pixels, perceptual, quality = [], [], []
        for camera, data in frames:
            outputs = self.draw(refined, scene, camera)
            rgb, photo = outputs["rgb"], self.photo_of(data, outputs["background"])
            if "mask" in data:
                rgb, photo = rgb * data["mask"], photo * data["mask"]
            pixels.append(PIXEL_LOSSES[self.config.pixel_loss](rgb - photo))
            quality.append(psnr(rgb.detach(), photo))
            if lpips is not None:
                try:
                    perceptual.append(lpips(rgb, photo))
                except ImageError as error:  # too small for the network
                    self._lpips[net] = lpips = None
                    CONSOLE.log(f"going on without LPIPS in the loss: {error}")
        losses = {self.config.pixel_loss: torch.stack(pixels).mean()}
        if perceptual:
            losses["lpips"] = self.config.lpips_weight * torch.stack(perceptual).mean()
        return outputs, losses, {"psnr": torch.stack(quality).mean(), "gaussian_count": len(refined)}

    def _get_downscale_factor(self) -> int:
        """1: nothing is gained by starting coarse, as Splatfacto does."""
        return 1

    def photo_of(self, data: dict[str, Any], background: Tensor) -> Tensor:
        """A photo (H, W, 3) in [0, 1], over ``background`` where it has an alpha channel."""
        return self.composite_with_background(self.get_gt_img(data["image"]), background)

    # What nerfstudio's viewer and exporter read of a Splatfacto model.

    @property
    def gaussians(self) -> Gaussians:
        """The shown scene, refined."""
        return self.refine(self.shown).detach()

    @property
    def gauss_params(self) -> dict[str, Tensor]:  # type: ignore[override]
        """The shown scene's parameters by Splatfacto's names."""
        return dict(self.gaussians.items())

    @property
    def colors(self) -> Tensor:
        """Colours of the shown scene seen from nowhere in particular, (N, 3)."""
        return SH2RGB(self.gaussians.features_dc)

    @property
    def shs_0(self) -> Tensor:
        """Constant SH coefficients of the shown scene, (N, 3)."""
        return self.gaussians.features_dc
