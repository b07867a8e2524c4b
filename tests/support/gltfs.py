"""glTF files as other programs write them, built number by number."""

import base64
import json
import struct

import numpy as np

from pointsplat_ns.scene.gaussians import Gaussians

KHR = "KHR_gaussian_splatting"
KERNEL = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Builder:
    """A glTF of arrays: accessors are added, and their indices given back."""

    def __init__(self) -> None:
        self.data = b""
        self.content: dict = {
            "asset": {"version": "2.0"},
            "extensionsUsed": [KHR],
            "accessors": [],
            "bufferViews": [],
            "meshes": [],
            "nodes": [],
        }

    def view(self, data: bytes, **more: object) -> int:
        self.data += bytes(-len(self.data) % 4)
        at = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.content["bufferViews"].append({**at, **more})
        self.data += data
        return len(self.content["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **more: object) -> int:
        """An accessor of an array (N,) or (N, C), by its type."""
        about = {"componentType": CODES[array.dtype.str[1:]], "count": len(array)}
        about["type"] = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        if "bufferView" not in more and "sparse" not in more:
            about["bufferView"] = self.view(array.tobytes())
        self.content["accessors"].append({**about, **more})
        return len(self.content["accessors"]) - 1

    def splats(self, scene: Gaussians, **changes: int | None) -> dict:
        """A primitive of the Gaussians of a scene; attributes by their last words may be other
        accessors, or left out."""
        arrays = {
            "POSITION": scene.means,
            f"{KHR}:ROTATION": scene.quats[:, [1, 2, 3, 0]] / scene.quats.norm(dim=1, keepdim=True),
            f"{KHR}:SCALE": scene.scales.exp(),
            f"{KHR}:OPACITY": scene.opacities[:, 0].sigmoid(),
            f"{KHR}:SH_DEGREE_0_COEF_0": scene.features_dc,
        }
        first = 0
        for degree in range(1, scene.sh_degree + 1):
            for index in range(2 * degree + 1):
                arrays[f"{KHR}:SH_DEGREE_{degree}_COEF_{index}"] = scene.features_rest[:, first]
                first += 1
        attributes = {}
        for name, array in arrays.items():
            word = name.rpartition(":")[2]
            index = changes.pop(word, -1)
            if index is not None:
                attributes[name] = (
                    self.accessor(array.numpy().astype("<f4")) if index == -1 else index
                )
        attributes.update({name: index for name, index in changes.items() if index is not None})
        return {"attributes": attributes, "mode": 0, "extensions": {KHR: dict(KERNEL)}}

    def mesh(self, *primitives: dict) -> int:
        self.content["meshes"].append({"primitives": list(primitives)})
        return len(self.content["meshes"]) - 1

    def node(self, **about: object) -> int:
        self.content["nodes"].append(about)
        return len(self.content["nodes"]) - 1

    def glb(self) -> bytes:
        content = {**self.content, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps(content).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
        chunks = struct.pack("<I4s", len(text), b"JSON"), struct.pack("<I4s", len(data), b"BIN\0")
        return head + chunks[0] + text + chunks[1] + data

    def gltf(self, uri: str | None = None) -> bytes:
        """With a data URI, or with the name of a file beside it."""
        whole = "data:application/gltf-buffer;base64," + base64.b64encode(self.data).decode()
        buffers = [{"byteLength": len(self.data), "uri": whole if uri is None else uri}]
        return json.dumps({**self.content, "buffers": buffers}).encode()


def glb_of(scene: Gaussians, **node: object) -> Builder:
    """A glTF of a scene at a node."""
    built = Builder()
    built.node(mesh=built.mesh(built.splats(scene)), **node)
    return built


def taken_apart(data: bytes) -> tuple[dict, bytes]:
    """The description and the binary data of a ``.glb``."""
    magic, version, size, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON") and length % 4 == 0
    if size == 20 + length:
        return json.loads(data[20:]), b""
    binary, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0" and 28 + length + binary == size and binary % 4 == 0
    return json.loads(data[20 : 20 + length]), data[28 + length :]
