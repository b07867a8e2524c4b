"""Pictures without gradients by compiled kernels (``compiled/pictures.cpp``): projection, colours and tiles in one pass
over the Gaussians, then blending as for any picture (:mod:`~pointsplat_ns.rasterizer.compiled.blending`).

:func:`~pointsplat_ns.rasterization` gives the same pictures to rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.blending import untiled
from pointsplat_ns.rasterizer.compiled import blending, tiles
from pointsplat_ns.rasterizer.ellipses import Grid
from pointsplat_ns.rasterizer.ewa import Lens
from pointsplat_ns.rasterizer.projection import camera_struct, count_meaningless, scene_struct
from pointsplat_ns.rasterizer.quadratics import PIXELS
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, Struct, on_threads
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import one_thread

Camera = tuple[Tensor, Tensor, Lens]
"""Rotation (3, 3) and centre (3,), float64, and intrinsics, as of
:func:`~pointsplat_ns.rasterizer.projection.camera_of`."""


def _placed(
    scene: Gaussians, camera: Camera, colored: bool, alpha_min: float, most_pairs: int
) -> tuple[Struct, Tensor, list[Tensor]] | None:
    """What is drawn on which tile.

    Args:
        scene: N Gaussians.
        camera: where from.
        colored: whether the table has colours.
        alpha_min: a Gaussian is not drawn where its alpha is lower.
        most_pairs: largest number of pairs of a Gaussian and a tile.

    Returns:
        The task of drawing a picture, the Gaussians of each tile front to back (P,), int64, and the means, quaternions,
        standard deviations and opacities of the Gaussians as the kernels read them; None if the pairs are too many.
    """
    library, count = KERNELS.library, len(scene)
    with one_thread():  # where the shares of threads end, torch rounds a sigmoid in another way
        tensors = [value.contiguous() for value in (scene.means, scene.quats, scene.stds, scene.alphas)]
    coefficients = scene.features_dc.contiguous(), scene.features_rest.contiguous()
    channels, grid = (3 if colored else 0), Grid(camera[2].width, camera[2].height, alpha_min)
    ranges = -(-count // library.pointsplat_range())
    table, depths = torch.empty(count, 6 + channels, **FLOATS), torch.empty(count, **DOUBLES)
    counts = torch.empty(ranges, **INDICES)
    task = KERNELS.structs["Placing"](
        camera=camera_struct(*camera), scene=scene_struct(*tensors),
        first=coefficients[0], rest=coefficients[1], rest_row=3 * coefficients[1].shape[1],
        degree=scene.sh_degree if colored else -1,
        most_color=torch.finfo(torch.float32).max ** 0.8, table=table, depths=depths, counts=counts,
        ids=torch.empty(count, dtype=torch.int32, device="cpu"), nearest=torch.empty(ranges, **DOUBLES),
    )  # fmt: skip
    on_threads(count >= SEVERAL, library.pointsplat_place, task)
    order = torch.empty(int(counts.sum()), **INDICES)
    task.fill(order=order)
    library.pointsplat_order(task)
    found = tiles.listed(tiles.boxed(table, order, grid), grid, 0, grid.rows, most_pairs=most_pairs)
    if found is None:
        return None
    pairs, offsets, _ = found
    return blending.task_of(table, grid, pairs, offsets, offsets), pairs, tensors


def picture(scene: Gaussians, camera: Camera, alpha_min: float, most_pairs: int) -> tuple[Tensor, Tensor, int] | None:
    """Colours (H, W, 3) over black, alpha (H, W, 1) and the number of Gaussians that no camera can draw; None if the
    pairs of Gaussians and tiles are more than ``most_pairs``."""
    found = _placed(scene, camera, True, alpha_min, most_pairs)
    if found is None:
        return None
    (task, pairs, tensors), lens = found, camera[2]
    image, final = torch.empty(task.tiles, 3, PIXELS, **FLOATS), torch.empty(task.tiles, PIXELS, **FLOATS)
    task.fill(image=image, final_=final, blended=torch.empty(task.tiles, **INDICES))
    on_threads(pairs.numel() >= SEVERAL, KERNELS.library.pointsplat_blend, task)
    colors, through = (untiled(values, task.columns)[: lens.height, : lens.width] for values in (image, final))
    return colors, 1.0 - through, count_meaningless(*tensors)


def weights(scene: Gaussians, camera: Camera, alpha_min: float, most_pairs: int) -> Tensor | None:
    """Blending weight of each Gaussian, summed over the pixels of a picture, (N,); None as for :func:`picture`."""
    found = _placed(scene, camera, False, alpha_min, most_pairs)
    return found and blending.weigh(*found[:2], len(scene))


def can_draw(scene: Gaussians, wanted: bool | None) -> bool:
    """Whether the kernels draw a scene: float32, on a CPU, without gradients. ``wanted`` as ``compiled`` of
    :func:`~pointsplat_ns.rasterization`."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in scene.tensors()):
        return False
    return KERNELS.usable_for(wanted, scene.means)
