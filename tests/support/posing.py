"""Files of cameras as others write them, of views that tests have."""

import json
from pathlib import Path

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as colmap

from pointsplat_ns.geometry.transforms import invert_rigid, viewmats_to_opengl
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import write_picture
from pointsplat_ns.scene.views import View, Views


def name_of(index: int) -> str:
    return f"frame_{index}.png"


def inria(views: Views) -> list[dict]:
    """What 3DGS training writes as ``cameras.json``."""
    poses = invert_rigid(views.viewmats.double())
    return [
        {
            "id": index,
            "img_name": name_of(index),
            "width": view.width,
            "height": view.height,
            "position": pose[:3, 3].tolist(),
            "rotation": pose[:3, :3].tolist(),
            "fy": float(view.K[1, 1]),
            "fx": float(view.K[0, 0]),
        }
        for index, (pose, view) in enumerate(zip(poses, views, strict=True))
    ]


def nerfstudio(views: Views) -> dict:
    """What nerfstudio's processing of data writes as ``transforms.json``, intrinsics once for
    all."""
    poses = viewmats_to_opengl(views.viewmats.double())
    K = views.Ks[0]
    frames = [
        {
            "file_path": f"images/{name_of(index)}",
            "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
        }
        for index, pose in enumerate(poses)
    ]
    return {
        "w": views.width,
        "h": views.height,
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "k1": 0.0,
        "camera_model": "OPENCV",
        "frames": frames,
    }


def nerfstudio_of_several_sizes(views: Views) -> dict:
    """The same with the intrinsics of each frame in the frame, as for several cameras."""
    content = nerfstudio(views)
    for frame, view in zip(content["frames"], views, strict=True):
        own = nerfstudio(views_of_one(view))
        frame |= {name: own[name] for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1")}
    return {"camera_model": "OPENCV", "frames": content["frames"]}


def views_of_one(view: View) -> Views:
    return Views(view.viewmat[None], view.K[None], view.width, view.height, view.background)


def write_colmap(folder: Path, suffix: str, lens: tuple, poses: dict, seeds=(), colors=()) -> Path:
    """A model as COLMAP writes it, ``.txt`` or ``.bin``; each image has as many points as its
    index.

    ``lens`` is model, width, height and parameters, ``poses`` are world-to-camera matrices (4, 4)
    by names of images.
    """
    folder.mkdir(parents=True, exist_ok=True)
    images = {}
    for index, (name, viewmat) in enumerate(poses.items()):
        pose = colmap.rotmat2qvec(viewmat[:3, :3]), viewmat[:3, 3]
        images[10 + index] = colmap.Image(
            10 + index, *pose, 3, name, np.full((index, 2), 1.5), np.full(index, -1)
        )
    seen = np.array([10, 11]), np.array([0, 1])  # images, and places among their points
    points = {
        i: colmap.Point3D(i, *each, 0.5, *seen)
        for i, each in enumerate(zip(seeds, colors, strict=True))
    }
    colmap.write_model({3: colmap.Camera(3, *lens)}, images, points, str(folder), suffix)
    return folder


def write_sparse(
    views: Views, folder: Path, suffix: str = ".txt", model: str = "PINHOLE", extra=()
) -> Path:
    """A model as COLMAP writes it, of cameras alone; ``extra`` are the parameters of their
    distortion."""
    K = views.Ks[0].tolist()
    lens = model, views.width, views.height, [K[0][0], K[1][1], K[0][2], K[1][2], *extra]
    viewmats = views.viewmats.double().numpy()
    return write_colmap(
        folder, suffix, lens, {name_of(index): viewmat for index, viewmat in enumerate(viewmats)}
    )


def write_sparse_of_several_sizes(views: Views, folder: Path) -> Path:
    """A model as COLMAP writes it, with one camera for each image."""
    folder.mkdir(parents=True)
    cameras = {}
    images = {}
    for index, view in enumerate(views):
        K = view.K.tolist()
        params = [K[0][0], K[1][1], K[0][2], K[1][2]]
        cameras[index] = colmap.Camera(index, "PINHOLE", view.width, view.height, params)
        viewmat = view.viewmat.double().numpy()
        pose = colmap.rotmat2qvec(viewmat[:3, :3]), viewmat[:3, 3]
        points = np.zeros((0, 2)), np.zeros(0)
        images[index] = colmap.Image(index, *pose, index, name_of(index), *points)
    colmap.write_model(cameras, images, {}, str(folder), ".bin")
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
