"""A fast SSIM for training losses.

The definition is that of pytorch-msssim, which Splatfacto uses, and of :func:`pointsplat_ns.ssim`,
which uses kornia. Both blur five maps one after the other. Here a compiled kernel
(``structural_similarity.cpp``) blurs all in one pass, for float32 on a CPU; without the kernel,
torch blurs them in one batch, which takes about half the time. Tests check that all agree.
"""

from __future__ import annotations

import ctypes
import functools
import math

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import DOUBLES


class SimilarityStruct(Struct):
    """``Similarity`` of ``structural_similarity.cpp``, which says what its members are."""

    members = {
        "image": FLOAT_POINTER,
        "other": FLOAT_POINTER,
        "window": FLOAT_POINTER,
        "planes": ctypes.c_int64,
        "height": ctypes.c_int64,
        "row": ctypes.c_int64,
        "step": ctypes.c_int64,
        "bands": ctypes.c_int64,
        "partials": FLOAT_POINTER,
        "sums": DOUBLE_POINTER,
        "grad": FLOAT_POINTER,
    }
    _fields_ = c_fields(members)


similarity_kernel = Function("pointsplat_similarity", SimilarityStruct, INT64_POINTER)

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""


def mean_ssim(image: Tensor, other: Tensor, compiled: bool | None = None) -> Tensor:
    """Mean structural similarity (Wang et al. 2004, eq. 13) of two images.

    11 x 11 Gaussian window of sigma 1.5, population moments, only pixels whose window is inside the
    image. A side shorter than the window is not blurred, as in pytorch-msssim.

    Args:
        image: (B, C, H, W), in [0, 1].
        other: the same shape.
        compiled: False uses torch; True warns if the kernel is missing.

    Returns:
        A scalar in [-1, 1]; 1 for identical images. Differentiable.
    """
    if _suited(image, other) and KERNELS.usable_for(compiled, image, other):
        # symmetric, and the kernel gives the gradient of the first argument
        if other.requires_grad and torch.is_grad_enabled():
            image, other = other, image
        return CompiledSimilarity.apply(image, other)
    maps = torch.cat([image, other, image * image, other * other, image * other], dim=1)
    mean, other_mean, square, other_square, product = _blur(maps).chunk(5, dim=1)
    # the constants of Wang et al. 2004 for a data range of 1
    light = 0.01**2
    detail = 0.03**2
    mean_product = mean * other_mean
    mean_square = mean * mean
    other_mean_square = other_mean * other_mean
    contrast = (2 * (product - mean_product) + detail) / (
        square - mean_square + other_square - other_mean_square + detail
    )
    luminance = (2 * mean_product + light) / (mean_square + other_mean_square + light)
    return (luminance * contrast).mean()


def _blur(maps: Tensor) -> Tensor:
    """Gaussian blur of (B, K, H, W) where the whole window fits: (B, K, H - 10, W - 10)."""
    channels = maps.shape[1]
    weight = _window(maps.dtype, maps.device).repeat(channels, 1, 1, 1)  # (K, 1, 1, 11)
    if maps.shape[3] >= SSIM_WINDOW:
        maps = F.conv2d(maps, weight, groups=channels)
    if maps.shape[2] >= SSIM_WINDOW:
        maps = F.conv2d(maps, weight.transpose(2, 3), groups=channels)
    return maps


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Window weights (11,) along one side."""
    with torch.inference_mode(False):  # cached, and later used with gradients
        offset = torch.arange(SSIM_WINDOW, dtype=dtype, device=device) - SSIM_WINDOW // 2
        weight = torch.exp(-offset.square() / (2 * 1.5**2))  # sigma of 1.5 pixels
        return weight / weight.sum()


def _suited(image: Tensor, other: Tensor) -> bool:
    """Whether the kernel supports images of these sizes, with a gradient for at most one of
    them."""
    return (
        image.dim() == 4
        and image.shape == other.shape
        and min(image.shape[2:]) >= SSIM_WINDOW
        and image.numel() > 0
        and not (torch.is_grad_enabled() and image.requires_grad and other.requires_grad)
    )


class CompiledSimilarity(torch.autograd.Function):
    """:func:`mean_ssim` by the kernel, with the gradient of the first image."""

    @staticmethod
    def forward(ctx, image, other):
        # Interleaved channels, as in a render, are used in place; at most MOST_STEP of the kernel.
        interleaved = image.shape[1] <= 4 and image.permute(0, 2, 3, 1).is_contiguous()
        order = (0, 2, 3, 1) if interleaved else (0, 1, 2, 3)
        image, other = (tensor.detach().permute(order).contiguous() for tensor in (image, other))
        batch, *_, side = image.shape
        planes, height = (
            (batch, image.shape[1]) if interleaved else (batch * image.shape[1], image.shape[2])
        )
        step, row = (side, image.shape[2] * side) if interleaved else (1, side)
        rows = height - SSIM_WINDOW + 1
        windows = row - (SSIM_WINDOW - 1) * step
        # rows per band
        ctx.shape = (planes, height, row, step, math.ceil(rows / 48))
        ctx.interleaved = interleaved
        ctx.count = planes * rows * windows
        partials = image.new_empty(3, planes, rows, windows) if ctx.needs_input_grad[0] else None
        sums = torch.empty(planes * ctx.shape[-1], **DOUBLES)
        _call(image, other, ctx.shape, partials, sums=sums)
        ctx.save_for_backward(image, other, partials)
        return (sums.sum() / ctx.count).float()

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        image, other, partials = ctx.saved_tensors
        by_image = torch.empty_like(image)
        _call(image, other, ctx.shape, partials, grad=by_image)
        by_image *= grad / ctx.count
        return by_image.permute(0, 3, 1, 2) if ctx.interleaved else by_image, None


def _call(
    image: Tensor,
    other: Tensor,
    shape: tuple[int, int, int, int, int],
    partials: Tensor | None,
    sums: Tensor | None = None,
    grad: Tensor | None = None,
) -> None:
    planes, height, row, step, bands = shape
    task = SimilarityStruct(
        image=image,
        other=other,
        window=_window(image.dtype, image.device),
        planes=planes,
        height=height,
        row=row,
        step=step,
        bands=bands,
        partials=partials,
        sums=sums,
        grad=grad,
    )
    on_threads(planes * bands > 1, similarity_kernel, task)
