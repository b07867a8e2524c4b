"""Splatfacto on any torch device: nerfstudio's model with our rasterizer in place of gsplat's CUDA
kernels.

Replaced is what needs CUDA or a download (the initialisation from seed points, the call of the
rasterizer, LPIPS), and SSIM, by an implementation of the same formula in fewer operations. All else
is nerfstudio's own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from nerfstudio.cameras.camera_optimizers import CameraOptimizer
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.model_components.lib_bilagrid import BilateralGrid
from nerfstudio.models.splatfacto import (
    RGB2SH,
    SplatfactoModel,
    SplatfactoModelConfig,
    random_quat_tensor,
)
from nerfstudio.utils.colors import get_color
from torch import Tensor
from torchmetrics.image import PeakSignalNoiseRatio

from pointsplat_ns.geometry.neighbours import nearest
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.metrics.lpips import ReportedLpips
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.nerfstudio_plugin.cameras import (
    VIEWER_BACKGROUND,
    RasterizerOptions,
    need_pinhole,
)
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.rendering.rasterize import Colors
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.system.threads import one_thread


class LpipsMetric(ReportedLpips):
    """LPIPS, called like nerfstudio's metrics."""

    def __call__(self, image: Tensor, other: Tensor) -> Tensor:
        """LPIPS of two (1, 3, H, W) images in [0, 1]; NaN, with ``reason`` set, if it cannot be
        computed."""
        value = super().__call__(image.permute(0, 2, 3, 1), other.permute(0, 2, 3, 1))
        return image.new_tensor(math.nan) if value is None else value.mean()


@dataclass
class SplatfactoCpuModelConfig(RasterizerOptions, SplatfactoModelConfig):
    """Splatfacto's config, and the options of the rasterizer"""

    _target: type = field(default_factory=lambda: SplatfactoCpuModel)


