"""Poses to look at a scene from, and the picture that a scene gives there. No photos are needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import rasterization


@dataclass(frozen=True, eq=False)
class Views:
    """C pinhole cameras of one image size, and how a scene is drawn from them.

    Raises:
        DataError: if a shape does not fit the others.
    """

    viewmats: Tensor  # [C, 4, 4] world to camera, OpenCV axes, rigid
    Ks: Tensor  # [C, 3, 3] pixels
    width: int
    height: int
    background: Tensor  # [3] in [0, 1]
    rasterize_mode: Literal["classic", "antialiased"] = "classic"

    def __post_init__(self) -> None:
        count = self.viewmats.shape[0]
        for name, shape in (("viewmats", (count, 4, 4)), ("Ks", (count, 3, 3)), ("background", (3,))):
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise DataError(f"{name} of the views has shape {found}; expected {shape}")
        if self.width < 1 or self.height < 1:
            raise DataError(f"views are {self.width} x {self.height} pixels; expected at least 1 x 1")

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index) -> Views:
        """Some of the views: a slice, or a list or tensor of indices."""
        return Views(
            self.viewmats[index], self.Ks[index], self.width, self.height, self.background, self.rasterize_mode
        )

    def spread(self, count: int) -> Views:
        """At most ``count`` of the views, evenly spread over their order."""
        if count >= len(self):
            return self
        return self[torch.linspace(0, len(self) - 1, count).round().long()]

    def resized(self, max_side: int) -> Views:
        """The same views with the longer side of the image at most ``max_side`` pixels."""
        factor = max_side / max(self.width, self.height)
        if factor >= 1:
            return self
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        stretch = self.Ks.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return Views(self.viewmats, self.Ks * stretch, width, height, self.background, self.rasterize_mode)


def draw(scene: Gaussians, views: Views, index: int) -> Tensor:
    """The picture of a scene in one view, (H, W, 3) in [0, 1]. Differentiable."""
    image, alpha, _ = rasterization(
        means=scene.means,
        quats=scene.quats,
        scales=scene.stds,
        opacities=scene.alphas,
        colors=scene.sh,
        viewmats=views.viewmats[index : index + 1].to(scene.means),
        Ks=views.Ks[index : index + 1].to(scene.means),
        width=views.width,
        height=views.height,
        sh_degree=scene.sh_degree,
        rasterize_mode=views.rasterize_mode,
    )
    return (image[0] + (1 - alpha[0]) * views.background.to(image)).clamp(0, 1)


def views_of_run(path: Path | str, split: Literal["train", "test"] = "train") -> Views:
    """The poses of a Splatfacto run's dataset, in the frame and at the resolution that it was trained in.

    Args:
        path: the run's folder, ``config.yml`` or checkpoint.
        split: which photos' poses.

    Raises:
        SceneError: if it is no run or its data is gone.
        DataError: if the poses are not usable, or none is in that split.
    """
    import method_configs.methods  # noqa: F401  (completes nerfstudio's imports in the order that it can)
    from pointsplat_ns.data.frames import FrameCache
    from pointsplat_ns.data.scenes import TrainedScene
    from pointsplat_ns.io.runs import open_run, scene_name
    from pointsplat_ns.splatfacto_cpu import viewmats_of

    run = open_run(path)
    scene = TrainedScene(scene_name(run), run, FrameCache(0))
    frames = scene.train_frames if split == "train" else scene.eval_frames
    cameras = frames.dataset.cameras
    if len(cameras) == 0:
        raise DataError(f"{run.data}: no pose in the {split} split; expected at least one")
    sizes = {(int(w), int(h)) for w, h in zip(cameras.width, cameras.height, strict=True)}
    if len(sizes) > 1:
        raise DataError(f"{run.data}: photos of {len(sizes)} sizes; expected one size for all views")
    ((width, height),) = sizes
    return Views(
        viewmats_of(cameras.camera_to_worlds).detach().cpu(),
        cameras.get_intrinsics_matrices().detach().cpu(),
        width,
        height,
        scene.background,
        scene.rasterize_mode,
    )
