"""Photos of a room: ray casting, texture times light, highlights that move with the viewer."""

import torch
from torch import Tensor

from lab.rooms.building import Light
from lab.rooms.raycast import dot, surface, trace, unit
from lab.rooms.room import Room
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.system.threads import one_thread


def default_intrinsics(width: int, height: int) -> Tensor:
    """(3, 3) intrinsics in pixels of a camera that sees 78 degrees across, the first pixel's centre
    at (0.5, 0.5)."""
    focal = 0.62 * width
    return torch.tensor(
        [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], **FLOATS
    )


def render_room(
    room: Room,
    c2w: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """A photo of a room, by ray casting with 2 x 2 rays a pixel.

    Args:
        room: the room.
        c2w: camera-to-world, OpenCV axes, inside the room.
        K: intrinsics in pixels, the first pixel's centre at (0.5, 0.5).
        width: of the image, pixels.
        height: of the image, pixels.

    Returns:
        rgb (H, W, 3) in [0, 1], sRGB-like (gamma 2.2), and depth (H, W) along the optical axis in
        metres, of the ray through each pixel's centre.

    Example:
        >>> from lab.rooms import capture_path, make_room
        >>> room = make_room(seed=3)
        >>> pose = capture_path(room, frames=40, seed=3)[0]
        >>> rgb, depth = render_room(room, pose, default_intrinsics(32, 24), 32, 24)
        >>> tuple(rgb.shape), tuple(depth.shape)
        ((24, 32, 3), (24, 32))
    """
    c2w = c2w.float()
    K = K.float()
    eye = c2w[:3, 3:]
    rotation = c2w[:3, :3]
    with one_thread(), torch.no_grad():
        fine = _camera_rays(K, width, height, 2)
        rows = max((1 << 14) // width, 1)
        bands = [_shaded(room, eye, rotation @ rays, K) for rays in fine.split(rows * width, 1)]
        display = 1.0 - torch.exp(torch.cat(bands) * (-1.6 * room.baked.exposure))
        rgb = display.view(height, 2, width, 2, 3).mean(dim=(1, 3)).clamp(0, 1) ** (1 / 2.2)
        rays = _camera_rays(K, width, height, 1)
        depth = [
            trace(room.solids, eye, rotation @ part)[0] for part in rays.split(rows * width, 1)
        ]
    return rgb, torch.cat(depth).view(height, width)


def _camera_rays(K: Tensor, width: int, height: int, side: int) -> Tensor:
    """(3, M) camera-space directions with z = 1 through the middles of ``side`` x ``side`` parts of
    all pixels."""
    x, y = ((torch.arange(count * side, **FLOATS) + 0.5) / side for count in (width, height))
    v, u = torch.meshgrid((y - K[1, 2]) / K[1, 1], (x - K[0, 2]) / K[0, 0], indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)]).flatten(1)


def _shaded(room: Room, eye: Tensor, ways: Tensor, K: Tensor) -> Tensor:
    """Radiance (M, 3) along rays from a camera: texture times baked light, plus what shines, plus
    highlights."""
    baked = room.baked
    z, index = trace(room.solids, eye, ways)
    points = eye + ways * z
    hits = surface(room.solids, points, index)
    view = -unit(ways)
    facing = dot(view, hits.normal).abs().clamp(min=0.05)
    # A sample's patch is z / 2f wide and stretched by 1 / facing one way: the geometric mean of
    # both.
    footprint = z / (2 * K[0, 0]) / facing.sqrt()
    color = baked.texture.sample(hits.chart, hits.u, hits.v, footprint)
    light = baked.light.sample(hits.chart, hits.u, hits.v, torch.zeros_like(z))
    emission = baked.emission[hits.chart, None]
    gloss = baked.gloss[hits.chart]
    # What shines is shown as painted, whatever the room's exposure.
    radiance = color * torch.where(emission > 0, emission / baked.exposure, light[:, :3])
    for number, source in enumerate(room.lights):
        seen = light[:, 3 + number] * gloss
        part = (seen > 1e-3).nonzero()[:, 0]
        shininess = baked.shininess[hits.chart[part]]
        lobe = seen[part] * _highlight(
            source, points[:, part], hits.normal[:, part], view[:, part], shininess
        )
        tint = torch.tensor(source.color, **FLOATS)
        radiance.index_add_(0, part, lobe[:, None] * (tint / tint.max() / baked.exposure))
    return radiance


def _highlight(
    light: Light, points: Tensor, normal: Tensor, view: Tensor, shininess: Tensor
) -> Tensor:
    """Blinn-Phong highlight (M,) of one light at points (3, M), in [0, 4].

    The half vector is taken to the point of the light nearest to where the mirrored view ray meets
    its plane (a representative point, Karis 2013), so that a window gives a window-shaped gleam.
    Schlick's factor, four times the strength at grazing view, follows the half vector.
    """
    mirrored = 2 * dot(view, normal) * normal - view
    target = torch.tensor(light.center, **FLOATS)[:, None]
    distance = dot(target - points, light.normal) / dot(mirrored, light.normal).clamp(max=-1e-3)
    meet = points + mirrored * distance.clamp(0, 100) - target
    for edge in (light.edge_u, light.edge_v):
        target = (
            target
            + (dot(meet, edge) / dot(edge, edge)).clamp(-1, 1)
            * torch.tensor(edge, **FLOATS)[:, None]
        )
    way = unit(target - points)
    half = unit(way + view)
    lobe = dot(half, normal).clamp(min=1e-6) ** shininess
    # Soft ends at the light's own plane and at the surface's horizon.
    lobe = (
        lobe * -dot(way, light.normal).clamp(-0.3, 0) / 0.3 * (dot(way, normal) / 0.1).clamp(0, 1)
    )
    return lobe * (1 + 3 * (1 - dot(half, view).clamp(0, 1)) ** 5)
