"""Every reader of files that a stranger may have written, as a function of bytes.

A reader gets a folder of its own, in which it lays out what belongs to the file, and gives a
function that puts bytes into the file's place and reads it as users do. Where a file is compressed
or has check sums, the bytes are what is inside: changed at random outside, it would be refused at
once.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from unittest import mock

import torch
from PIL import Image

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.scene.formats.glb_tile import encode_tile
from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene

Read = Callable[[bytes], object]
"""Reads the bytes of one file, or raises."""

Make = Callable[[Path], Read]
"""Makes the function of a reader in an empty folder."""

READERS: dict[str, Make] = {}
"""By name."""


def some_scene(n: int = 6, sh_degree: int = 1) -> Gaussians:
    """A scene for what is laid out around a file."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, (sh_degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def at(
    file: str,
    read: str | Callable[[Path], object],
    lay_out: Callable[[Path], object] = lambda folder: None,
    inside: Callable[[bytes], bytes] = lambda data: data,
) -> Make:
    """A reader of one file.

    Args:
        file: its name in the folder.
        read: function of its path, or where that is: ``module:name``, imported when the reader is
            made.
        lay_out: puts what belongs to the file into the folder.
        inside: makes the file of the bytes that are inside it.
    """

    def make(folder: Path) -> Read:
        lay_out(folder)
        function = resolve_name(read) if isinstance(read, str) else read

        def reader(data: bytes) -> object:
            (folder / file).write_bytes(inside(data))
            return function(folder / file)

        return reader

    return make


def _scene(path: Path) -> Gaussians:
    scene = read_scene(path)
    if not bool(scene.usable().all()):
        raise AssertionError("a Gaussian that cannot be drawn was kept")
    return scene


def _in_folder(path: Path) -> Gaussians:
    return _scene(path.parent)


def _sog_folder(folder: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(encode_sog(some_scene()))) as archive:
        archive.extractall(folder)


def _tile(folder: Path) -> None:
    """The content of a tile."""
    (folder / "0.glb").write_bytes(encode_tile(some_scene()))


