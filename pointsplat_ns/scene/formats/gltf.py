"""glTF with Gaussians: ``.glb`` and ``.gltf`` with Khronos' extension ``KHR_gaussian_splatting``.

The attributes of a primitive of points are numbers as drawn: standard deviations, opacities from 0
to 1, quaternions xyzw, SH coefficients. In place of attributes, a primitive may have an SPZ file
(``KHR_gaussian_splatting_compression_spz_2``). y is up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats import coding, spz
from pointsplat_ns.scene.formats.capacity import Capacity
from pointsplat_ns.scene.formats.coding import Array
from pointsplat_ns.scene.formats.gltf_container import (
    Container,
    buffer_views,
    listed,
    mapping,
    pack_glb,
    pack_gltf,
    packed_size,
)
from pointsplat_ns.scene.formats.gltf_nodes import (
    EXTRAS,
    Node,
    Placed,
    node_of,
    nodes_with_meshes,
    own_frame,
    together,
)
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, PLAIN, Gaussians, Traits
from pointsplat_ns.system.files import logger, require_file, require_memory
from pointsplat_ns.system.progress import Progress, silent

SPLATS = "KHR_gaussian_splatting"
SPZ = f"{SPLATS}_compression_spz_2"
"""Names of the extensions."""

SPZ_INSIDE = 3
"""Version of SPZ in glTF. The extension is for the second release of the format's library, which
has versions 2 and 3; CesiumJS 1.145 fails at version 4."""

_SPZ_NAMES = (SPZ, f"{SPLATS}_compression_spz", "KHR_spz_gaussian_splats_compression")
"""Names of the extension of SPZ, the newest first; the last one stands beside the other
extension."""

_DESCRIPTION = 8192
"""Bytes of the description of a file with float attributes, padded, so that the size of the file
follows from its count."""

_SRGB = "srgb_rec709_display"
_LINEAR = "lin_rec709_display"
_XYZW = [1, 2, 3, 0]
_WXYZ = [3, 0, 1, 2]

_DAMAGE = (SceneError, OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError)
"""Errors of reading a damaged description."""

CAPACITY = Capacity(offset=True)
CAPACITY_SPZ = replace(spz.CAPACITY, offset=True)


def read_gltf(path: Path | str) -> Gaussians:
    """Read the Gaussians of a ``.glb`` or ``.gltf``, as :func:`~pointsplat_ns.scene.read_scene`
    does.

    The transforms of nodes are applied, and all Gaussians of the file's scene joined. y is up. A
    file written here is read in the frame of the scene that it was written from. Other geometry is
    ignored, which is logged.

    Raises:
        SceneError: if the file is damaged, names files outside of its folder, has no Gaussians, or
            has them in a way that is not read.
    """
    path = require_file(path, "a glTF file")
    with coding.damage_named(path, "glTF"):
        gltf = Container.open(path)
        parts = placed_parts(gltf)
        traits = [part.traits for part in parts]
        if traits[0] is None or any(other != traits[0] for other in traits):
            return together(parts, path).replace(up="y")
        turn, up, offset = own_frame(traits[0])
        matrix = torch.eye(4, dtype=torch.float64, device="cpu")
        matrix[:3, :3] = turn
        own = [
            replace(part, matrix=matrix @ part.matrix, scene=part.scene.replace(offset=offset))
            for part in parts
        ]
        return together(own, path).replace(up=up)


def gltf_parts(path: Path) -> list[Path]:
    """A ``.gltf`` and the files of its buffers. Raises SceneError as :func:`read_gltf`."""
    with coding.damage_named(path, "glTF"):
        return [path, *Container.open(path).buffer_files()]


def has_gaussians(path: Path) -> bool:
    """Whether a glTF file has Gaussians; True for a damaged one, whose reader says why."""
    try:
        meshes = Container.open(path).items("meshes")
        return any(
            _splats_of(each) is not None for mesh in meshes for each in listed(mesh, "primitives")
        )
    except _DAMAGE:
        return True


def has_spz(path: Path) -> bool:
    """Whether the Gaussians of a glTF file are an SPZ file inside; False for a damaged one."""
    try:
        used = Container.open(path).content.get("extensionsUsed") or ()
        return not {*_SPZ_NAMES}.isdisjoint(used)
    except _DAMAGE:
        return False


def placed_parts(gltf: Container) -> list[Placed]:
    """The Gaussians of every node, at least one part. Raises SceneError if there are none, or if
    they do not fit into memory; ValueError and KeyError for damage."""
    found: list[tuple[Node, dict[str, Any]]] = []
    others = 0
    empty: list[Placed] = []
    for node in nodes_with_meshes(gltf):
        primitives = listed(node.mesh, "primitives")
        splats = [each for each in primitives if _splats_of(each) is not None]
        others += len(primitives) - len(splats)
        if splats and "EXT_mesh_gpu_instancing" in mapping(node.about, "extensions"):
            raise SceneError(f"{gltf.path}: EXT_mesh_gpu_instancing of Gaussians is not read")
        found += [(node, primitive) for primitive in splats]
    if not found:
        empty = [part for part in map(_empty, gltf.items("nodes")) if part is not None]
        if not empty:
            what = f"{others} other primitives" if others else "no geometry"
            raise SceneError(
                f"{gltf.path}: {what} and no Gaussians; expected {SPLATS} in its scene"
            )
        return empty
    if others:
        logger.warning("%s: %d primitives without Gaussians are ignored", gltf.path, others)
    require_memory(gltf.path, sum(_bytes_of(gltf, primitive) for _, primitive in found))
    scenes: dict[int, Gaussians] = {}
    for _, primitive in found:
        if id(primitive) not in scenes:
            scenes[id(primitive)] = _gaussians(gltf, primitive)
    return [_placed(scenes[id(primitive)], node) for node, primitive in found]


def encode_glb(scene: Gaussians, progress: Progress = silent) -> bytes:
    """Encode a scene, float32 on the CPU, as a ``.glb`` with float attributes. ``progress`` is not
    called."""
    return pack_glb(*_plain(scene), _DESCRIPTION)


def encode_gltf(scene: Gaussians, progress: Progress = silent) -> bytes:
    """Encode a scene, float32 on the CPU, as a ``.gltf`` that holds its data itself. ``progress``
    is not called."""
    return pack_gltf(*_plain(scene), _DESCRIPTION)


def encode_spz_glb(scene: Gaussians, progress: Progress = silent) -> bytes:
    """Encode a scene, float32 on the CPU, as a ``.glb`` with an SPZ file inside. Raises SceneError
    if the scene is too large for SPZ."""
    if not len(scene):
        return encode_glb(scene)
    packed = spz.encode_spz(scene.replace(offset=None), progress, version=SPZ_INSIDE)
    return pack_glb(content_with_spz(scene, len(packed), node_of(scene)), packed)


def glb_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of a file of :func:`encode_glb`, bytes."""
    return packed_size(_DESCRIPTION, _row_bytes(sh_degree) * count)


