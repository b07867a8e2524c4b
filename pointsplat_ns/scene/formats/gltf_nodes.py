"""Places Gaussians by the transforms of glTF nodes and 3D Tiles, and joins them to a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import (
    Direction,
    direction_of,
    quaternions_of,
    rotation_matrices,
    smallest_turn,
)
from pointsplat_ns.scene.formats.coding import joined
from pointsplat_ns.scene.formats.gltf_container import Container, listed, numbers
from pointsplat_ns.scene.gaussians import Gaussians, Offset, up_in_json
from pointsplat_ns.scene.offsets import offset_for, offset_of_text, offset_text
from pointsplat_ns.scene.rotation import Similarity, turned
from pointsplat_ns.system.tensors import DOUBLES

EXTRAS = "pointsplat_ns"
"""Key of the traits of a scene in the extras of a node."""

_MOST_DEPTH = 256


@dataclass(frozen=True, eq=False)
class Placed:
    """Gaussians of a mesh, and where they are."""

    scene: Gaussians  # float32, in the mesh's frame, with its offset
    matrix: Tensor  # [4, 4] float64, from that frame to the result's
    traits: dict[str, Any] | None = None
    """What :func:`node_of` wrote on the node."""


@dataclass(frozen=True, eq=False)
class Node:
    """A node with a mesh, and where it is."""

    mesh: dict[str, Any]
    matrix: Tensor  # [4, 4] float64, to the frame of the file
    about: dict[str, Any] = field(default_factory=dict)


def y_up_from(up: str | Direction) -> Tensor:
    """The rotation (3, 3) float64 that turns a direction to y, exact for an axis."""
    turn = smallest_turn(direction_of(up), direction_of("y"))
    return turn.round() if isinstance(up, str) else turn


def node_of(scene: Gaussians) -> dict[str, Any]:
    """The node of a scene. It turns the declared up direction to y, as glTF has it. Its extras hold
    the traits that glTF has no place for, so that the file is read back in its own frame."""
    up, offset = scene.up, scene.offset
    node: dict[str, Any] = {}
    if up not in (None, "y"):
        matrix = torch.eye(4, **DOUBLES)
        matrix[:3, :3] = y_up_from(up or "y")
        node["matrix"] = [
            int(value) if value.is_integer() else value for value in matrix.T.flatten().tolist()
        ]
    traits = {"up": up, "antialiased": scene.antialiased, "sh_degree": scene.sh_degree}
    if offset is not None:
        traits["offset"] = offset_text(offset)
    return {**node, "extras": {EXTRAS: traits}}


def nodes_with_meshes(gltf: Container) -> Iterator[Node]:
    """All nodes of the file's scene that have a mesh, in order. Raises ValueError if a node has two
    parents, or is its own."""
    roots = _roots(gltf)
    waiting = [(index, torch.eye(4, **DOUBLES), 0) for index in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        index, above, depth = waiting.pop()
        node = gltf.item("nodes", index)
        if index in seen or depth > _MOST_DEPTH:
            raise ValueError(f"node {index} has two parents, or is nested too deeply")
        seen.add(index)
        matrix = above @ _local_matrix(node)
        if "mesh" in node:
            yield Node(gltf.item("meshes", node["mesh"]), matrix, node)
        waiting += [(child, matrix, depth + 1) for child in reversed(listed(node, "children"))]


def _roots(gltf: Container) -> list[Any]:
    """Indices of the top nodes of the file's scene; without scenes, of those without a parent."""
    if gltf.items("scenes"):
        return listed(gltf.item("scenes", gltf.content.get("scene", 0)), "nodes")
    nodes = [node for node in gltf.items("nodes") if isinstance(node, dict)]
    children = {str(child) for node in nodes for child in listed(node, "children")}
    return [index for index in range(len(nodes)) if str(index) not in children]


def _local_matrix(node: dict[str, Any]) -> Tensor:
    """The transform (4, 4) of a node to its parent: a matrix by columns, or translation, rotation
    (xyzw) and scale."""
    if "matrix" in node:
        return matrix_of(node["matrix"])
    matrix = torch.eye(4, **DOUBLES)
    if "rotation" in node:
        x, y, z, w = numbers(node["rotation"], 4)
        matrix[:3, :3] = rotation_matrices(torch.tensor([[w, x, y, z]], **DOUBLES))[0]
    matrix[:3, :3] *= torch.tensor(numbers(node.get("scale", [1, 1, 1]), 3), **DOUBLES)
    matrix[:3, 3] = torch.tensor(numbers(node.get("translation", [0, 0, 0]), 3), **DOUBLES)
    return matrix