def _gzipped(data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


READERS |= {
    "ply": at("a.ply", _scene),
    "compressed-ply": at("a.compressed.ply", _scene),
    "splat": at("a.splat", _scene),
    "spz": at("a.spz", _scene, inside=_gzipped),  # versions 2 and 3
    "spz-file": at("a.spz", _scene),  # as they are, of version 4 too
    "sog": at("a.sog", _scene),  # as they are: zip archives
    "sog-meta": at("meta.json", _in_folder, _sog_folder),
    "sog-image": at("quats.webp", _in_folder, _sog_folder),
    "gltf": at("a.gltf", _scene),  # .glb too, which content tells
    "tileset": at("tileset.json", _in_folder, _tile),
    "rad": at("a.rad", _scene),
    "zip": at("a.zip", _scene),  # as they are
    "checkpoint": at(
        "a.ckpt", _scene
    ),  # as they are: zip archives, or the pickles of earlier versions of torch
}


def _saved(content: object) -> bytes:
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


def _checkpoint_bytes(scene: Gaussians) -> bytes:
    content: dict[str, object] = {"step": 1, "optimizers": {}, "schedulers": {}, "scalers": {}}
    content["pipeline"] = {f"_model.gauss_params.{name}": value for name, value in scene.items()}
    return _saved(content)


def gsplat_bytes(scene: Gaussians) -> bytes:
    """A checkpoint of gsplat's trainer."""
    values = dict(scene.items()) | {
        "opacities": scene.opacities[:, 0],
        "sh0": scene.features_dc[:, None],
    }
    values["shN"] = values.pop("features_rest")
    del values["features_dc"]
    return _saved({"step": 1, "splats": values})


def zip_of(parts: Mapping[str, bytes | str]) -> bytes:
    """A zip archive of files by their names."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    return stream.getvalue()


def _pickle_in(checkpoint: bytes) -> Make:
    """The reader of the pickle in a checkpoint, whose numbers are as they should be."""
    with zipfile.ZipFile(io.BytesIO(checkpoint)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    [pickle] = (name for name in parts if name.endswith("/data.pkl"))
    return at("a.ckpt", _scene, inside=lambda data: zip_of(parts | {pickle: data}))


READERS |= {
    "checkpoint-pickle": _pickle_in(_checkpoint_bytes(some_scene())),
    "gsplat-pickle": _pickle_in(gsplat_bytes(some_scene())),
}


def _safetensors(header: bytes, numbers: int) -> bytes:
    return struct.pack("<Q", len(header)) + header + bytes(numbers)


def _with_zeros(header: bytes) -> bytes:
    """A safetensors file of a header; as many zeros follow as it says."""
    try:
        ends = [
            entry["data_offsets"][1]
            for name, entry in json.loads(header).items()
            if name != "__metadata__"
        ]
        numbers = min(max(ends, default=0), 1 << 16)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
        numbers = 0
    return _safetensors(header, max(numbers, 0) if isinstance(numbers, int) else 0)


def _refiner_metadata(folder: Path) -> Read:
    """The metadata of a refiner's safetensors file, whose tensors are as they should be."""
    from pointsplat_ns.pipeline.trained_refiner import load_refiner
    from pointsplat_ns.refinement import Refiner, RefinerConfig

    sizes = {
        "grid": None,
        "enc_channels": (2,),
        "enc_depths": (1,),
        "enc_heads": (1,),
        "strides": (),
        "patch": 4,
    }
    none = {"dec_channels": (), "dec_depths": (), "dec_heads": ()}
    config = RefinerConfig(
        sh_degree=1, **sizes, **none, head_width=2, head_depth=2, feature_dim=2, color_hidden=2
    )
    tensors = {}
    end = 0
    for name, value in Refiner(config).state_dict().items():
        begin = end
        end = end + value.numel() * value.element_size()
        kind = {torch.float32: "F32", torch.int64: "I64"}[value.dtype]
        tensors[name] = {"dtype": kind, "shape": list(value.shape), "data_offsets": [begin, end]}
    rest = json.dumps(tensors).encode()[1:]
    return at(
        "a.safetensors",
        lambda path: load_refiner(path, "cpu"),
        inside=lambda data: _safetensors(b'{"__metadata__":' + data + b"," + rest, end),
    )(folder)


CONFIG = b"""!!python/object:nerfstudio.engine.trainer.TrainerConfig
data: !!python/object/apply:pathlib.PosixPath [data]
method_name: splatfacto
experiment_name: room
timestamp: 2026-01-01_120000
relative_model_dir: !!python/object/apply:pathlib.PosixPath [nerfstudio_models]
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager: !!python/object:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanagerConfig
    data: !!python/object/apply:pathlib.PosixPath [data]
    dataparser: !!python/object:nerfstudio.data.dataparsers.nerfstudio_dataparser.NerfstudioDataParserConfig
      data: !!python/object/apply:pathlib.PosixPath [data]
      eval_mode: all
      orientation_method: none
      center_method: none
      auto_scale_poses: false
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    sh_degree: 1
"""


def _run(folder: Path) -> None:
    """A run with three photos."""
    for place in ("nerfstudio_models", "data/images"):
        (folder / place).mkdir(parents=True)
    (folder / "config.yml").write_bytes(CONFIG)
    (folder / "nerfstudio_models" / "step-000000001.ckpt").write_bytes(
        _checkpoint_bytes(some_scene())
    )
    for index in range(3):
        Image.new("RGB", (8, 6)).save(folder / "data" / "images" / f"{index}.png")


def _use_run(path: Path) -> object:
    """What a run's ``config.yml`` says: what the run is, its data, its name, its network if it is a
    refiner's."""
    from pointsplat_ns.pipeline.trained_refiner import load_refiner
    from pointsplat_ns.scene.runs import name_of, open_run

    run = open_run(path.parent, need_data=False)
    for use in (name_of, open_run, lambda place: load_refiner(place, "cpu")):
        try:
            use(path.parent)
        except PointSplatError as error:
            if "\n" in str(error) or not str(error).strip():
                raise AssertionError(f"an error that is not one line: {error!r}") from error
    return run, run.is_gaussian_scene, run.rasterize_mode


def _use_dataset(path: Path) -> object:
    """``transforms.json`` of the photos that a run was trained on, which nerfstudio reads."""
    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
    from pointsplat_ns.nerfstudio_plugin.registration import import_nerfstudio

    import_nerfstudio()
    from nerfstudio.utils.rich_utils import CONSOLE

    with mock.patch.object(CONSOLE, "quiet", True):
        return dataset_views(path.parents[1])


def _transforms(folder: Path) -> None:
    rows = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    (folder / "dataparser_transforms.json").write_text(
        json.dumps({"transform": rows, "scale": 0.5})
    )


def _colmap(suffix: str) -> Callable[[Path], None]:
    """A COLMAP model of one image, binary or text."""
    files = {
        "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 8, 6, 8.0, 8.0, 4.0, 3.0),
        "images.bin": struct.pack("<QI7dI2sQ", 1, 1, 1.0, *6 * (0.0,), 1, b"a\0", 0),
        "cameras.txt": b"1 PINHOLE 8 6 8 8 4 3\n",
        "images.txt": b"1 1 0 0 0 0 0 0 1 a\n\n",
    }

    def lay_out(folder: Path) -> None:
        for name in files:
            if name.endswith(suffix):
                (folder / name).write_bytes(files[name])

    return lay_out


def _poses_in_folder(path: Path) -> object:
    from pointsplat_ns.scene.camera_files import read_named_views

    return read_named_views(path.parent)


def _replica(folder: Path) -> None:
    """A scene of one photo in the Replica layout."""
    (folder / "results").mkdir()
    Image.new("RGB", (8, 6)).save(folder / "results" / "frame000000.png")
    camera = {"w": 8, "h": 6, "fx": 8, "fy": 8, "cx": 4, "cy": 3, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (folder / "traj.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")


def _use_replica(path: Path) -> object:
    from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica

    scene = load_replica(path.parent)
    return scene, scene.params.principal_point


READERS |= {
    "refiner-metadata": _refiner_metadata,
    "weights": at(
        "a.safetensors",
        "pointsplat_ns.refinement.feedback:read_feedback_refiner",
        inside=_with_zeros,
    ),
    "config": at("config.yml", _use_run, _run),
    "frame-of-run": at("dataparser_transforms.json", "pointsplat_ns.scene.runs:read_transforms"),
    "dataset": at("data/transforms.json", _use_dataset, _run),
    "camera-json": at("a.json", "pointsplat_ns.scene.camera_files:read_named_views", _transforms),
    "colmap-cameras": at("cameras.bin", _poses_in_folder, _colmap("bin")),
    "colmap-images": at("images.bin", _poses_in_folder, _colmap("bin")),
    "colmap-cameras-text": at("cameras.txt", _poses_in_folder, _colmap("txt")),
    "colmap-images-text": at("images.txt", _poses_in_folder, _colmap("txt")),
    "trajectory": at("traj.txt", _use_replica, _replica),
    "intrinsics": at("cam_params.json", _use_replica, _replica),
}