def gltf_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of a file of :func:`encode_gltf`, bytes."""
    return packed_size(_DESCRIPTION, _row_bytes(sh_degree) * count, text=True)


def content_with_spz(scene: Gaussians, size: int, node: dict[str, Any]) -> dict[str, Any]:
    """The description of a ``.glb`` whose Gaussians are an SPZ file of ``size`` bytes, with the
    attributes that CesiumJS expects."""
    names = ["POSITION", "COLOR_0", *(f"{SPLATS}:{name}" for name in ("SCALE", "ROTATION"))]
    names += _sh_names(scene.sh_degree)
    shapes = {"COLOR_0": "VEC4", f"{SPLATS}:ROTATION": "VEC4"}
    accessors: list[dict[str, Any]] = [
        {"componentType": 5126, "count": len(scene), "type": shapes.get(name, "VEC3")}
        for name in names
    ]
    accessors[0].update(_bounds(scene))
    accessors[1].update(componentType=5121, normalized=True)
    extension = {**_KERNEL, "extensions": {SPZ: {"bufferView": 0}}}
    return {
        **_content([SPLATS, SPZ], node),
        "extensionsRequired": [SPLATS, SPZ],
        "meshes": [{"primitives": [_primitive(names, extension)]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": size}],
        "buffers": [{"byteLength": size}],
    }


_KERNEL = {
    "kernel": "ellipse",
    "colorSpace": _SRGB,
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}


def _plain(scene: Gaussians) -> tuple[dict[str, Any], bytes]:
    """The description and the binary data of a scene with float attributes."""
    node = node_of(scene)
    if not len(scene):  # accessors have at least one element
        return _content([SPLATS], node, mesh=False), b""
    sh = scene.features_rest.numpy().astype("<f4").transpose(1, 0, 2)
    values = {
        "POSITION": scene.means.numpy().astype("<f4"),
        "COLOR_0": _fallback_colours(scene),
        f"{SPLATS}:ROTATION": coding.unit_quats(scene)[:, _XYZW].astype("<f4"),
        # readers drop infinite sizes
        f"{SPLATS}:SCALE": scene.stds.clamp_max(torch.finfo(torch.float32).max)
        .numpy()
        .astype("<f4"),
        f"{SPLATS}:OPACITY": scene.alphas.numpy().astype("<f4"),
        f"{SPLATS}:SH_DEGREE_0_COEF_0": scene.features_dc.numpy().astype("<f4"),
        **dict(zip(_sh_names(scene.sh_degree), sh, strict=True)),
    }
    accessors: list[dict[str, Any]] = []
    for index, array in enumerate(values.values()):
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessors.append(
            {"bufferView": index, "componentType": 5126, "count": len(scene), "type": kind}
        )
    accessors[0].update(_bounds(scene))
    accessors[1].update(componentType=5121, normalized=True)
    parts = [array.tobytes() for array in values.values()]
    content = {
        **_content([SPLATS], node),
        "meshes": [{"primitives": [_primitive([*values], _KERNEL)]}],
        "accessors": accessors,
        "bufferViews": buffer_views(parts),
        "buffers": [{"byteLength": sum(map(len, parts))}],
    }
    return content, b"".join(parts)


def _content(extensions: list[str], node: dict[str, Any], mesh: bool = True) -> dict[str, Any]:
    return {
        "asset": {"version": "2.0", "generator": "pointsplat-ns"},
        "extensionsUsed": extensions,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{**({"mesh": 0} if mesh else {}), **node}],
    }


def _primitive(names: list[str], extension: dict[str, Any]) -> dict[str, Any]:
    return {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": 0,
        "extensions": {SPLATS: extension},
    }


def _bounds(scene: Gaussians) -> dict[str, Any]:
    low, high = scene.means.aminmax(dim=0)
    return {"min": low.tolist(), "max": high.tolist()}


def _sh_names(degree: int) -> list[str]:
    """Attributes of SH above degree 0, in the order of coefficients."""
    return [
        f"{SPLATS}:SH_DEGREE_{d}_COEF_{index}"
        for d in range(1, degree + 1)
        for index in range(2 * d + 1)
    ]


def _row_bytes(degree: int) -> int:
    return 12 + 4 + 16 + 12 + 4 + 12 * (degree + 1) ** 2


def _fallback_colours(scene: Gaussians) -> Array:
    """Colours and opacities (N, 4) as bytes, for programs that draw points. Colours are linear, as
    glTF has them (IEC 61966-2-1)."""
    shown = np.clip(coding.shares_of_dc(scene), 0.0, 1.0)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    alphas = scene.alphas.double().numpy()[:, None]
    return coding.to_bytes(255 * np.concatenate([linear, alphas], axis=1))


def _splats_of(primitive: Any) -> dict[str, Any] | None:
    """The extension of a primitive of Gaussians; None for other geometry."""
    extensions = mapping(primitive, "extensions")
    if _SPZ_NAMES[-1] in extensions:
        return {"extensions": {_SPZ_NAMES[-1]: extensions[_SPZ_NAMES[-1]]}}
    return mapping(extensions, SPLATS) if SPLATS in extensions else None


def _traits(node: dict[str, Any]) -> dict[str, Any] | None:
    extras = node.get("extras")
    traits = extras.get(EXTRAS) if isinstance(extras, dict) else None
    return traits if isinstance(traits, dict) else None


def _placed(scene: Gaussians, node: Node) -> Placed:
    traits = _traits(node.about)
    flagged = traits is not None and traits.get("antialiased") is True
    return Placed(scene.replace(antialiased=scene.antialiased or flagged), node.matrix, traits)


def _empty(node: Any) -> Placed | None:
    """The part of a node that was written for a scene without Gaussians."""
    traits = _traits(node)
    if traits is None or traits.get("sh_degree") not in range(MAX_SH_DEGREE + 1):
        return None
    scene = Gaussians.empty(traits["sh_degree"])
    identity = torch.eye(4, dtype=torch.float64, device="cpu")
    return Placed(scene.replace(antialiased=traits.get("antialiased") is True), identity, traits)


def _bytes_of(gltf: Container, primitive: dict[str, Any]) -> int:
    """Bytes of a primitive's Gaussians, while they are placed; of an SPZ file, its reader checks
    them."""
    if mapping(_splats_of(primitive), "extensions"):
        return 0
    attributes = mapping(primitive, "attributes")
    count = gltf.stored_count(attributes["POSITION"])
    return 3 * 4 * count * (14 + 3 * _rest_of(attributes))


def _rest_of(attributes: dict[str, Any]) -> int:
    """Number of SH coefficients above degree 0. ValueError if a band is not complete."""
    names = _sh_names(MAX_SH_DEGREE)
    known = [name in attributes for name in names]
    count = known.index(False) if False in known else len(names)
    if count not in (0, 3, 8, 15) or any(known[count:]):
        raise ValueError(f"SH without {names[count]}")
    return count


def _gaussians(gltf: Container, primitive: dict[str, Any]) -> Gaussians:
    """The Gaussians of a primitive, in the frame of its mesh."""
    extension = _splats_of(primitive) or {}
    kernel = extension.get("kernel", "ellipse")
    if kernel != "ellipse":
        raise SceneError(f"{gltf.path}: Gaussians with kernel {kernel!r} are not read")
    projection = extension.get("projection", "perspective")
    if projection != "perspective":
        logger.warning("%s: projection %r is drawn as perspective", gltf.path, projection)
    inner = mapping(extension, "extensions")
    packed = next((name for name in _SPZ_NAMES if name in inner), None)
    attributes = mapping(primitive, "attributes")
    if packed is not None:
        scene = _of_spz(gltf, mapping(inner, packed), attributes)
    elif inner:
        raise SceneError(f"{gltf.path}: Gaussians with {', '.join(inner)} are not read")
    else:
        scene = _of_attributes(gltf, attributes)
    space = extension.get("colorSpace", _SRGB)
    if space == _LINEAR:
        logger.warning("%s: linear colours are converted to sRGB, approximately", gltf.path)
        return _as_srgb(scene)
    if space != _SRGB:
        logger.warning("%s: colour space %r is read as sRGB", gltf.path, space)
    return scene


def _of_spz(gltf: Container, packed: dict[str, Any], attributes: dict[str, Any]) -> Gaussians:
    inside = Path(f"{gltf.path}: SPZ inside")  # for messages
    data = bytes(gltf.view(packed["bufferView"]))
    with coding.damage_named(inside, "SPZ"):
        scene = spz.decode_spz(data, inside, axes=False)  # nodes turn it
    declared = gltf.count(attributes["POSITION"]) if "POSITION" in attributes else len(scene)
    if declared != len(scene):
        raise ValueError(f"an SPZ file of {len(scene)} Gaussians, declared as {declared}")
    return scene


def _of_attributes(gltf: Container, attributes: dict[str, Any]) -> Gaussians:
    count = gltf.count(attributes["POSITION"])

    def values(name: str, kind: str) -> Array:
        found = gltf.count(attributes[name])
        if found != count:
            raise ValueError(f"{name} of {found} Gaussians, expected {count}")
        return gltf.accessor(attributes[name], kind)

    rest = _sh_names(MAX_SH_DEGREE)[: _rest_of(attributes)]
    sh = [values(name, "VEC3") for name in rest]
    dc, alphas = _colours(gltf, attributes, values)
    return coding.scene_of(
        values("POSITION", "VEC3"),
        np.log(values(f"{SPLATS}:SCALE", "VEC3")),
        values(f"{SPLATS}:ROTATION", "VEC4")[:, _WXYZ],
        coding.logits_of_shares(alphas.astype(np.float64)),
        dc,
        np.stack(sh, axis=1) if sh else np.empty((count, 0, 3)),
    )


def _colours(
    gltf: Container, attributes: dict[str, Any], values: Callable[[str, str], Array]
) -> tuple[Array, Array]:
    """Constant SH coefficients (N, 3) and opacities (N,). Early drafts have both in COLOR_0."""
    names = f"{SPLATS}:SH_DEGREE_0_COEF_0", f"{SPLATS}:OPACITY"
    known = [name in attributes for name in names]
    if all(known) or "COLOR_0" not in attributes:
        return values(names[0], "VEC3"), values(names[1], "SCALAR")[:, 0]
    kind = gltf.item("accessors", attributes["COLOR_0"]).get("type")
    colours = values("COLOR_0", "VEC3" if kind == "VEC3" else "VEC4")
    dc = values(names[0], "VEC3") if known[0] else (colours[:, :3] - 0.5) / SH_C0
    if known[1]:
        return dc, values(names[1], "SCALAR")[:, 0]
    return dc, colours[:, 3] if colours.shape[1] == 4 else np.ones(len(colours), np.float32)


def _as_srgb(scene: Gaussians) -> Gaussians:
    """A scene with linear colours, in sRGB: exact for constant colours, to first order for the
    others."""
    linear = (0.5 + SH_C0 * scene.features_dc.double()).clamp_min(0.0)
    bright = linear > 0.0031308
    power = linear.clamp_min(0.0031308)
    shown = torch.where(bright, 1.055 * power ** (1 / 2.4) - 0.055, 12.92 * linear)
    slope = torch.where(bright, 1.055 / 2.4 * power ** (1 / 2.4 - 1), 12.92)
    return scene.replace(
        features_dc=((shown - 0.5) / SH_C0).float(),
        features_rest=(scene.features_rest * slope[:, None]).float(),
    )
