"""Photos of a room: ray casting, texture times light, highlights that move with the viewer."""

import torch
from torch import Tensor

from pointsplat_ns.rooms.building import Light
from pointsplat_ns.rooms.light import BakedRoom
from pointsplat_ns.rooms.raycast import dot, surface, trace_camera, unit
from pointsplat_ns.rooms.room import Room
from pointsplat_ns.system.threads import one_thread

SUBPIXELS = 2  # rays per pixel and axis
_BAND = 1 << 15  # rays of a band of rows
FOCAL = 0.62  # focal length over width: 78 degrees across


def default_intrinsics(width: int, height: int) -> Tensor:
    """(3, 3) intrinsics in pixels of the rooms' camera, the first pixel's centre at (0.5, 0.5)."""
    focal = FOCAL * width
    return torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def render_room(
    room: Room,
    c2w: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    highlights: bool = True,
) -> tuple[Tensor, Tensor]:
    """A photo of a room, by ray casting.

    Args:
        room: the room.
        c2w: camera-to-world, OpenCV axes, inside the room.
        K: intrinsics in pixels, the first pixel's centre at (0.5, 0.5).
        width: of the image, pixels.
        height: of the image, pixels.
        highlights: False leaves out all that depends on the viewer (for tests and comparison).

    Returns:
        rgb (H, W, 3) in [0, 1], sRGB-like (gamma 2.2), and depth (H, W) along the optical axis in
        metres, of the ray through each pixel's centre.

    Example:
        >>> from pointsplat_ns.rooms import capture_path, make_room
        >>> room = make_room(seed=3)
        >>> pose = capture_path(room, frames=40, seed=3)[0]
        >>> rgb, depth = render_room(room, pose, default_intrinsics(32, 24), 32, 24)
        >>> tuple(rgb.shape), tuple(depth.shape)
        ((24, 32, 3), (24, 32))
    """
    c2w, K = c2w.float(), K.float()
    step = max(_BAND // (width * SUBPIXELS**2), 1)
    bands = []
    with one_thread(), torch.no_grad():
        for first in range(0, height, step):
            band = K.clone()
            band[1, 2] -= first
            bands.append(_render_band(room, c2w, band, width, min(step, height - first), highlights))
    rgb, depth = zip(*bands, strict=True)
    return torch.cat(rgb), torch.cat(depth)


def _render_band(
    room: Room, c2w: Tensor, K: Tensor, width: int, height: int, highlights: bool
) -> tuple[Tensor, Tensor]:
    """:func:`render_room` for some rows: small enough that intermediate results stay in the cache."""
    prims, baked = room.spec.primitives, room.baked
    rays = _camera_rays(K, width, height, SUBPIXELS)
    depth, index = trace_camera(prims, c2w, rays, K, SUBPIXELS)
    radiance = _shade(baked, c2w, rays, K, depth, index, highlights)
    display = 1.0 - torch.exp(-radiance * (1.6 * baked.exposure))  # [SH, SW, 3]
    display = display.reshape(height, SUBPIXELS, width, SUBPIXELS, 3).mean(dim=(1, 3))
    center, _ = trace_camera(prims, c2w, _camera_rays(K, width, height, 1), K, 1)
    return display.clamp(0, 1) ** (1 / 2.2), center


def _camera_rays(K: Tensor, width: int, height: int, subpixels: int) -> Tensor:
    """(3, H * s, W * s) camera-space directions with z = 1 through the middles of all subpixels."""
    x = (torch.arange(width * subpixels) + 0.5) / subpixels
    y = (torch.arange(height * subpixels) + 0.5) / subpixels
    v, u = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)])


def _shade(
    baked: BakedRoom, c2w: Tensor, rays: Tensor, K: Tensor, depth: Tensor, index: Tensor, highlights: bool
) -> Tensor:
    """Radiance (SH, SW, 3): texture times baked light, plus what shines, plus highlights."""
    shape = depth.shape
    z = depth.reshape(-1)
    direction = c2w[:3, :3] @ rays.reshape(3, -1)
    points = c2w[:3, 3:] + direction * z
    hits = surface(baked.spec.primitives, points, index.reshape(-1))
    view = -unit(direction)
    facing = dot(view, hits.normal).abs().clamp(min=0.05)
    # A sample's patch is z / f wide and stretched by 1 / facing one way: the geometric mean of both.
    footprint = z / (K[0, 0] * SUBPIXELS) / facing.sqrt()
    color = baked.texture.sample_footprint(hits.chart, hits.u, hits.v, footprint)
    light = baked.light.sample(hits.chart, hits.u, hits.v, torch.zeros_like(hits.chart))
    emission = baked.emission[hits.chart]
    # What shines is shown as painted, whatever the room's exposure.
    radiance = color * (light[:, :3] + emission[:, None] / baked.exposure)
    if highlights:
        for k, source in enumerate(baked.spec.lights):
            seen = light[:, 3 + k] * baked.gloss[hits.chart]
            part = (seen > 1e-3).nonzero()[:, 0]
            shininess = baked.shininess[hits.chart[part]]
            at, normal, to_viewer = (values.index_select(1, part) for values in (points, hits.normal, view))
            lobe = _highlight(source, at, normal, to_viewer, shininess)
            tint = torch.tensor(source.color)
            radiance.index_add_(0, part, (seen[part] * lobe)[:, None] * (tint / tint.max() / baked.exposure))
    return radiance.reshape(*shape, 3)


def _highlight(light: Light, points: Tensor, normal: Tensor, view: Tensor, shininess: Tensor) -> Tensor:
    """Blinn-Phong highlight (M,) of one light at points (3, M), in [0, 4].

    The half vector is taken to the point of the light nearest to where the mirrored view ray meets
    its plane (a representative point, Karis 2013), so that a window gives a window-shaped gleam.
    Schlick's factor, four times the strength at grazing view, follows the half vector.
    """
    mirrored = 2 * dot(view, normal) * normal - view
    way = unit(_representative(light, points, mirrored) - points)
    half = unit(way + view)
    cosine = dot(half, normal).clamp(min=1e-6)
    lobe = torch.exp(shininess * torch.log(cosine))
    if light.normal is not None:
        leaving = -dot(way, light.normal)
        lobe = lobe * leaving.clamp(0, 0.3) / 0.3  # a soft end at the light's own plane
    lobe = lobe * (dot(way, normal) / 0.1).clamp(0, 1)  # and at the surface's horizon
    return lobe * (1 + 3 * (1 - dot(half, view).clamp(0, 1)) ** 5)


def _representative(light: Light, points: Tensor, mirrored: Tensor) -> Tensor:
    """(3, M) or (3, 1) points of a light."""
    center = torch.tensor(light.center)[:, None]
    if light.normal is None:
        return center
    slope = dot(mirrored, light.normal).clamp(max=-1e-3)
    distance = dot(center - points, light.normal) / slope
    meet = points + mirrored * distance.clamp(0, 100) - center
    target = center
    for edge in (light.edge_u, light.edge_v):
        along = (dot(meet, edge) / dot(edge, edge)).clamp(-1, 1)
        target = target + along * torch.tensor(edge)[:, None]
    return target
