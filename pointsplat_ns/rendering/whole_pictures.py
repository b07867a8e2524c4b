"""Images with compiled kernels (``compiled/whole_pictures.cpp``).

Projection, colours and tiles take one pass over the Gaussians, followed by the usual blending
(:mod:`~pointsplat_ns.rendering.compiled.blending_kernels`). Gradients of a scene's parameters take
another pass. :func:`~pointsplat_ns.rasterization` gives the same images and gradients up to
rounding.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rendering import projection
from pointsplat_ns.rendering.blending import tiled, untiled
from pointsplat_ns.rendering.compiled import blending_kernels as blending
from pointsplat_ns.rendering.compiled import tile_kernels as tiles
from pointsplat_ns.rendering.constants import (
    ALPHA_MAX,
    MEMORY_BUDGET,
    SLACK,
    TRANSMITTANCE_MIN,
)
from pointsplat_ns.rendering.ellipses import Grid, TileList
from pointsplat_ns.rendering.projection import (
    Camera,
    CameraStruct,
    SceneStruct,
    count_meaningless,
    range_kernel,
)
from pointsplat_ns.rendering.quadratics import PIXELS
from pointsplat_ns.rendering.spherical_harmonics import zeros_like
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.kernels import (
    ANY_POINTER,
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES


class PlacingStruct(Struct):
    """``Placing`` of ``whole_pictures.cpp``, which documents its members."""

    members = {
        "camera": CameraStruct,
        "scene": SceneStruct,
        "first": FLOAT_POINTER,
        "rest": FLOAT_POINTER,
        "rest_row": ctypes.c_int64,
        "degree": ctypes.c_int64,
        "most_color": ctypes.c_float,
        "table": FLOAT_POINTER,
        "ids": INT64_POINTER,
        "depths": DOUBLE_POINTER,
        "counts": INT64_POINTER,
        "spoilt": INT64_POINTER,
    }
    _fields_ = c_fields(members)


class PlacingGradientStruct(Struct):
    """``PlacingGradient`` of ``whole_pictures.cpp``, which documents its members."""

    members = {
        "placing": PlacingStruct,
        "ids": INT64_POINTER,
        "drawn": ctypes.c_int64,
        "sums": FLOAT_POINTER,
        "means": FLOAT_POINTER,
        "quats": FLOAT_POINTER,
        "scales": FLOAT_POINTER,
        "opacities": FLOAT_POINTER,
        "first": FLOAT_POINTER,
        "rest": FLOAT_POINTER,
    }
    _fields_ = c_fields(members)


class WeighingStruct(Struct):
    """``Weighing`` of ``whole_pictures.cpp``, which documents its members."""

    members = {
        "placing": PlacingStruct,
        "cameras": ANY_POINTER,
        "views": ctypes.c_int64,
        "drawing": blending.TaskStruct,
        "slack": ctypes.c_float,
        "most_pairs": ctypes.c_int64,
        "weights": FLOAT_POINTER,
        "left_out": INT64_POINTER,
    }
    _fields_ = c_fields(members)


weigh_views_kernel = Function("pointsplat_weigh_views", WeighingStruct, INT64_POINTER)
place_kernel = Function("pointsplat_place", PlacingStruct, INT64_POINTER)
place_back_kernel = Function("pointsplat_place_back", PlacingGradientStruct, INT64_POINTER)

MOST_PAIRS = MEMORY_BUDGET // 16
"""Maximum number of pairs of Gaussian and tile in one pass, of 12 bytes each; larger images are
drawn in regions."""


class _Placed(NamedTuple):
    """The Gaussians of a scene that one camera sees."""

    grid: Grid
    # [N, 6 + channels], as of :func:`blending.inputs_of`; rows of visible Gaussians
    table: Tensor
    tiles: TileList
    ids: Tensor  # [M] int64, the visible Gaussians, ascending
    task: Struct  # of the kernel
    skipped: int  # number of Gaussians with invalid values


@torch.no_grad()
def _placed(
    scene: Gaussians, camera: Camera, colored: bool, alpha_min: float, taped: bool = False
) -> _Placed | None:
    """The Gaussians that a camera sees, with or without colours, and with the lists for gradients
    if ``taped``; None if there are more than :data:`MOST_PAIRS` pairs, or too little memory for
    gradients of 192 bytes per pair."""
    count = len(scene)
    tensors = [value.contiguous() for value in (scene.means, scene.quats, scene.stds, scene.alphas)]
    coefficients = scene.features_dc.contiguous(), scene.features_rest.contiguous()
    channels = 3 if colored else 0
    grid = Grid(camera.lens.width, camera.lens.height, alpha_min)
    ranges = -(-count // range_kernel())
    table = torch.empty(count, 6 + channels, **FLOATS)
    depths = torch.empty(count, **DOUBLES)
    ids, counts, spoilt = (torch.empty(size, **INDICES) for size in (count, ranges, ranges))
    task = PlacingStruct(
        camera=projection.camera_struct(*camera),
        scene=projection.scene_struct(*tensors),
        first=coefficients[0],
        rest=coefficients[1],
        rest_row=3 * coefficients[1].shape[1],
        degree=scene.sh_degree if colored else -1,
        most_color=torch.finfo(torch.float32).max ** 0.8,
        table=table,
        depths=depths,
        counts=counts,
        spoilt=spoilt,
        ids=ids,
    )
    on_threads(count >= SEVERAL, place_kernel, task)
    rows = projection.packed_rows(counts)
    ids = ids[rows]
    order = ids[tiles.by_depth(projection.depths_behind_nearest(depths[rows]))]
    most = MOST_PAIRS // 12 if taped else MOST_PAIRS
    found = tiles.listed(tiles.boxed(table, order, grid), grid, 0, grid.rows, taped, most)
    return found and _Placed(
        grid, table, found, ids, task, count_meaningless(*tensors) + int(spoilt.sum())
    )


class _Picture(torch.autograd.Function):
    """Image and alpha from the parameters of a scene that was placed."""

    @staticmethod
    def forward(ctx, placed: _Placed, background: Tensor, *parameters: Tensor):
        grid = placed.grid
        number = placed.grid.rows * placed.grid.columns
        image = torch.empty(number, 3, PIXELS, **FLOATS)
        final = torch.empty(number, PIXELS, **FLOATS)
        needs_grad = any(ctx.needs_input_grad)
        tape = blending.blend_region(grid, placed.tiles, placed.table, image, final, needs_grad)
        colors, through = (
            untiled(of, grid.columns)[: grid.height, : grid.width] for of in (image, final)
        )
        colors = colors + through * background
        drawn = colors.clamp(0, 1)
        if needs_grad:
            ctx.save_for_backward(*parameters)
            ctx.placed = placed
            ctx.tape = tape
            ctx.final = final
            ctx.background = background
            ctx.inside = drawn == colors
        return drawn, 1.0 - through

    @staticmethod
    @once_differentiable
    def backward(ctx, by_picture: Tensor, by_alpha: Tensor):
        placed = ctx.placed
        parameters = ctx.saved_tensors
        by_colors = by_picture * ctx.inside
        by_through = (by_colors * ctx.background).sum(-1, keepdim=True) - by_alpha
        by_color, by_final = (
            tiled(by, placed.grid.rows, placed.grid.columns) for by in (by_colors, by_through)
        )
        sums = blending.differentiate_region(
            placed.grid, placed.tiles, placed.table, ctx.tape, ctx.final, by_color, by_final, False
        )
        # in the order of the scene's fields
        names = ("means", "scales", "quats", "opacities", "first", "rest")
        wanted = zip(names, parameters, ctx.needs_input_grad[2:], strict=True)
        out = {name: zeros_like(value) if needed else None for name, value, needed in wanted}
        task = PlacingGradientStruct(
            placing=placed.task, ids=placed.ids, drawn=len(placed.ids), sums=sums, **out
        )
        on_threads(len(parameters[0]) >= SEVERAL, place_back_kernel, task)
        return None, None, *out.values()


def picture(
    scene: Gaussians, camera: Camera, background: Tensor, alpha_min: float
) -> tuple[Tensor, Tensor, int] | None:
    """Image (H, W, 3) over a background (3,), in [0, 1], and alpha (H, W, 1), both differentiable
    in the scene; and the number of Gaussians with invalid values (colours are checked only in
    view). None if there are too many pairs of Gaussian and tile for one pass."""
    taped = torch.is_grad_enabled() and any(value.requires_grad for value in scene.tensors())
    placed = _placed(scene, camera, True, alpha_min, taped)
    return placed and (
        *_Picture.apply(placed, background.to(scene.means), *scene.tensors()),
        placed.skipped,
    )


def weights(scene: Gaussians, camera: Camera, alpha_min: float) -> Tensor | None:
    """Blending weight of each Gaussian, summed over the pixels of an image, (N,); None as for
    :func:`picture`."""
    placed = _placed(scene, camera, False, alpha_min)
    if placed is None:
        return None
    pairs, offsets, *_ = placed.tiles
    return blending.weigh(
        blending.task_of(placed.table, placed.grid, pairs, offsets, offsets), pairs, len(scene)
    )


def weights_of_each(
    scene: Gaussians, cameras: Sequence[Camera], alpha_min: float
) -> tuple[Tensor, list[int]]:
    """:func:`weights` in each of V small images, (V, N), in one call; and the indices of the images
    with too many pairs of Gaussian and tile for one pass, which are left out: their rows are 0."""
    tensors = [value.contiguous() for value in (scene.means, scene.quats, scene.stds, scene.alphas)]
    structs = (CameraStruct * len(cameras))(
        *(projection.camera_struct(*camera) for camera in cameras)
    )
    found = torch.zeros(len(cameras), len(scene), **FLOATS)
    left_out = torch.empty(len(cameras), **INDICES)
    task = WeighingStruct(
        placing=PlacingStruct(scene=projection.scene_struct(*tensors), degree=-1),
        cameras=ctypes.addressof(structs),
        views=len(cameras),
        drawing=blending.TaskStruct(
            log2_alpha_min=math.log2(alpha_min),
            alpha_max=ALPHA_MAX,
            transmittance_min=TRANSMITTANCE_MIN,
        ),
        slack=SLACK,
        most_pairs=MOST_PAIRS,
        weights=found,
        left_out=left_out,
    )
    on_threads(len(cameras) * len(scene) >= SEVERAL, weigh_views_kernel, task)
    return found, left_out.nonzero()[:, 0].tolist()


def can_draw(scene: Gaussians, wanted: bool | None) -> bool:
    """Whether the kernels can draw a scene: float32, on a CPU. ``wanted`` is as ``compiled`` of
    :func:`~pointsplat_ns.rasterization`."""
    return KERNELS.usable_for(wanted, scene.means)
