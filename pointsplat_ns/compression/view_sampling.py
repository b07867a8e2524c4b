"""Poses in the free space of a scene that comes without any: a PLY and nothing else."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.scores import area_score
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.views import Views

FIELD_OF_VIEW = 70.0
"""Across the longer side of the image, degrees: that of a phone's main camera."""

BACKGROUND = (0.0, 0.0, 0.0)

_PROBE = 32
"""Longer side of the small pictures by which a place is judged, pixels."""

_TOO_NEAR = 0.05
"""Nothing but a few pixels may be nearer than this share of the content's diagonal."""

_COVERED = 0.7
"""Share of the picture that must show something: mean accumulated alpha."""

_ROUNDS = (0.7, 1.0, 1.0, 1.5, 2.5, 4.0)
"""Sizes, relative to the content's box, of the boxes that places are drawn from, one after the other: first inside, as
in a room, then around, as about an object."""


def content_box(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """Corners (3,), (3,) of the box that holds 90 % of the scene's opacity along each axis, float64.

    Raises:
        DataError: if nothing of the scene can be seen.
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


@torch.no_grad()
def sample_views(scene: Gaussians, count: int, width: int = 320, height: int = 240, seed: int = 0) -> Views:
    """Poses in free space that look at the content of a scene.

    A place is drawn at random in the box of the scene's content, and looks at a Gaussian drawn by
    alpha times area. It is taken if a small picture from there shows that it is free: nearly all of it is
    covered, and nearly nothing of it is very near. Where there is no such place inside, places around the
    box are tried. Rolls are arbitrary: what is up is not known of a scene without poses.

    Args:
        scene: N Gaussians.
        count: how many views.
        width, height: of the views, pixels.
        seed: the same seed gives the same views.

    Returns:
        ``count`` views over black.

    Raises:
        DataError: if the scene has nothing to look at, or no free place was found.
    """
    if count < 1:
        raise DataError(f"{count} views asked for; expected at least 1")
    low, high = content_box(scene)
    diagonal = float((high - low).norm())
    if diagonal == 0:  # one Gaussian, or all at one place: as large as they are
        diagonal = float(scene.stds[scene.usable()].double().amax()) * 4
        diagonal = diagonal if diagonal > 0 else 1.0
    generator = torch.Generator().manual_seed(seed)
    weights = area_score(scene).nan_to_num(nan=-math.inf).cpu()
    chances = torch.softmax(weights.clamp_max(_not_giant(weights)), dim=0)
    cumulative = chances.cumsum(0)
    taken: list[Tensor] = []
    for size in _ROUNDS:
        for _ in range(2):
            places = torch.rand(2 * count, 3, generator=generator, dtype=torch.float64) - 0.5
            places = 0.5 * (low + high).cpu() + size * places * (high - low).cpu().clamp_min(0.25 * diagonal)
            drawn = torch.rand(2 * count, generator=generator, dtype=torch.float64) * cumulative[-1]
            targets = scene.means.cpu().double()[torch.searchsorted(cumulative, drawn).clamp_max(len(scene) - 1)]
            targets = targets.clamp(low.cpu() - diagonal, high.cpu() + diagonal)
            viewmats = look_at(places, targets)
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


def look_at(places: Tensor, targets: Tensor) -> Tensor:
    """World-to-camera matrices (C, 4, 4) of cameras at ``places`` (C, 3) that look at ``targets`` (C, 3), with z up
    where that is possible; OpenCV axes."""
    forward = targets - places
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
    viewmats = torch.eye(4, dtype=places.dtype).repeat(len(places), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ places[..., None])[..., 0]
    return viewmats


def _views(viewmats: Tensor, width: int, height: int) -> Views:
    focal = 0.5 * max(width, height) / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=viewmats.dtype)
    return Views(viewmats, K.repeat(len(viewmats), 1, 1), width, height, torch.tensor(BACKGROUND))


def _not_giant(weights: Tensor) -> float:
    """The 99th percentile: beyond it a Gaussian is no more worth looking at for being larger."""
    ranked = weights[weights > -math.inf].sort().values
    return float(ranked[int(0.99 * (len(ranked) - 1))])


def _is_free(scene: Gaussians, views: Views, index: int, near: float) -> bool:
    """Whether a view is from free space: it shows a covered picture with nearly nothing nearer than ``near``."""
    small = views[[index]].resized(_PROBE)
    picture, alpha, _ = rasterization(
        scene.means,
        scene.quats,
        scene.stds,
        scene.alphas,
        scene.means,  # any colours: only depths are rendered
        small.viewmats.to(scene.means),
        small.Ks.to(scene.means),
        small.width,
        small.height,
        render_mode="ED",
    )
    depth = picture[0, ..., 0]
    too_near = (alpha[0, ..., 0] > 0.5) & (depth < near)
    return bool(alpha.mean() >= _COVERED) and bool(too_near.float().mean() < 0.05)
