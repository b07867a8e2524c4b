"""Writes 3D Tiles content: ``.glb`` with Gaussians as SPZ inside (``KHR_gaussian_splatting``)."""

from __future__ import annotations

from pointsplat_ns.scene.formats.gltf import SPLATS, SPZ, SPZ_INSIDE, content_with_spz
from pointsplat_ns.scene.formats.gltf_container import pack_glb
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians

TILE_EXTENSIONS = (SPLATS, SPZ)
"""glTF extensions that a viewer must support to draw tiles."""


def encode_tile(scene: Gaussians, spz_version: int = SPZ_INSIDE) -> bytes:
    """Encode the N > 0 Gaussians of a scene, float32 on the CPU, as a ``.glb`` for CesiumJS.

    The scene is z-up, as 3D Tiles are. Its node rotates it to glTF's y-up and moves it to its
    offset. The SPZ keeps the scene's axes.
    """
    packed = encode_spz(scene.replace(offset=None), version=spz_version)
    x, y, z = scene.offset or (0.0, 0.0, 0.0)
    # columns
    node = {"matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]}
    return pack_glb(content_with_spz(scene, len(packed), node), packed)
