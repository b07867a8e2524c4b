"""What a training tells before it ends: how long it takes, and a held-out photo beside its render now and then."""

from __future__ import annotations

import copy
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn.functional import interpolate

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.pictures import in_unit_range, write_picture
from pointsplat_ns.metrics import psnr
from pointsplat_ns.system.quantities import seconds_text

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.pipelines.base_pipeline import VanillaPipeline


class EarlyLook:
    """Logs how long a training of ``count`` steps from step ``first`` on will take, and writes pictures of a held-out
    view into a folder, as ``step-000000109.jpg``: the photo, and its render beside it.

    An estimate is logged after some seconds, and again whenever the resolution of training has risen. How much slower
    later steps are is measured by rendering a view at full resolution; that Gaussians become more is not foreseen.
    """

    def __init__(self, pipeline: VanillaPipeline, folder: Path, first: int, count: int):
        self._pipeline, self._folder, self._last = pipeline, folder, first + count
        self._start = time.perf_counter()
        self._due: list[int] = [first + steps for steps in picture_steps(count)]
        self._spent, self._dearest = 0.0, 0.0
        self._factor, self._timed_from, self._timed_since = 0, first, self._start

    def before_step(self, step: int) -> None:
        """Called before each step, when the one before is complete."""
        self._estimate(step)
        if self._due and step >= self._due[0] and self._affordable():
            self._picture(step)

    def after_training(self, step: int) -> None:
        """Called after the last step, whose number is given."""
        if self._due:
            self._picture(step + 1)

    def _affordable(self, share: float = 0.02) -> bool:
        """Whether pictures, with one as dear as the dearest so far, take no more than a share of the time."""
        return self._spent + self._dearest <= share * (time.perf_counter() - self._start)

    def _estimate(self, step: int) -> None:
        factor, now = self._factor_at(step), time.perf_counter()
        if factor != self._factor:
            self._factor, self._timed_from, self._timed_since = factor, step + 2, now  # steps that are not timed
        if step <= self._timed_from:
            self._timed_since = now
        steps, seconds = step - self._timed_from, now - self._timed_since
        if steps < 5 or seconds < 3.0:  # too few for an estimate
            return
        self._timed_from = self._last  # until the resolution rises
        per_step, left = seconds / steps, range(step, self._last)
        at_full, speed = 1.0, f"{per_step:.2g} s a step"
        if self._factor_at(self._last - 1) < factor:
            at_full = max(1.0, self._seconds_to_render(1) / self._seconds_to_render(factor))
            speed += f", about {per_step * at_full:.2g} s at full resolution"
        # Time that rises with the number of pixels, from 1 now to ``at_full``.
        rise = (at_full - 1) / max(1 - factor**-2, 1e-9)
        time_left = per_step * sum(1 + rise * (self._factor_at(later) ** -2 - factor**-2) for later in left)
        CONSOLE.log(f"{speed}: the {len(left):,} steps left take about {seconds_text(time_left)}")

    @torch.no_grad()
    def _seconds_to_render(self, factor: int) -> float:
        """Time to render the first training view, ``factor`` times smaller than its photo."""
        dataset = self._pipeline.datamanager.train_dataset
        assert dataset is not None
        camera = copy.deepcopy(dataset.cameras[:1])
        camera.rescale_output_resolution(1 / factor)
        times = []
        for _ in range(2):  # the first time is slower
            start = time.perf_counter()
            self._render(camera)
            times.append(time.perf_counter() - start)
        return min(times)

    def _render(self, camera: Cameras) -> dict[str, Tensor]:
        """Render of a camera by a model in evaluation mode."""
        model = self._pipeline.model
        training = model.training
        model.eval()
        try:
            return model.get_outputs_for_camera(camera)
        finally:
            model.train(training)

    def _factor_at(self, step: int) -> int:
        """Factor by which images are smaller than the photos at a step."""
        config = self._pipeline.model.config
        return 2 ** max(config.num_downscales - step // config.resolution_schedule, 0)

    def _picture(self, step: int) -> None:
        """Write a picture. Where it cannot be written, that is logged, and there are no more."""
        start = time.perf_counter()
        while self._due and self._due[0] <= step:
            self._due.pop(0)
        if not self._pipeline.datamanager.eval_dataset:
            self._due.clear()
            return
        photo, image = self._look()
        path = self._folder / f"step-{step:09d}.jpg"
        try:
            write_picture(torch.cat([photo, image], dim=1), path)
        except SceneError as error:
            self._due.clear()
            CONSOLE.log(f"no more pictures: {error}")
            return
        cost = time.perf_counter() - start
        self._spent, self._dearest = self._spent + cost, max(self._dearest, cost)
        elapsed = seconds_text(time.perf_counter() - self._start)
        CONSOLE.log(f"{path}: a held-out photo and its render after {elapsed}, {float(psnr(image, photo)):.1f} dB")

    @torch.no_grad()
    def _look(self) -> tuple[Tensor, Tensor]:
        """The first held-out photo and its render, (H, W, 3) in [0, 1], at the size of a picture."""
        model = self._pipeline.model
        frames: Any = self._pipeline.datamanager.fixed_indices_eval_dataloader
        camera, data = next(iter(frames))
        camera = copy.deepcopy(camera)
        camera.rescale_output_resolution(min(1.0, 400 / float(max(camera.width.max(), camera.height.max()))))
        outputs = self._render(camera)
        photo = in_unit_range(data["image"].to(model.device))
        photo = model.composite_with_background(photo, outputs["background"][:1, :1])
        image = outputs["rgb"].clamp(0, 1)
        photo = interpolate(photo.permute(2, 0, 1)[None], size=image.shape[:2], mode="bilinear", antialias=True)
        return photo[0].permute(1, 2, 0).clamp(0, 1), image


def picture_steps(count: int) -> list[int]:
    """After how many of ``count`` steps pictures are made.

    Example:
        >>> picture_steps(7000)
        [110, 220, 440, 880, 1760, 3520, 7000]
        >>> picture_steps(30)
        [30]
    """
    steps, after = [], max(50, math.ceil(count * (1 / 64)))
    while after < 0.75 * count:
        steps.append(after)
        after *= 2
    return [*steps, count]
