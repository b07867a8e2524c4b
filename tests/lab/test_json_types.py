"""A value of another type at any key of any JSON file that is read: a result, or one typed error
in one line."""

import base64
import copy
import io
import json
import logging
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from lab.robustness.fuzz_readers import READERS, Read, at, some_scene
from lab.robustness.fuzzing import judge
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig, _split
from pointsplat_ns.scene.formats.gltf import encode_gltf
from pointsplat_ns.scene.formats.rad import encode_rad
from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.formats.sog_stream import (
    STREAM_META,
    Node,
    coarser_levels,
    read_sog_stream,
    stream_parts,
    write_sog_stream,
)
from pointsplat_ns.scene.reading import read_scene

OTHERS = (
    None,
    True,
    0,
    -1,
    10**30,
    float("nan"),
    float("inf"),
    "x",
    [],
    [1],
    {},
    {"x": 1},
    {"0": [1]},
)

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FRAMES = [{"file_path": f"images/{index}.png", "transform_matrix": POSE} for index in range(3)]
SIZES = {"fl_x": 8, "fl_y": 8, "cx": 4, "cy": 3, "w": 8, "h": 6, "k1": 0.1}
NERFSTUDIO = {
    **SIZES,
    "camera_model": "OPENCV",
    "applied_transform": POSE[:3],
    "applied_scale": 1.0,
    "frames": [{**FRAMES[0], **SIZES, "mask_path": "m.png"}, *FRAMES[1:]],
}
INRIA = [
    {
        "id": 0,
        "img_name": "a",
        "width": 8,
        "height": 6,
        "position": [0, 0, 1],
        "rotation": [row[:3] for row in POSE[:3]],
        "fx": 8.0,
        "fy": 8.0,
    }
]


def meta_of_sog() -> dict:
    with zipfile.ZipFile(io.BytesIO(encode_sog(some_scene()))) as archive:
        return json.loads(archive.read("meta.json"))


def meta_of_first_sog() -> dict:
    """Version 1 has no number, and bounds in place of codebooks."""
    meta = meta_of_sog()
    del meta["version"], meta["count"]
    meta["means"]["shape"] = [6, 3]
    for name, channels in (("scales", 3), ("sh0", 4)):
        meta[name] = {
            "mins": [-1.0] * channels,
            "maxs": [1.0] * channels,
            "files": meta[name]["files"],
        }
    meta["shN"] = {"mins": -1.0, "maxs": 1.0, "files": meta["shN"]["files"]}
    return meta


def stream(folder: Path) -> dict:
    rows = torch.arange(6)
    parts = (Node((rows[:3], rows[:1])), Node((rows[3:], rows[1:2])))
    write_sog_stream(
        [some_scene(), some_scene()[:2]], Node(children=parts), folder / STREAM_META, 100
    )
    return json.loads((folder / STREAM_META).read_text())


def of_stream(path: Path) -> object:
    found: list[Any] = []
    for read in (
        lambda: read_sog_stream(path, 0),
        lambda: read_sog_stream(path, 1),
        lambda: stream_parts(path),
        lambda: coarser_levels(path, 6),
    ):
        try:
            found.append(read())
        except PointSplatError as error:
            last = error
    if not found:
        raise last
    return found


def scannetpp(path: Path) -> object:
    config = SeededScanNetppDataParserConfig(data=path.parents[2])
    located = config.__class__(
        data=path.parents[2],
        transforms_path=Path("dslr/nerfstudio/transforms.json"),
        images_dir=Path("dslr/images"),
    )
    return _split(located)


def photos_of_scannetpp(folder: Path) -> None:
    for place in ("dslr/nerfstudio", "dslr/images/images"):
        (folder / place).mkdir(parents=True)
    for index in range(3):
        (folder / f"dslr/images/images/{index}.png").touch()


Made = Callable[[Path], tuple[Read, Any]]

TILES = {
    "asset": {"version": "1.1", "gltfUpAxis": "Y", "extras": {"pointsplat_ns": {"up": "z"}}},
    "root": {
        "refine": "REPLACE",
        "transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1],
        "content": {"uri": "missing.glb"},
        "children": [
            {"content": {"uri": "0.glb"}, "refine": "ADD", "children": [{}]},
            {"contents": [{"url": "0.glb"}]},
        ],
    },
}


