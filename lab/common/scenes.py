"""Scenes to measure: which are for tuning and which judge, a synthetic room of any size, and trained scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import open_run, read_scene, scene_name

TUNING = (
    *("apt_bathroom", "bouquet", "pc_flowers", "pc_statue_massa", "plant_pilea", "kettle_pod"),
    *("pc_statue_angel", "pc_statue_narcissus", "pc_statue_trumpet", "kitchen", "fox", "final_3dgs", "vr_project"),
    *("room", "room5", "meeting", "drone_hall", "figure", "ray"),
)
"""Scenes that constants may be chosen on."""

JUDGED = (
    *("apt_kitchen_balcony", "cake_fraisier", "mujoco_tabletop", "pc_playbot", "rock", "pc_statue_angel_kneeling"),
    *("pc_statue_angel_with_candlestick", "pc_statue_st_peter", "lounge", "diorama", "ethiopianHead", "dataset_perso"),
    *("lego_dense", "taebak", "office", "room35", "chair", "plant", "phone", "can"),
)
"""Scenes that no constant is chosen on: they were named before the first measurement. See docs/benchmarks.md."""

SH_DEGREE = 3
SAMPLED = 8
"""Views sampled of a PLY, one of which is drawn."""

KEEP = 0.1
"""Share of a trained scene that its pruned case keeps: few, large and faint Gaussians."""


def group_of(scene: str) -> str:
    """ "tuning", "judged", or "" for any other scene."""
    return "tuning" if scene in TUNING else "judged" if scene in JUDGED else ""


def name_of(path: Path) -> str:
    """The name of a scene in tables: that of a run, or of a PLY's file."""
    return path.stem if path.suffix == ".ply" else scene_name(open_run(path))


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


def room(count: int, sh_degree: int = SH_DEGREE, seed: int = 0) -> Gaussians:
    """A synthetic scene: Gaussians on the six walls of a 6 x 3 x 6 room.

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
    sh = 0.1 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=g)
    return Gaussians(means, scales.log(), quats, opacities.logit()[:, None], sh[:, 0].clone(), sh[:, 1:].clone())


def room_scene(count: int) -> Scene:
    """The room seen from within, towards one wall."""
    view = torch.eye(4)
    view[2, 3] = 2.0
    text = f"{count // 1_000_000}M" if count % 1_000_000 == 0 else f"{count / 1000:g}k"
    return Scene(f"room {text}", "room", activated(room(count)), view, 0.6)


def activated(scene: Gaussians) -> list[Tensor]:
    """The tensors of a :class:`Scene`, with zeros for SH bands that the scene lacks."""
    sh = torch.nn.functional.pad(scene.sh, (0, 0, 0, (SH_DEGREE + 1) ** 2 - scene.sh.shape[1]))
    return [t.contiguous() for t in (scene.means, scene.quats, scene.stds, scene.alphas, sh)]


def trained_scenes(path: Path, index: int | None) -> list[Scene]:
    """A trained scene, dense and pruned to a tenth by the paper's score, at one of its cameras.

    Args:
        path: a Splatfacto run (its folder or ``config.yml``), seen from its held-out cameras, or a PLY, seen from
            sampled ones.
        index: which camera; the middle one if None.

    Raises:
        SceneError: if the scene or its cameras cannot be read, or there is no such camera.
    """
    from pointsplat_ns.looking.sampling import sample_views
    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
    from pointsplat_ns.pruning import prune

    dense = read_scene(path)
    views = sample_views(dense, SAMPLED) if path.suffix.lower() == ".ply" else dataset_views(path, "test")
    index = len(views) // 2 if index is None else index
    if not 0 <= index < len(views):
        raise SceneError(f"{path}: view {index} asked for; expected 0 to {len(views) - 1}")
    viewmat, focal = views.viewmats[index].float(), float(views.Ks[index, 0, 0] / views.width)
    dense = dense[dense.usable()]
    scenes = {f"{name_of(path)} dense": dense, f"{name_of(path)} {KEEP:.0%}": prune(dense, KEEP, "paper")}
    return [Scene(name, name, activated(scene), viewmat, focal) for name, scene in scenes.items()]
