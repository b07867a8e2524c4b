"""Checks by small renders of a few views whether poses belong to a scene.

A right view shows the scene, and shows it sharp: training leaves Gaussians of a few pixels where
photos looked. A camera in a wrong frame looks past the scene, or stands in front of a few large
Gaussians. With photos, a render must match its own photo better than the others; likeness is a
correlation, so exposure and opacity do not matter. Wrong frames that resemble the right one (a room
upside down, a smaller scale) need photos to be detected.

Thresholds are tuned on four scenes of three captures with the poses of their photos, and on twelve
splats in sampled views. All pass, even splats merged to 1 %. Renders alone detect two to eleven of
13 wrong frames per scene; photos detect all but one of 52.
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
    """Sizes of the renders."""

    views: int = 8
    """Maximum number of views."""
    side: int = 96
    """Longer side of pictures, pixels."""
    max_count: int = 200_000
    """Approximate maximum number of Gaussians to draw: every k-th, enlarged."""


POSE_CHECK = PoseCheckSettings()

MIN_LIKENESS = 0.5
"""Mean correlation of renders and their photos that suffices by itself."""


@dataclass(frozen=True)
class PoseFaults:
    """Faults of the views of a scene."""

    checked: int
    """Number of drawn views."""
    empty: int
    """Number of views that show nothing of the scene."""
    smeared: int
    """Number of views that show nothing sharp."""

    @property
    def serious(self) -> bool:
        """Whether more than half of the views are faulty."""
        return 2 * (self.empty + self.smeared) > self.checked

    def __str__(self) -> str:
        """The faults, for an error."""
        seen = f"{self.checked - self.empty} of {self.checked} cameras see anything of the scene"
        return seen + (f", {self.smeared} of them nothing but a blur" if self.smeared else "")


@torch.no_grad()
def pose_faults(scene: Gaussians, views: Views) -> PoseFaults:
    """Find faults of the views of a scene by small renders. An invisible scene has none.

    A view shows something if the scene covers 1 % of its picture; captured objects cover 5 % and
    more. It is sharp if Gaussians on a quarter of the covered pixels (the rest may be sky, or out
    of focus) subtend at most 0.03 radians or, in scenes of few Gaussians, five times the angle of a
    median Gaussian at half the diagonal of the content; right poses reach up to three times.
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
    """Lower quartile over pixels of the angle that a Gaussian's width subtends, radians."""
    viewmat = view.viewmat.to(widths)
    distances = (scene.means.double() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
    angles, order = (widths / distances.clamp_min(torch.finfo(torch.float64).tiny)).sort()
    below = pixels[order].cumsum(0)
    return float(angles[torch.searchsorted(below, 0.25 * below[-1]).clamp_max(len(angles) - 1)])


@dataclass(frozen=True)
class Likeness:
    """Likeness of renders to photos."""

    own: float
    """Mean correlation of renders with the photos of their views, in [-1, 1]."""
    others: float
    """The same with the photos of other views; 0 if there is one photo."""
    psnr: float
    """Mean PSNR of renders against the photos of their views, dB."""
    count: int
    """Number of photos."""

    @property
    def enough(self) -> bool:
        """Whether renders match their own photos, or there is no photo. Right poses correlate
        better with their own photos than with others by at least 0.43, wrong frames by up to 0.3 (a
        kitchen at half the scale)."""
        return self.count == 0 or self.own >= MIN_LIKENESS or self.own - self.others >= 0.2

    def __str__(self) -> str:
        """The figures, for an error where they are not :attr:`enough`."""
        return (
            "renders of the scene match the photos of their views no better than other photos "
            f"({self.psnr:.1f} dB PSNR in {self.count} photos, correlation {self.own:.2f} and "
            f"{self.others:.2f})"
        )


Photo = tuple[View, Tensor, Tensor | None]
"""A view, its photo (H, W, 3), of uint8 or in [0, 1], and its mask (H, W, 1) bool or None."""


@torch.no_grad()
def likeness(scene: Gaussians, photos: Sequence[Photo]) -> Likeness:
    """Likeness of small renders of a scene to photos. Masked pixels are ignored."""
    drawn = thinned(scene, POSE_CHECK.max_count)
    shown = []
    taken = []
    psnrs = []
    for view, photo, mask in photos:
        k = max(1, max(view.width, view.height) // POSE_CHECK.side)
        size = max(1, view.height // k), max(1, view.width // k)
        stretch = view.K.new_tensor([[size[1] / view.width], [size[0] / view.height], [1.0]])
        small = replace(view, K=view.K * stretch, width=size[1], height=size[0])
        if mask is None:
            valid = torch.ones(1, *photo.shape[:2], **FLOATS)
        else:
            valid = mask.permute(2, 0, 1).cpu()
        weight = F.adaptive_avg_pool2d(valid.double(), size).ge(0.5).double()
        reduced = F.adaptive_avg_pool2d(in_unit_range(photo).permute(2, 0, 1), size)
        picture = reduced.double().cpu() * weight
        rendered = render(drawn, small).permute(2, 0, 1).double().cpu() * weight
        valid_share = max(float(weight.mean()), 1e-9)
        error = float((rendered - picture).square().mean())
        psnrs.append(min(psnr_of(error, valid_share), MOST_PSNR))
        shown.append(_standard(rendered))
        taken.append(_standard(picture))
    own = [float((a * b).sum()) for a, b in zip(shown, taken, strict=True)]
    others = [
        float((a * _shaped(b, a)).sum())
        for index, a in enumerate(shown)
        for other, b in enumerate(taken)
        if index != other
    ]
    count = len(own)
    return Likeness(
        own=sum(own) / max(1, count),
        others=sum(others) / max(1, len(others)),
        psnr=sum(psnrs) / max(1, count),
        count=count,
    )


def _shaped(picture: Tensor, other: Tensor) -> Tensor:
    """A picture of :func:`_standard`, stretched to the shape of another one."""
    if picture.shape == other.shape:
        return picture
    return _standard(F.interpolate(picture[None], other.shape[1:], mode="area")[0])


def _standard(picture: Tensor) -> Tensor:
    """A picture (3, H, W) minus the mean of each channel, normalised; 0 for a constant picture."""
    varying = picture - picture.mean((1, 2), keepdim=True)
    return varying / varying.norm().clamp_min(1e-9)
