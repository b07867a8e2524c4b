"""What the benchmarks draw: a synthetic room of any number of Gaussians, and trained scenes with their own cameras."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians

SH_COEFFICIENTS = 16  # degree 3
KEEP = 0.1
"""Share of a trained scene that its pruned case keeps: few, large and faint Gaussians."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians with activated parameters, and one camera that a case fits to its image size."""

    name: str
    family: str
    """Cases of one family differ only in count and image size: one line of the slopes."""
    tensors: list[Tensor]  # means [N, 3], quats [N, 4], standard deviations [N, 3], opacities [N], SH [N, 16, 3]
    viewmat: Tensor  # [4, 4] world to camera, OpenCV axes
    focal: float
    """Focal length in image widths."""

    def __len__(self) -> int:
        return self.tensors[0].shape[0]

    def K(self, width: int, height: int) -> Tensor:
        """Intrinsics (3, 3): the horizontal field of view stays, the principal point is the centre."""
        focal = self.focal * width
        return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def room(count: int, seed: int = 0) -> list[Tensor]:
    """Means, quats, scales, opacities and SH (degree 3) on the six walls of a 6 x 3 x 6 room.

    Scales shrink as the count grows, so that every count covers the walls equally often. The camera of
    :func:`room_scene` sees two in five: 200,000 Gaussians give about 80,000 visible ones.
    """
    g = torch.Generator().manual_seed(seed)
    half = torch.tensor([3.0, 1.5, 3.0])
    means = (2 * torch.rand(count, 3, generator=g) - 1) * half
    axis = torch.randint(0, 3, (count,), generator=g)
    side = 2.0 * torch.randint(0, 2, (count,), generator=g) - 1
    means[torch.arange(count), axis] = side * half[axis]
    quats = torch.randn(count, 4, generator=g)
    scales = 0.6 * (108 / count) ** 0.5 * torch.exp(0.7 * torch.randn(count, 3, generator=g))
    opacities = 0.05 + 0.9 * torch.rand(count, generator=g)
    return [means, quats, scales, opacities, 0.1 * torch.randn(count, SH_COEFFICIENTS, 3, generator=g)]


def room_scene(count: int) -> Scene:
    """The room seen from within, towards one wall."""
    view = torch.eye(4)
    view[2, 3] = 2.0
    text = f"{count // 1_000_000}M" if count % 1_000_000 == 0 else f"{count / 1000:g}k"
    return Scene(f"room {text}", "room", room(count), view, 0.6)


def trained_scenes(path: Path, views: Path | None, index: int | None) -> list[Scene]:
    """A trained scene, dense and pruned to a tenth by the paper's score, at one of its cameras.

    Args:
        path: a Splatfacto run (its folder or ``config.yml``), seen from its held-out cameras, or a PLY.
        views: for a PLY: JSON with ``viewmats`` (4 x 4 world to camera, OpenCV axes) and ``focal`` in image widths.
        index: which camera; the middle one if None.

    Raises:
        SceneError: if the scene or its cameras cannot be read, or there is no such camera.
    """
    from pointsplat_ns.io import open_run, read_scene, scene_name
    from pointsplat_ns.pruning import prune

    dense = read_scene(path)
    if path.suffix.lower() == ".ply":
        name, (viewmats, focal) = path.stem, _views_of(path, views)
    else:
        name, (viewmats, focal) = scene_name(open_run(path)), _cameras_of(path)
    index = len(viewmats) // 2 if index is None else index
    if not 0 <= index < len(viewmats):
        raise SceneError(f"{path}: view {index} asked for; expected 0 to {len(viewmats) - 1}")
    dense = dense[dense.usable() & dense.quats.any(1)]  # the yardstick knows no zero quaternions
    variants = {"dense": dense, f"{KEEP:.0%}": prune(dense, KEEP, "paper")}
    return [
        Scene(f"{name} {kind}", f"{name} {kind}", _activated(scene), viewmats[index], focal)
        for kind, scene in variants.items()
    ]


def _activated(scene: Gaussians) -> list[Tensor]:
    sh = torch.nn.functional.pad(scene.sh, (0, 0, 0, SH_COEFFICIENTS - scene.sh.shape[1]))
    return [t.contiguous() for t in (scene.means, scene.quats, scene.stds, scene.alphas, sh)]


def _views_of(path: Path, views: Path | None) -> tuple[Tensor, float]:
    if views is None:
        raise SceneError(f"{path}: a PLY has no cameras; name a file of view matrices with --views")
    try:
        content = json.loads(views.read_text("utf-8"))
        viewmats, focal = torch.tensor(content["viewmats"], dtype=torch.float32), float(content["focal"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SceneError(f"{views}: cannot be read ({error}); expected JSON with 'viewmats' and 'focal'") from error
    if viewmats.dim() != 3 or viewmats.shape[1:] != (4, 4) or len(viewmats) == 0:
        raise SceneError(f"{views}: viewmats have shape {tuple(viewmats.shape)}; expected (views, 4, 4)")
    return viewmats, focal


def _cameras_of(path: Path) -> tuple[Tensor, float]:
    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views

    views = dataset_views(path, "test")
    return views.viewmats.float(), float(views.Ks[0, 0, 0] / views.width)
