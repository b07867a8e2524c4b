"""A differentiable rasterizer of 3D Gaussians in plain torch, with gsplat's interface."""

from pointsplat_ns.rendering.rasterize import rasterization
from pointsplat_ns.rendering.render_scene import (
    pixel_sums,
    pixels_of,
    pixels_of_each,
    render,
    render_depth,
    render_with_alpha,
)

__all__ = [
    "pixel_sums",
    "pixels_of",
    "pixels_of_each",
    "rasterization",
    "render",
    "render_depth",
    "render_with_alpha",
]
