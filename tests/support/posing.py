"""Files of cameras as others write them, of views that tests have."""

import json
import struct
from pathlib import Path

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import invert_rigid, quaternions_of, viewmats_to_opengl
from pointsplat_ns.io.pictures import write_picture
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views


def name_of(index: int) -> str:
    return f"frame_{index}.png"


def inria(views: Views) -> list[dict]:
    """What 3DGS training writes as ``cameras.json``."""
    poses = invert_rigid(views.viewmats.double())
    return [
        {
            "id": index, "img_name": name_of(index), "width": views.width, "height": views.height,
            "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
            "fy": float(K[1, 1]), "fx": float(K[0, 0]),
        }
        for index, (pose, K) in enumerate(zip(poses, views.Ks, strict=True))
    ]  # fmt: skip


def nerfstudio(views: Views) -> dict:
    """What nerfstudio's processing of data writes as ``transforms.json``, intrinsics once for all."""
    poses, K = viewmats_to_opengl(views.viewmats.double()), views.Ks[0]
    frames = [
        {"file_path": f"images/{name_of(index)}", "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}
        for index, pose in enumerate(poses)
    ]
    return {
        "w": views.width, "h": views.height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]), "cy": float(K[1, 2]), "k1": 0.0, "camera_model": "OPENCV", "frames": frames,
    }  # fmt: skip


def colmap_rows(views: Views) -> list[tuple[int, list[float], list[float], int, str]]:
    """Image number, quaternion wxyz, translation, camera number and name of each image."""
    quats = quaternions_of(views.viewmats[:, :3, :3]).tolist()
    moves = views.viewmats[:, :3, 3].double().tolist()
    rows = zip(quats, moves, strict=True)
    return [(10 + index, quat, move, 3, name_of(index)) for index, (quat, move) in enumerate(rows)]


def write_colmap_text(views: Views, folder: Path, model: str = "PINHOLE", extra: tuple[float, ...] = ()) -> Path:
    """A model in text. Of every other image the line of points is empty."""
    folder.mkdir(parents=True, exist_ok=True)
    K = views.Ks[0].tolist()
    params = [K[0][0], K[1][1], K[0][2], K[1][2], *extra]
    lens = " ".join(map(str, [3, model, views.width, views.height, *params]))
    (folder / "cameras.txt").write_text(f"# Camera list with one line of data per camera:\n{lens}\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, quat, move, camera, name in colmap_rows(views):
        lines += [" ".join(map(str, [number, *quat, *move, camera, name])), "" if number % 2 else "1.5 2.5 -1 3 4 77"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def colmap_binary(views: Views, model: int = 1, extra: tuple[float, ...] = ()) -> tuple[bytes, bytes]:
    """``cameras.bin`` and ``images.bin``; each image has as many points as its index."""
    K = views.Ks[0].tolist()
    params = [K[0][0], K[1][1], K[0][2], K[1][2], *extra]
    lenses = struct.pack("<QIiQQ", 1, 3, model, views.width, views.height) + struct.pack(f"<{len(params)}d", *params)
    images = struct.pack("<Q", len(views))
    for index, (number, quat, move, camera, name) in enumerate(colmap_rows(views)):
        images += struct.pack("<I7dI", number, *quat, *move, camera) + name.encode() + b"\0"
        images += struct.pack("<Q", index) + struct.pack("<ddq", 1.0, 2.0, -1) * index
    return lenses, images


def write_colmap_binary(views: Views, folder: Path, model: int = 1, extra: tuple[float, ...] = ()) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in zip(("cameras.bin", "images.bin"), colmap_binary(views, model, extra), strict=True):
        (folder / name).write_bytes(data)
    return folder


def write_photos(scene: Gaussians, views: Views, folder: Path) -> Path:
    """Renders of a scene as photos, by the names of :func:`name_of`."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, view in enumerate(views):
        write_picture(render(scene, view), folder / name_of(index))
    return folder


def written(content: object, path: Path) -> Path:
    """JSON, or text as it is."""
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path
