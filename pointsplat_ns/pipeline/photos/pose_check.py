"""Whether poses belong to a scene: small renders of a few views tell.

A view that belongs to a scene shows it, and sharp: training leaves Gaussians of a few pixels where
photos looked. A camera in a wrong frame looks past the scene, or stands in front of a few large
Gaussians. Where there are photos, a render is more like its own photo than like the others;
likeness is a correlation, so that exposure and opacity do not count. Wrong frames that look much
like the right one (a room upside down, a smaller scale) are found by photos alone.

Thresholds are chosen on four scenes of three captures in the poses of their photos, and on twelve
splats in sampled views. All pass, the splats merged to 1 % as well. Of 13 wrong frames, renders
alone tell two to eleven; photos tell all but one of 52.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.metrics import MOST_PSNR, psnr_of
from pointsplat_ns.rendering import pixels_of, render
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.view_sampling.content import content_size, thinned, thinning


@dataclass(frozen=True)
class PoseCheckSettings:
    """What is drawn for the check."""

    views: int = 8
    """Largest number of views that are drawn."""
    side: int = 96
    """Longer side of their pictures, pixels."""
    max_count: int = 200_000
    """About how many Gaussians are drawn at most: every k-th, enlarged."""


POSE_CHECK = PoseCheckSettings()

MIN_LIKENESS = 0.5
"""Mean correlation of renders and their photos that is enough by itself."""


@dataclass(frozen=True)
class PoseFaults:
    """What is wrong with the views of a scene."""

    checked: int
    """Number of views that were drawn."""
    empty: int
    """Number of views that show nothing of the scene."""
    smeared: int
    """Number of views that show nothing sharp."""

    @property
    def serious(self) -> bool:
        """Whether more than half of the views are wrong."""
        return 2 * (self.empty + self.smeared) > self.checked

    def __str__(self) -> str:
        """The faults, for an error."""
        seen = f"{self.checked - self.empty} of {self.checked} cameras see anything of the scene"
        return seen + (f", {self.smeared} of them nothing but a blur" if self.smeared else "")


@torch.no_grad()
def pose_faults(scene: Gaussians, views: Views) -> PoseFaults:
    """What is wrong with the views of a scene, found by small renders. A scene that shows nothing
    has no fault.

    A view shows something if the scene covers a hundredth of its picture; objects of captures cover
    5 % and more. It is sharp if on a quarter of what is covered (the rest may be a sky, or out of
    focus) Gaussians subtend at most 0.03 radians, or, in scenes of few Gaussians, five times what
    one of the median size does at half the diagonal of the content; the largest of right poses is
    three times.
    """
    visible = scene.usable() & (scene.alphas >= ALPHA_MIN)
    if not bool(visible.any()) or len(views) == 0:
        return PoseFaults(0, 0, 0)
    every = scene[visible]
    drawn = thinned(every, POSE_CHECK.max_count)
    step = thinning(len(every), POSE_CHECK.max_count)
    stds = every[::step].stds.double().sort(dim=1).values
    widths = (stds[:, 1] * stds[:, 2]).sqrt()  # scene units
    limit = max(0.03, 5.0 * float(widths.median()) / (0.5 * content_size(drawn)[1]))
    empty = smeared = 0
    checked = views.spread(POSE_CHECK.views)
    for view in replace(checked.resized(POSE_CHECK.side), rasterize_mode="antialiased"):
        pixels = pixels_of(drawn, view).double()
        if float(pixels.sum()) < 0.01 * view.width * view.height:
            empty += 1
        elif _sharpest_angle(drawn, widths, pixels, view) > limit:
            smeared += 1
    return PoseFaults(len(checked), empty, smeared)


def _sharpest_angle(scene: Gaussians, widths: Tensor, pixels: Tensor, view: View) -> float:
    """The angle, radians, that a quarter of a picture stays below: that of the width of the
    Gaussian on each pixel."""
    viewmat = view.viewmat.to(widths)
    distances = (scene.means.double() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
    angles, order = (widths / distances.clamp_min(torch.finfo(torch.float64).tiny)).sort()
    below = pixels[order].cumsum(0)
    return float(angles[torch.searchsorted(below, 0.25 * below[-1]).clamp_max(len(angles) - 1)])


@dataclass(frozen=True)
class Likeness:
    """How much renders of a scene are like photos."""

    own: float
    """Mean correlation of renders with the photos of their views, in [-1, 1]."""
    others: float
    """The same with the photos of other views; 0 if there is one photo."""
    psnr: float
    """Mean PSNR of renders and the photos of their views, dB."""
    count: int
    """Number of photos."""

    @property
    def enough(self) -> bool:
        """Whether renders are like their own photos, or there is none. Right poses have an
        advantage of 0.43 and more over the photos of other views, wrong frames up to 0.3: a kitchen
        at half the scale."""
        return self.count == 0 or self.own >= MIN_LIKENESS or self.own - self.others >= 0.2

    def __str__(self) -> str:
        """The figures, for an error where they are not :attr:`enough`."""
        return (
            "renders of the scene are no more like the photos of their views than like others "
            f"({self.psnr:.1f} dB PSNR in {self.count} photos, correlation {self.own:.2f} and "
            f"{self.others:.2f})"
        )


Photo = tuple[View, Tensor, Tensor | None]
"""A view, its photo (H, W, 3), of uint8 or in [0, 1], and its mask (H, W, 1) bool or None."""


@torch.no_grad()
def likeness(scene: Gaussians, photos: Sequence[Photo]) -> Likeness:
    """How much small renders of a scene are like photos. Masked pixels do not count."""
    drawn = thinned(scene, POSE_CHECK.max_count)
    shown = []
    taken = []
    psnrs = []
    for view, photo, mask in photos:
        k = max(1, max(view.width, view.height) // POSE_CHECK.side)
        size = max(1, view.height // k), max(1, view.width // k)
        stretch = view.K.new_tensor([[size[1] / view.width], [size[0] / view.height], [1.0]])
        small = replace(view, K=view.K * stretch, width=size[1], height=size[0])
        counted = (
            torch.ones(1, *photo.shape[:2], **FLOATS)
            if mask is None
            else mask.permute(2, 0, 1).cpu()
        )
        weight = F.adaptive_avg_pool2d(counted.double(), size).ge(0.5).double()
        picture = (
            F.adaptive_avg_pool2d(in_unit_range(photo).permute(2, 0, 1), size).double().cpu()
            * weight
        )
        rendered = render(drawn, small).permute(2, 0, 1).double().cpu() * weight
        counted_share = max(float(weight.mean()), 1e-9)
        psnrs.append(
            min(psnr_of(float((rendered - picture).square().mean()), counted_share), MOST_PSNR)
        )
        shown.append(_standard(rendered))
        taken.append(_standard(picture))
    own = [float((a * b).sum()) for a, b in zip(shown, taken, strict=True)]
    others = [
        float((a * b).sum())
        for index, a in enumerate(shown)
        for other, b in enumerate(taken)
        if index != other and a.shape == b.shape
    ]
    count = len(own)
    return Likeness(
        sum(own) / max(1, count),
        sum(others) / max(1, len(others)),
        sum(psnrs) / max(1, count),
        count,
    )


def _standard(picture: Tensor) -> Tensor:
    """A picture (3, H, W) less the mean of each channel, of length 1; 0 where it is even."""
    varying = picture - picture.mean((1, 2), keepdim=True)
    return varying / varying.norm().clamp_min(1e-9)
