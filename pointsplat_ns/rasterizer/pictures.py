"""Pictures without gradients by compiled kernels (``compiled/pictures.cpp``): projection, colours and tiles in one pass
over the Gaussians, then blending as for any picture (:mod:`~pointsplat_ns.rasterizer.compiled.blending`).

:func:`~pointsplat_ns.rasterization` gives the same pictures to rounding.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.blending import untiled
from pointsplat_ns.rasterizer.compiled import blending
from pointsplat_ns.rasterizer.compiled.blending import KernelInputs
from pointsplat_ns.rasterizer.compiled.projection import camera_struct, scene_struct
from pointsplat_ns.rasterizer.constants import SLACK, TILE
from pointsplat_ns.rasterizer.ewa import Lens
from pointsplat_ns.rasterizer.projection import count_meaningless
from pointsplat_ns.rasterizer.quadratics import PIXELS
from pointsplat_ns.rasterizer.tiles import Region
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, on_threads
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import one_thread

Camera = tuple[Tensor, Tensor, Lens]
"""Rotation (3, 3) and centre (3,), float64, and intrinsics, as of
:func:`~pointsplat_ns.rasterizer.projection.camera_of`."""


def _placed(
    scene: Gaussians, camera: Camera, colored: bool, alpha_min: float, most_pairs: int
) -> tuple[KernelInputs, Tensor, Tensor, list[Tensor]] | None:
    """What is drawn on which tile.

    Args:
        scene: N Gaussians.
        camera: where from.
        colored: whether the table has colours.
        alpha_min: a Gaussian is not drawn where its alpha is lower.
        most_pairs: largest number of pairs of a Gaussian and a tile.

    Returns:
        The table of Gaussians, the Gaussians of each tile front to back (P,), where those of each tile start
        (tiles + 1,), both int64, and the means, quaternions, standard deviations and opacities of the Gaussians as the
        kernels read them; None if the pairs are too many.
    """
    library, count = KERNELS.library, len(scene)
    with one_thread():  # where the shares of threads end, torch rounds a sigmoid in another way
        tensors = [value.contiguous() for value in (scene.means, scene.quats, scene.stds, scene.alphas)]
    coefficients = scene.features_dc.contiguous(), scene.features_rest.contiguous()
    channels, whole = (3 if colored else 0), _whole(camera[2])
    ranges = -(-count // library.pointsplat_range())
    table, depths = torch.empty(count, 6 + channels, **FLOATS), torch.empty(count, **DOUBLES)
    ids, boxes = (
        torch.empty(count, dtype=torch.int32, device="cpu"),
        torch.empty(count, 4, dtype=torch.int32, device="cpu"),
    )
    counts, heights = torch.empty(ranges, **INDICES), torch.empty(ranges, **INDICES)
    nearest = torch.empty(ranges, **DOUBLES)
    offsets = torch.zeros(whole.rows * whole.columns + 1, **INDICES)
    inputs = KernelInputs(table, channels, alpha_min)
    task = KERNELS.structs["Placing"](
        camera=camera_struct(*camera), scene=scene_struct(*tensors),
        first=coefficients[0], rest=coefficients[1], rest_row=3 * coefficients[1].shape[1],
        degree=scene.sh_degree if colored else -1,
        rows=whole.rows, columns=whole.columns, log2_alpha_min=math.log2(alpha_min), slack=SLACK,
        most_color=torch.finfo(torch.float32).max ** 0.8, table=table, ids=ids, depths=depths, boxes=boxes,
        counts=counts, heights=heights, nearest=nearest, offsets=offsets,
    )  # fmt: skip
    on_threads(count >= SEVERAL, library.pointsplat_place, task)
    drawn = int(counts.sum())
    order, strips = torch.empty(drawn, **INDICES), torch.empty(int(heights.sum()), 2, dtype=torch.int32, device="cpu")
    task.fill(order=order, strips=strips)
    library.pointsplat_count_placed(task)
    offsets = torch.cumsum(offsets, 0)
    total = int(offsets[-1])
    if total > most_pairs:
        return None
    pairs = torch.empty(total, **INDICES)
    task.fill(offsets=offsets, pairs=pairs)
    library.pointsplat_list_placed(task, drawn, offsets[:-1].clone())
    return inputs, pairs, offsets, tensors


def _whole(lens: Lens) -> Region:
    """All tiles of a picture."""
    return Region(0, -(-lens.height // TILE), 0, -(-lens.width // TILE))


def picture(scene: Gaussians, camera: Camera, alpha_min: float, most_pairs: int) -> tuple[Tensor, Tensor, int] | None:
    """Colours (H, W, 3) over black, alpha (H, W, 1) and the number of Gaussians that no camera can draw; None if the
    pairs of Gaussians and tiles are more than ``most_pairs``."""
    found = _placed(scene, camera, True, alpha_min, most_pairs)
    if found is None:
        return None
    (inputs, pairs, offsets, tensors), lens = found, camera[2]
    whole, count = _whole(lens), offsets.numel() - 1
    image, final = torch.empty(count, 3, PIXELS, **FLOATS), torch.empty(count, PIXELS, **FLOATS)
    task = blending.task_of((lens.width, lens.height), whole, pairs, offsets, inputs, offsets)
    task.fill(image=image, final_=final, blended=torch.empty_like(offsets))
    on_threads(pairs.numel() >= SEVERAL, KERNELS.library.pointsplat_blend, task)
    colors, through = (untiled(values, whole)[: lens.height, : lens.width] for values in (image, final))
    return colors, 1.0 - through, count_meaningless(*tensors)


def weights(scene: Gaussians, camera: Camera, alpha_min: float, most_pairs: int) -> Tensor | None:
    """Blending weight of each Gaussian, summed over the pixels of a picture, (N,); None as for :func:`picture`."""
    found = _placed(scene, camera, False, alpha_min, most_pairs)
    if found is None:
        return None
    (inputs, pairs, offsets, _), lens = found, camera[2]
    task = blending.task_of((lens.width, lens.height), _whole(lens), pairs, offsets, inputs, offsets)
    return blending.weigh(task, pairs, len(scene))


def can_draw(scene: Gaussians, wanted: bool | None) -> bool:
    """Whether the kernels draw a scene: float32, on a CPU, without gradients. ``wanted`` as ``compiled`` of
    :func:`~pointsplat_ns.rasterization`."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in scene.tensors()):
        return False
    return KERNELS.usable_for(wanted, scene.means)