def gltf(folder: Path) -> tuple[Read, Any]:
    """A glTF whose buffer is a file beside it."""
    content = json.loads(encode_gltf(some_scene().replace(up="z", offset=(1.0, 2.0, 3.0))))
    buffer = content["buffers"][0]
    data = base64.b64decode(buffer["uri"].partition(",")[2])
    (folder / "a.bin").write_bytes(data + bytes(4))
    buffer.update(uri="a.bin", byteLength=len(data) + 4)
    content["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": 4})
    accessor = content["accessors"][3]
    accessor["sparse"] = {
        "count": 1,
        "indices": {
            "bufferView": len(content["bufferViews"]) - 1,
            "componentType": 5121,
            "byteOffset": 3,
        },
        "values": {"bufferView": accessor["bufferView"], "byteOffset": 0},
    }
    content["bufferViews"][1]["byteStride"] = 4
    del content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    (name,) = content["extensionsUsed"]
    content["meshes"].append({"primitives": [{"attributes": {}, "extensions": {}}]})
    content["nodes"].append({"mesh": 1, "translation": [1, 2, 3], "rotation": [0, 0, 0, 1]})
    content["nodes"].append({"children": [0, 1], "scale": [2, 2, 2]})
    content["scenes"] = [{"nodes": [2]}]
    assert (
        "extras" in content["nodes"][0]
        and name in content["meshes"][0]["primitives"][0]["extensions"]
    )
    return READERS["gltf"](folder), content


def rad(magic: str) -> Made:
    """A RAD file of one page, whose description at the start of the file or page is changed."""
    data = encode_rad(some_scene(), torch.zeros(6), torch.zeros(6))
    at_page = data.index(b"RADC")
    start = data.index(magic.encode())
    (length,) = struct.unpack_from("<I", data, start + 4)
    end = start + 8 + -(-length // 8) * 8

    def described(text: bytes, tag: bytes) -> bytes:
        return tag + struct.pack("<I", len(text)) + text + bytes(-len(text) % 8)

    def inside(text: bytes) -> bytes:
        if magic == "RAD0":
            return described(text, b"RAD0") + data[end:]
        page = described(text, b"RADC") + data[end:]
        head = json.loads(data[8:at_page].rstrip(b"\0"))
        head["chunks"] = [{"offset": 0, "bytes": len(page)}]
        return described(json.dumps(head).encode(), b"RAD0") + page

    right = json.loads(data[start + 8 : start + 8 + length])
    return lambda folder: (at("a.rad", read_scene, inside=inside)(folder), right)


FILES: dict[str, Made] = {
    "sog-meta": lambda folder: (READERS["sog-meta"](folder), meta_of_sog()),
    "sog-meta of version 1": lambda folder: (READERS["sog-meta"](folder), meta_of_first_sog()),
    "sog-stream": lambda folder: (at(STREAM_META, of_stream)(folder), stream(folder)),
    "gltf": gltf,
    "tileset": lambda folder: (READERS["tileset"](folder), TILES),
    "rad": rad("RAD0"),
    "page of a rad": rad("RADC"),
    "transforms.json": lambda folder: (READERS["camera-json"](folder), NERFSTUDIO),
    "cameras.json": lambda folder: (READERS["camera-json"](folder), INRIA),
    "frame of a run": lambda folder: (
        READERS["frame-of-run"](folder),
        {"transform": POSE[:3], "scale": 0.5},
    ),
    "dataset": lambda folder: (
        READERS["dataset"](folder),
        {**NERFSTUDIO, "frames": [{**FRAMES[0], **SIZES}, *FRAMES[1:]]},
    ),
    "intrinsics": lambda folder: (
        READERS["intrinsics"](folder),
        {"camera": {"w": 8, "h": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3, "scale": 1000}},
    ),
    "scannetpp": lambda folder: (
        at("dslr/nerfstudio/transforms.json", scannetpp, photos_of_scannetpp)(folder),
        {**NERFSTUDIO, "test_frames": [{**FRAMES[2], "file_path": "images/2.png"}]},
    ),
}
"""Each kind of file: how it is read, and what a right one holds."""


def changed(content: Any) -> Iterator[Any]:
    """The content with another value in the place of each of its values; of a list's, in that of
    the first two."""
    yield from OTHERS

    def within(part: Any) -> Iterator[tuple[Any, Any]]:
        """A container in a copy, and a key of it."""
        keys = list(part) if isinstance(part, dict) else list(range(len(part)))[:2]
        for key in keys:
            yield part, key
            if isinstance(part[key], (dict, list)):
                yield from within(part[key])

    whole = copy.deepcopy(content)
    for part, key in within(whole):
        before = part[key]
        for other in OTHERS:
            part[key] = other
            yield whole
        part[key] = before
        if isinstance(part, dict):
            del part[key]
            yield whole
            part[key] = before


@pytest.mark.parametrize("kind", FILES)
def test_another_type_at_any_key_is_read_or_refused_in_one_line(kind, tmp_path, caplog):
    caplog.set_level(logging.CRITICAL, "pointsplat_ns")
    read, right = FILES[kind](tmp_path)
    text = json.dumps(right).encode()
    read(text)  # imports what the memory of a reader is not to count
    assert judge(read, text) == "read", "the right one"
    outcomes = [judge(read, json.dumps(each).encode()) for each in changed(right)]
    assert outcomes.count("refused") > 50
