"""3D Tiles of glTF with Gaussians: ``tileset.json``, a tree of tiles in levels of detail.

A tile that refines by REPLACE is drawn until its children are; one that refines by ADD stays.
Reading gives the finest level. z is up; tiles on the globe are in Earth-centred coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.earth import local_frame
from pointsplat_ns.geometry.transforms import Direction
from pointsplat_ns.scene.formats.coding import damage_named, file_beside
from pointsplat_ns.scene.formats.gltf import placed_parts
from pointsplat_ns.scene.formats.gltf_container import Container, listed, mapping, unquoted
from pointsplat_ns.scene.formats.gltf_nodes import EXTRAS, Placed, matrix_of, together
from pointsplat_ns.scene.gaussians import Gaussians, up_in_json
from pointsplat_ns.system.files import logger, read_text, require_file
from pointsplat_ns.system.tensors import DOUBLES

TILESET = "tileset.json"
"""Name of the index file."""

Z_UP = torch.tensor([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], **DOUBLES)
"""What 3D Tiles do to glTF: y up becomes z up."""


def read_tileset(path: Path | str) -> Gaussians:
    """Read the finest level of 3D Tiles, joined, in the frame of the root tile's parent.

    Tiles on the globe are read with x east, y north and z up around their middle, which is logged.

    Args:
        path: ``tileset.json`` or its folder.

    Raises:
        SceneError: if a file is missing, is damaged, lies outside of the folder, or is not glTF
            with Gaussians.
    """
    path = Path(path)
    path = path / TILESET if path.is_dir() else path
    require_file(path, f"the {TILESET} of 3D Tiles")
    with damage_named(path, "3D Tiles"):
        tileset = _tileset(path)
        contents = list(_finest(path, tileset, torch.eye(4, **DOUBLES), {path}))
        if not contents:
            raise SceneError(f"{path}: no tile has content")
        parts = [part for file, matrix in contents for part in _parts(file, matrix)]
        middle = _middle(parts)
        frame = local_frame(middle)
        if frame is None:
            return together(parts, path).replace(up=_declared_up(tileset))
        logger.warning("%s: placed on the globe; read with x east, y north, z up", path)
        back = torch.linalg.inv(frame)
        return together([replace(part, matrix=back @ part.matrix) for part in parts], path).replace(
            up="z"
        )


def tileset_parts(path: Path) -> list[Path]:
    """All files of the tiles with this ``tileset.json``, which comes first. Raises SceneError as
    :func:`read_tileset`."""
    with damage_named(path, "3D Tiles"):
        found = [path]
        for index in found:  # grows by nested tilesets
            if index.suffix.lower() == ".json":
                found += [file for file in _files_of(index) if file not in found]
    return found


def _tileset(path: Path) -> dict[str, Any]:
    tileset = json.loads(read_text(path))
    if not isinstance(tileset, dict) or not isinstance(tileset.get("root"), dict):
        raise SceneError(f"{path}: not a {TILESET}; it has no root tile")
    return tileset


def _declared_up(tileset: dict[str, Any]) -> str | Direction | None:
    """The up direction: z, or that of the scene which tiles were written from here."""
    asset = mapping(tileset, "asset")
    if asset.get("generator") != "pointsplat-ns":
        return "z"
    return up_in_json(mapping(mapping(asset, "extras"), EXTRAS).get("up"))


def _finest(
    path: Path, tileset: dict[str, Any], above: Tensor, seen: set[Path]
) -> Iterator[tuple[Path, Tensor]]:
    """The files of the finest level, and their matrices to the frame of the first tileset.
    ``seen`` are the tilesets on the way, each of which may occur once."""
    axis = mapping(tileset, "asset").get("gltfUpAxis", "Y")
    if axis not in ("Y", "Z"):
        raise SceneError(f"{path}: glTF with {axis!r} up is not read")
    waiting = [(tileset["root"], above, "REPLACE")]
    while waiting:
        tile, matrix, refine = waiting.pop()
        children = listed(tile, "children")
        if "implicitTiling" in tile:
            raise SceneError(f"{path}: implicit tiling is not read; expected a tree of tiles")
        if "transform" in tile:
            matrix = matrix @ matrix_of(tile["transform"])
        refine = str(tile.get("refine", refine)).upper()
        waiting += [(child, matrix, refine) for child in reversed(children)]
        if children and refine != "ADD":
            continue
        for uri in _uris(tile):
            file = file_beside(path, unquoted(uri))
            if file.suffix.lower() == ".json":
                if file in seen:
                    raise ValueError(f"{file.name} is named twice")
                seen.add(file)
                yield from _finest(file, _tileset(file), matrix, seen)
            else:
                yield file, matrix @ Z_UP if axis == "Y" else matrix


def _files_of(path: Path) -> list[Path]:
    """The content of all tiles of one tileset."""
    found = []
    waiting = [_tileset(path)["root"]]
    while waiting:
        tile = waiting.pop()
        waiting += reversed(listed(tile, "children"))
        found += [file_beside(path, unquoted(uri)) for uri in _uris(tile)]
    return found


def _uris(tile: dict[str, Any]) -> list[Any]:
    contents = [*listed(tile, "contents"), mapping(tile, "content")]
    places = [{**mapping({"content": content}, "content")} for content in contents]
    uris = [place.get("uri", place.get("url")) for place in places]
    return [uri for uri in uris if uri is not None]


def _parts(file: Path, matrix: Tensor) -> list[Placed]:
    """The Gaussians of a tile's content."""
    if file.suffix.lower() not in (".glb", ".gltf"):
        raise SceneError(f"{file}: tiles of {file.suffix or 'nameless'} files are not read")
    require_file(file, "a tile of glTF with Gaussians")
    with damage_named(file, "glTF"):
        parts = placed_parts(Container.open(file))
    return [replace(part, matrix=matrix @ part.matrix) for part in parts]


def _middle(parts: list[Placed]) -> Tensor:
    """Middle (3,) float64 of the places of all parts."""
    places = [
        part.matrix[:3, :3] @ part.scene.means.double().median(dim=0).values + part.matrix[:3, 3]
        for part in parts
        if len(part.scene)
    ]
    return torch.stack(places).median(dim=0).values if places else torch.zeros(3, **DOUBLES)
