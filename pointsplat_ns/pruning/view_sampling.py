"""Samples views in the free space of a scene that comes without cameras."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.scores import area_score
from pointsplat_ns.rasterizer import render_depth
from pointsplat_ns.views import Views

FIELD_OF_VIEW = 70.0
"""Field of view across the longer side of the image, degrees: that of a phone's main camera."""

BACKGROUND = (0.0, 0.0, 0.0)

_PROBE_SIDE = 32
"""Longer side, in pixels, of the depth image that tests a camera position."""

_TOO_NEAR = 0.05
"""Distance, as a share of the diagonal of the content's box, below which a surface is too near to the camera."""

_NEAR_PIXELS = 0.05
"""Largest allowed share of pixels that show a surface that is too near."""

_COVERED = 0.7
"""Least mean alpha of the image: it must show something nearly everywhere."""

_BOX_SIZES = (0.7, 1.0, 1.0, 1.5, 2.5, 4.0)
"""Sizes, relative to the content's box, of the boxes that camera positions are drawn from, in this order: first inside,
as in a room, then outside, as around an object."""


def content_box(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """Corners (3,), (3,) of the box that holds 90 % of the scene's opacity along each axis, float64.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    means, alphas = scene.means.double(), scene.alphas.double()
    seen = scene.usable() & (alphas > 0)
    if not bool(seen.any()):
        raise DataError("nothing of the scene can be seen, so there is no place to look from")
    means, alphas = means[seen], alphas[seen]
    corners = []
    for axis in means.unbind(1):
        ranked, order = axis.sort()
        below = alphas[order].cumsum(0)
        at = torch.searchsorted(below, below[-1] * below.new_tensor([0.05, 0.95])).clamp_max(len(ranked) - 1)
        corners.append(ranked[at])
    low, high = torch.stack(corners, dim=1)
    return low, high


def content_diagonal(scene: Gaussians, low: Tensor, high: Tensor) -> float:
    """Diagonal of the box with corners ``low`` (3,) and ``high`` (3,) that :func:`content_box` gives, scene units. If
    the box is a point (one Gaussian, or all at one position), four times the largest standard deviation; 1 if that is
    0."""
    return float((high - low).norm()) or 4 * float(scene.stds[scene.usable()].double().amax()) or 1.0


@torch.no_grad()
def sample_views(scene: Gaussians, count: int, width: int = 320, height: int = 240, seed: int = 0) -> Views:
    """Sample cameras in free space that look at the content of a scene.

    A camera position is drawn at random from the box that holds 90 % of the scene's opacity along each axis, and a
    target among the Gaussians with probability proportional to opacity times area. The camera is kept if a small depth
    image from there shows free space: nearly all of it is covered, and hardly any surface is very near. If too few
    positions are found, larger boxes are tried. The z axis is taken to point up.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1.
        width: of the images, pixels.
        height: of the images, pixels. The field of view is 70 degrees across the longer side.
        seed: the same scene and seed give the same views.

    Returns:
        ``count`` views, on the CPU, over black: ``viewmats`` (count, 4, 4) from world to camera in OpenCV axes and
        ``Ks`` (count, 3, 3) in pixels, float64. Fewer where the search finds fewer.

    Raises:
        DataError: if ``count`` or the size is not positive, nothing of the scene is visible, or no free position is
            found.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 3, width=64, height=48)
        >>> len(views), tuple(views.viewmats.shape), (views.width, views.height)
        (3, (3, 4, 4), (64, 48))
    """
    if count < 1:
        raise DataError(f"{count} views asked for; expected at least 1")
    if min(width, height) < 1:
        raise DataError(f"views of {width} x {height} pixels asked for; expected at least 1 x 1")
    low, high = content_box(scene)
    diagonal = content_diagonal(scene, low, high)
    generator = torch.Generator().manual_seed(seed)
    weights = area_score(scene).nan_to_num(nan=-math.inf).cpu()
    chances = torch.softmax(weights.clamp_max(_not_giant(weights)), dim=0)
    cumulative = chances.cumsum(0)
    taken: list[Tensor] = []
    for size in _BOX_SIZES:
        for _ in range(2):
            positions = torch.rand(2 * count, 3, generator=generator, dtype=torch.float64) - 0.5
            positions = 0.5 * (low + high).cpu() + size * positions * (high - low).cpu().clamp_min(0.25 * diagonal)
            drawn = torch.rand(2 * count, generator=generator, dtype=torch.float64) * cumulative[-1]
            targets = scene.means.cpu().double()[torch.searchsorted(cumulative, drawn).clamp_max(len(scene) - 1)]
            targets = targets.clamp(low.cpu() - diagonal, high.cpu() + diagonal)
            viewmats = look_at(positions, targets)
            candidates = _views(viewmats, width, height)
            for index in range(len(candidates)):
                if len(taken) < count and _is_free(scene, candidates, index, _TOO_NEAR * diagonal):
                    taken.append(viewmats[index])
            if len(taken) == count:
                return _views(torch.stack(taken), width, height)
    if not taken:
        raise DataError(
            "no free place to look at the scene from was found; give a run whose data is at hand, which has poses"
        )
    return _views(torch.stack(taken), width, height)


def look_at(positions: Tensor, targets: Tensor) -> Tensor:
    """World-to-camera matrices (C, 4, 4) of cameras at ``positions`` (C, 3) that look at ``targets`` (C, 3), with z up
    where that is possible; OpenCV axes."""
    forward = targets - positions
    length = forward.norm(dim=1, keepdim=True)
    ahead = forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300), ahead)
    up = forward.new_tensor([0.0, 0.0, 1.0]).expand_as(forward)
    steep = forward[:, 2:].abs() > 0.99
    up = torch.where(steep, forward.new_tensor([0.0, 1.0, 0.0]), up)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm(dim=1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)  # (C, 3, 3) world to camera
    viewmats = torch.eye(4, dtype=positions.dtype).repeat(len(positions), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    return viewmats


def _views(viewmats: Tensor, width: int, height: int) -> Views:
    focal = 0.5 * max(width, height) / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=viewmats.dtype)
    return Views(viewmats, K.repeat(len(viewmats), 1, 1), width, height, torch.tensor(BACKGROUND))


def _not_giant(weights: Tensor) -> float:
    """The 99th percentile of the weights, to which larger ones are clamped."""
    ranked = weights[weights > -math.inf].sort().values
    return float(ranked[int(0.99 * (len(ranked) - 1))])


def _is_free(scene: Gaussians, views: Views, index: int, near: float) -> bool:
    """Whether a camera is in free space: its image is covered, with hardly any surface nearer than ``near``."""
    depth, alpha = render_depth(scene, views[[index]].resized(_PROBE_SIDE)[0])
    too_near = (alpha > 0.5) & (depth < near)
    return bool(alpha.mean() >= _COVERED) and bool(too_near.float().mean() < _NEAR_PIXELS)