class SplatfactoCpuModel(SplatfactoModel):
    """Splatfacto that needs neither CUDA nor a network connection. ``seed_points`` are positions
    (N, 3) in scene units and colours (N, 3) from 0 to 255. If none is finite, the scene starts from
    random points, as in Splatfacto."""

    config: SplatfactoCpuModelConfig

    def populate_modules(self) -> None:
        """Build what Splatfacto builds; its own method puts seed points on CUDA and downloads
        LPIPS."""
        config = self.config
        self.strategy = DefaultStrategy(
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            refine_scale2d_stop_iter=config.stop_screen_size_at,
            refine_start_iter=config.warmup_length,
            refine_stop_iter=config.stop_split_at,
            reset_every=config.reset_alpha_every * config.refine_every,
            refine_every=config.refine_every,
            pause_refine_after_reset=self.num_train_data + config.refine_every,
            absgrad=config.use_absgrad,
            revised_opacity=False,
            verbose=True,
        )
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)
        self.seed_points = None if config.random_init else finite_seeds(self.seed_points)
        if self.seed_points is None:
            points = (torch.rand(config.num_random, 3, **FLOATS) - 0.5) * config.random_scale
            self.gauss_params = self._seed_parameters(points, points[:0])
        else:
            self.gauss_params = self._seed_parameters(*self.seed_points)
        self.camera_optimizer: CameraOptimizer = config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )
        if config.use_bilateral_grid:
            x, y, w = config.grid_shape
            self.bil_grids = BilateralGrid(num=self.num_train_data, grid_X=x, grid_Y=y, grid_W=w)
        self.psnr = PeakSignalNoiseRatio(data_range=1.0)
        self.lpips = LpipsMetric()  # type: ignore[assignment]  # Splatfacto's is torchmetrics' module
        self.step = 0
        self.crop_box: OrientedBox | None = None
        self.background_color = (
            torch.tensor(VIEWER_BACKGROUND, **FLOATS)
            if config.background_color == "random"
            else get_color(config.background_color)
        )

    def ssim(self, image: Tensor, other: Tensor) -> Tensor:
        """Mean SSIM of two (1, 3, H, W) images in [0, 1], as Splatfacto's."""
        return mean_ssim(image, other, False if self.config.compiled is False else None)

    def _seed_parameters(self, points: Tensor, colors: Tensor) -> torch.nn.ParameterDict:
        """Splatfacto's parameters for N points (N, 3) and their colours (N, 3) from 0 to 255, or
        (0, 3) if unknown."""
        num = len(points)
        num_rest = (self.config.sh_degree + 1) ** 2 - 1
        quats = random_quat_tensor(num)
        if len(colors) == 0:
            features_dc = torch.rand(num, 3, **FLOATS)
        elif self.config.sh_degree > 0:
            features_dc = RGB2SH(colors / 255)
        else:  # colours are optimised as logits
            features_dc = torch.logit(
                colors / 255, eps=0.5 / 255
            )  # half a step of an 8-bit colour: finite logits
        values = {
            "means": points,
            "scales": distance_to_others(points, 3).log().repeat(1, 3),
            "quats": quats,
            "features_dc": features_dc,
            "features_rest": torch.zeros(num, num_rest, 3, **FLOATS),
            "opacities": torch.full((num, 1), math.log(0.1 / 0.9), **FLOATS),
        }
        return torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value) for name, value in values.items()}
        )

    def load_state_dict(self, dict: Mapping[str, Any], **kwargs):  # type: ignore[override]  # as nerfstudio's
        """As Splatfacto's, but ignores the LPIPS weights in nerfstudio's own checkpoints."""
        return super().load_state_dict(
            {k: v for k, v in dict.items() if not k.startswith("lpips.")}, **kwargs
        )

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Splatfacto's callbacks. The optimisers are first given this model's parameters."""
        if training_callback_attributes.optimizers is not None:
            self._adopt_optimizers(training_callback_attributes.optimizers)
        return super().get_training_callbacks(training_callback_attributes)

    def _adopt_optimizers(self, optimizers: Optimizers) -> None:
        """Let the optimisers step this model's parameters. nerfstudio builds them before it loads a
        checkpoint, which replaces the parameters: a resumed Splatfacto would optimise parameters
        that are no longer rendered."""
        for name, parameter in self.gauss_params.items():
            optimizer = optimizers.optimizers.get(name)
            if optimizer is None:
                continue
            (held,) = optimizer.param_groups[0]["params"]
            if held is not parameter:
                optimizer.param_groups[0]["params"] = [parameter]
                optimizer.state[parameter] = optimizer.state.pop(held, {})
                optimizers.parameters[name] = [parameter]

    def forget_step(self) -> None:
        """Let densification gather nothing of the latest step."""
        centres = self.info["means2d"]
        centres.grad = centres.absgrad = torch.zeros_like(centres)
        self.info["radii"] = torch.zeros_like(self.info["radii"])  # nothing was seen

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:  # type: ignore[override]  # models of rays take those
        """Render one camera of shape (1,): ``rgb`` (H, W, 3) in [0, 1]; ``accumulation`` (H, W, 1);
        ``background``, (3,) in training and (H, W, 3) in evaluation; and ``depth`` (H, W, 1), in
        scene units along the viewing axis, or None in training unless
        ``output_depth_during_training`` is set."""
        need_pinhole(camera)
        params = dict(self.gauss_params.items())
        if self.crop_box is not None and not self.training:
            inside = self.crop_box.within(self.means).reshape(-1)
            if not inside.any():
                width = int(camera.width.item())
                height = int(camera.height.item())
                return self.get_empty_outputs(width, height, self.background_color.to(self.device))
            params = {name: value[inside] for name, value in params.items()}
        camera_to_worlds = (
            self.camera_optimizer.apply_to_camera(camera)
            if self.training
            else camera.camera_to_worlds
        )
        factor = self._get_downscale_factor()
        width = int(camera.width.item()) // factor
        height = int(camera.height.item()) // factor
        intrinsics = camera.get_intrinsics_matrices().to(self.device).clone()
        intrinsics[:, :2] /= factor
        with_depth = self.config.output_depth_during_training or not self.training
        if self.config.sh_degree > 0:
            colors: Colors = params["features_dc"], params["features_rest"]
            degree = min(self.step // self.config.sh_degree_interval, self.config.sh_degree)
        else:
            colors = _sigmoid(params["features_dc"])
            degree = None
        image, alpha, info = self.config.rasterize(
            training=self.training,
            means=params["means"],
            quats=params["quats"],
            scales=torch.exp(params["scales"]),
            opacities=_sigmoid(params["opacities"][:, 0]),
            colors=colors,
            viewmats=viewmats_from_opengl(camera_to_worlds),
            Ks=intrinsics,
            width=width,
            height=height,
            packed=False,
            render_mode="RGB+ED" if with_depth else "RGB",
            sh_degree=degree,
            absgrad=self.strategy.absgrad,
            rasterize_mode=self.config.rasterize_mode,
        )
        self.last_size = (height, width)
        if self.training:
            self.info = info
            self.strategy.step_pre_backward(
                self.gauss_params, self.optimizers, self.strategy_state, self.step, self.info
            )
        background = self._get_background_color()
        rgb = torch.clamp(image[..., :3] + (1 - alpha) * background, 0.0, 1.0)
        metadata = camera.metadata or {}
        if self.training and self.config.use_bilateral_grid and "cam_idx" in metadata:
            rgb = self._apply_bilateral_grid(rgb, metadata["cam_idx"], height, width)
        depth = None
        if with_depth:
            depth = image[..., 3:4]
            depth = torch.where(alpha > 0, depth, depth.detach().max())[0]
        return {
            "rgb": rgb[0],
            "depth": depth,
            "accumulation": alpha[0],
            "background": background if self.training else background.expand(height, width, 3),
        }

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """As Splatfacto's, without LPIPS if it cannot be computed (``self.lpips.reason`` then says
        why)."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        return {k: v for k, v in metrics.items() if "lpips" not in k or math.isfinite(v)}, images