def matrix_of(columns: Any) -> Tensor:
    """A matrix (4, 4) float64 from 16 numbers by columns; ValueError unless it is affine."""
    matrix = torch.tensor(numbers(columns, 16), **DOUBLES).reshape(4, 4).T
    if matrix[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(f"a matrix whose last row is {matrix[3].tolist()}, expected 0 0 0 1")
    return matrix


def together(parts: Sequence[Placed], path: Path) -> Gaussians:
    """One scene of all parts, float32, in the frame of their matrices. Far from its origin, it gets
    an offset, as positions that are doubles do. Raises SceneError if a transform shears."""
    moved = [_moved(part, path) for part in parts]
    antialiased = any(scene.antialiased for scene in moved)
    own = moved[0].offset if len(moved) == 1 and parts[0].scene.offset is not None else None
    offset = own or _common_offset(moved)
    near = [scene.at_offset(offset).replace(offset=None) for scene in moved]
    return joined(near).replace(antialiased=antialiased, offset=offset)


def _common_offset(scenes: Sequence[Gaussians]) -> Offset | None:
    if not any(scene.offset for scene in scenes):
        return None
    means = [
        scene.means.double() + torch.tensor(scene.offset or (0.0, 0.0, 0.0), **DOUBLES)
        for scene in scenes
    ]
    scales = torch.cat([scene.scales for scene in scenes])
    return offset_for(torch.cat(means).numpy(), scales.numpy())


def _moved(part: Placed, path: Path) -> Gaussians:
    """A part after its transform, whose translation becomes the offset."""
    linear = part.matrix[:3, :3]
    scene = part.scene.replace(offset=None, up=None)
    if not torch.equal(linear, torch.eye(3, **DOUBLES)):
        scene = _transformed(scene, linear, path)
    origin = torch.tensor(part.scene.offset or (0.0, 0.0, 0.0), **DOUBLES)
    x, y, z = (part.matrix[:3, 3] + linear @ origin).tolist()
    return scene.replace(offset=(x, y, z) if x or y or z else None)


def _transformed(scene: Gaussians, linear: Tensor, path: Path) -> Gaussians:
    lengths = linear.norm(dim=0)
    if not bool((lengths > 1e-30).all()) or not bool(lengths.isfinite().all()):
        raise SceneError(f"{path}: a node is scaled to nothing; expected a scale above 0")
    axes = linear / lengths
    if float((axes.T @ axes - torch.eye(3, **DOUBLES)).abs().max()) > 1e-4:
        raise SceneError(
            f"{path}: the transform of a node shears, which is not defined for Gaussians; apply "
            "the transform in the program that made the file"
        )
    rotation = _nearest_rotation(axes)
    size = float(lengths.log().mean().exp())
    if float((lengths / size - 1).abs().max()) < 1e-5:
        return Similarity(rotation, size, torch.zeros(3, **DOUBLES)).apply(scene)
    return _stretched(scene, rotation, lengths)


def _nearest_rotation(matrix: Tensor) -> Tensor:
    """The orthogonal matrix nearest to one of almost orthogonal axes; exact for world axes."""
    if torch.equal(matrix, matrix.round()):
        return matrix
    left, _, right = torch.linalg.svd(matrix)
    return left @ right


def _stretched(scene: Gaussians, rotation: Tensor, lengths: Tensor) -> Gaussians:
    """A scene scaled by other factors along each axis, then rotated. A Gaussian with axes ``A`` has
    the axes and sizes of the singular value decomposition of ``diag(lengths) A`` afterwards."""
    axes = rotation_matrices(scene.quats.double()) * scene.scales.double().exp()[:, None]
    finite = axes.isfinite().all(dim=2, keepdim=True).all(dim=1, keepdim=True)
    left, sizes, _ = torch.linalg.svd(lengths[:, None] * torch.where(finite, axes, 0.0))
    left = left * torch.linalg.det(left).sign()[:, None, None]
    scaled = scene.replace(
        means=(scene.means.double() * lengths).float(),
        scales=torch.where(finite[:, 0], sizes.log(), torch.nan).float(),
        quats=quaternions_of(left).float(),
    )
    return turned(scaled, rotation)


def own_frame(traits: dict[str, Any]) -> tuple[Tensor, str | Direction | None, Offset | None]:
    """The rotation (3, 3) from y up back to the frame of a scene, its up direction, and its offset,
    from what :func:`node_of` wrote. Raises ValueError if they are damaged."""
    up = up_in_json(traits.get("up"))
    if up is None and traits.get("up") is not None:
        raise ValueError(f"up is {traits['up']!r}, expected an axis or three numbers")
    offset = None
    if "offset" in traits:
        offset = offset_of_text(str(traits["offset"]))
        if offset is None:
            raise ValueError(f"an offset of {traits['offset']!r}, expected three numbers")
    return torch.eye(3, **DOUBLES) if up is None else y_up_from(up).T, up, offset
