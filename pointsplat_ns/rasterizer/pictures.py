"""Pictures without gradients by compiled kernels (``compiled/pictures.cpp``): projection, colours and tiles in one pass
over the Gaussians, then blending as for any picture (:mod:`~pointsplat_ns.rasterizer.compiled.blending`).

:func:`~pointsplat_ns.rasterization` gives the same pictures to rounding. The trial of all kernels is here, too.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.blending import untiled
from pointsplat_ns.rasterizer.compiled import blending
from pointsplat_ns.rasterizer.compiled.blending import KernelInputs
from pointsplat_ns.rasterizer.compiled.projection import camera_struct, scene_struct
from pointsplat_ns.rasterizer.constants import ALPHA_MIN, SLACK, TILE
from pointsplat_ns.rasterizer.ewa import Lens
from pointsplat_ns.rasterizer.projection import camera_of, count_meaningless
from pointsplat_ns.rasterizer.quadratics import PIXELS
from pointsplat_ns.rasterizer.rendering import Colors, rasterization
from pointsplat_ns.rasterizer.tiles import Region
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, agreement, on_threads
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
    colors, through = (untiled(values, whole)[0, : lens.height, : lens.width] for values in (image, final))
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


@KERNELS.tried_by
def _as_torch() -> bool:
    """Whether all kernels of the rasterizer do what torch does: projection, colours of each degree, tiles and blending
    of two images of some Gaussians, with gradients, and pictures and weights of a scene."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, **FLOATS)

    rasterized: Any = rasterization  # its arguments are lists here
    count, width, height = 90, 43, 38
    means = random(count, 3) * 1.5 + torch.tensor([0.0, 0.0, 4.0], **FLOATS)
    shapes = random(count, 4), (0.8 * random(count, 3) - 1.5).exp(), random(count).sigmoid()
    first, rest = random(count, 3), 0.3 * random(count, 15, 3)
    views = torch.eye(4, **FLOATS).repeat(2, 1, 1)
    views[1, 0, 3] = 0.5
    K = torch.tensor([[30.0, 0.0, 18.0], [0.0, 32.0, 21.0], [0.0, 0.0, 1.0]], **FLOATS)
    weights_of_pixels = random(2, height, width, 5)
    spoilt = [value.clone() for value in (means, *shapes)]
    for row, (value, wrong) in enumerate(zip(spoilt, (math.nan, math.inf, -1.0, -1.0), strict=True)):
        value[row] = wrong

    def drawn(compiled: bool, degree: int | None, **options: Any) -> list[Tensor]:
        """Images, alphas, what is seen, and the gradients."""
        leaves = [value.clone().requires_grad_() for value in (*spoilt, first, rest, views)]
        colors = first if degree is None else torch.cat([leaves[4][:, None], leaves[5]], 1)
        given: Colors = (leaves[4], leaves[5]) if degree == 3 else colors
        image, alphas, meta = rasterized(
            *leaves[:4], given, leaves[6], K.expand(2, 3, 3), width, height, sh_degree=degree, absgrad=True,
            compiled=compiled, **options,
        )  # fmt: skip
        both = torch.cat([image, alphas], -1)
        grads = torch.autograd.grad(
            (both * weights_of_pixels[..., : both.shape[-1]]).sum(), leaves, materialize_grads=True
        )
        seen = [meta["gaussian_ids"], meta["radii"], torch.tensor([meta["skipped"]], **INDICES)]
        return [image, alphas, meta["means2d"].absgrad, meta["conics"], meta["depths"], *grads, *seen]

    cases: list[dict[str, Any]] = [
        {"degree": 0, "render_mode": "D"}, {"degree": 1, "render_mode": "RGB+ED", "memory_budget": 30_000},
        {"degree": 2}, {"degree": 3, "rasterize_mode": "antialiased"},
    ]  # fmt: skip
    with torch.enable_grad():
        for case in cases:
            (*ours, ids, radii, skipped), (*torchs, torchs_ids, torchs_radii, torchs_skipped) = (
                drawn(compiled, **case) for compiled in (True, False)
            )
            if not (torch.equal(ids, torchs_ids) and torch.equal(skipped, torchs_skipped)):
                return False
            if not agreement([*ours, radii.float()], [*torchs, torchs_radii.float()], off=1e-3, share=1e-2):
                return False
        # a picture in one pass, and the weights, which are the gradient of its sum by colours of one channel
        flat = torch.zeros(count, 1, requires_grad=True, **FLOATS)
        options: dict[str, Any] = {"rasterize_mode": "antialiased", "compiled": False}
        view = views[:1], K[None], width, height
        (pixels,) = torch.autograd.grad(rasterized(means, *shapes, flat, *view, **options)[0].sum(), flat)
    with torch.no_grad():
        image, alpha, _ = rasterized(means, *shapes, (first, rest), *view, sh_degree=3, **options)
        scene = Gaussians(means, shapes[1].log(), shapes[0], shapes[2].logit()[:, None], first, rest)
        camera = camera_of(views[0], K, width, height, 0.01, math.inf, 0.0, 0.3, True)
        ours_drawn, weighed = picture(scene, camera, ALPHA_MIN, 10**6), weights(scene, camera, ALPHA_MIN, 10**6)
    if ours_drawn is None or weighed is None:
        return False
    return agreement([*ours_drawn[:2], weighed], [image[0], alpha[0], pixels[:, 0]], off=1e-4, share=1e-2)