def _sigmoid(values: Tensor) -> Tensor:
    """torch's, whose rounding depends on the number of threads, on one."""
    with one_thread():
        return torch.sigmoid(values)


def distance_to_others(points: Tensor, k: int) -> Tensor:
    """Mean distance (N, 1) from each point (N, 3) to its ``k`` nearest other positions, float32 and
    positive.

    Points at the same position count once. With fewer than ``k`` other positions, the distance to
    the farthest is repeated; with none, the result is 0.01 scene units.
    """
    places, place_of = torch.unique(points, dim=0, return_inverse=True)
    if len(places) < 2:
        return torch.full((len(points), 1), 0.01, **FLOATS)
    distances = nearest(places, k + 1)[0][:, 1:]
    missing = distances[:, -1:].expand(-1, k - distances.shape[1])
    # Distinct positions can be so close that the distance is zero in float32.
    distances = (
        torch.cat([distances, missing], dim=1).clamp(min=torch.finfo(torch.float32).tiny).float()
    )
    return distances.mean(dim=1, keepdim=True)[place_of]


def finite_seeds(seeds: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor] | None:
    """Positions (N, 3) and colours (N, 3) as float32 without rows that are not finite; None if
    nothing is left.

    If all colours are black they are unknown, (0, 3), as in COLMAP models whose points were
    triangulated without photos. Renders clamp colours at black, where they have no gradient: the
    scene would stay black.
    """
    if seeds is None:
        return None
    points, colors = (value.detach().float().cpu() for value in seeds)
    finite = points.isfinite().all(dim=1)
    if len(colors) > 0:
        finite &= colors.isfinite().all(dim=1)
        colors = colors[finite]
    if not finite.all():
        log(f"{int((~finite).sum())} of {len(points)} seed points are not finite and were dropped")
    if not finite.any():
        log("no seed points are left; a training starts from random ones")
        return None
    if len(colors) > 0 and not colors.any():
        log(
            "all seed points are black, as where colours are unknown; a training starts from "
            "random colours"
        )
        colors = colors[:0]
    return points[finite].clone(), colors.clone()
