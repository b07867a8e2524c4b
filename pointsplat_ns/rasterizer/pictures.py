"""Pictures without gradients by compiled kernels (``compiled/pictures.cpp``): projection, colours and tiles in one pass
over the Gaussians, then blending as for any picture (:mod:`~pointsplat_ns.rasterizer.compiled.blending`).

:func:`~pointsplat_ns.rasterization` gives the same pictures to rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import projection
from pointsplat_ns.rasterizer.blending import untiled
from pointsplat_ns.rasterizer.compiled import blending, tiles
from pointsplat_ns.rasterizer.constants import MEMORY_BUDGET
from pointsplat_ns.rasterizer.ellipses import Grid
from pointsplat_ns.rasterizer.projection import Camera, count_meaningless
from pointsplat_ns.rasterizer.quadratics import PIXELS
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, Struct, on_threads
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import one_thread

MOST_PAIRS = MEMORY_BUDGET // 16
"""Largest number of pairs of Gaussian and tile in one pass, of 12 bytes each; pictures of more are drawn by regions."""


def _placed(
    scene: Gaussians, camera: Camera, colored: bool, alpha_min: float
) -> tuple[Struct, Tensor, list[Tensor]] | None:
    """The task of drawing a picture, with or without colours, the Gaussians of each tile front to back (P,), int64, and
    the means, quaternions, standard deviations and opacities of the Gaussians as the kernels read them; None if the
    pairs are more than :data:`MOST_PAIRS`."""
    library, count = KERNELS.library, len(scene)
    with one_thread():  # where the shares of threads end, torch rounds a sigmoid in another way
        tensors = [value.contiguous() for value in (scene.means, scene.quats, scene.stds, scene.alphas)]
    coefficients = scene.features_dc.contiguous(), scene.features_rest.contiguous()
    channels, grid = (3 if colored else 0), Grid(camera.lens.width, camera.lens.height, alpha_min)
    ranges = -(-count // library.pointsplat_range())
    table, depths = torch.empty(count, 6 + channels, **FLOATS), torch.empty(count, **DOUBLES)
    ids, counts = torch.empty(count, **INDICES), torch.empty(ranges, **INDICES)
    task = KERNELS.structs["Placing"](
        camera=projection.camera_struct(*camera), scene=projection.scene_struct(*tensors),
        first=coefficients[0], rest=coefficients[1], rest_row=3 * coefficients[1].shape[1],
        degree=scene.sh_degree if colored else -1,
        most_color=torch.finfo(torch.float32).max ** 0.8, table=table, depths=depths, counts=counts,
        ids=ids,
    )  # fmt: skip
    on_threads(count >= SEVERAL, library.pointsplat_place, task)
    rows = projection.kept_rows(counts)
    order = ids[rows][tiles.by_depth(projection.depths_behind_nearest(depths[rows]))]
    found = tiles.listed(tiles.boxed(table, order, grid), grid, 0, grid.rows, most_pairs=MOST_PAIRS)
    if found is None:
        return None
    pairs, offsets, _ = found
    return blending.task_of(table, grid, pairs, offsets, offsets), pairs, tensors


def picture(scene: Gaussians, camera: Camera, alpha_min: float) -> tuple[Tensor, Tensor, int] | None:
    """Colours (H, W, 3) over black, alpha (H, W, 1) and the number of Gaussians that no camera can draw; None if the
    pairs of Gaussians and tiles are more than :data:`MOST_PAIRS`."""
    found = _placed(scene, camera, True, alpha_min)
    if found is None:
        return None
    (task, pairs, tensors), lens = found, camera.lens
    image, final = torch.empty(task.tiles, 3, PIXELS, **FLOATS), torch.empty(task.tiles, PIXELS, **FLOATS)
    task.fill(image=image, final_=final, blended=torch.empty(task.tiles, **INDICES))
    on_threads(pairs.numel() >= SEVERAL, KERNELS.library.pointsplat_blend, task)
    colors, through = (untiled(values, task.columns)[: lens.height, : lens.width] for values in (image, final))
    return colors, 1.0 - through, count_meaningless(*tensors)


def weights(scene: Gaussians, camera: Camera, alpha_min: float) -> Tensor | None:
    """Blending weight of each Gaussian, summed over the pixels of a picture, (N,); None as for :func:`picture`."""
    found = _placed(scene, camera, False, alpha_min)
    return found and blending.weigh(*found[:2], len(scene))


def can_draw(scene: Gaussians, wanted: bool | None) -> bool:
    """Whether the kernels draw a scene: float32, on a CPU, without gradients. ``wanted`` as ``compiled`` of
    :func:`~pointsplat_ns.rasterization`."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in scene.tensors()):
        return False
    return KERNELS.usable_for(wanted, scene.means)
