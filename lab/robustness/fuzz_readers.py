"""Every reader of files that a stranger may have written, as a function of bytes.

A reader gets a folder of its own, in which it lays out what belongs to the file, and gives a function that puts bytes
into the file's place and reads it as users do. Where a file is compressed or has check sums, the bytes are what is
inside: changed at random outside, it would be refused at once.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path
from unittest import mock

import fuzz_texts  # noqa: F401  (enters its readers)
import torch
from fuzz_registry import READERS, Read, reader

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.scene import read_scene, save

__all__ = ["READERS", "Read", "some_scene"]


def some_scene(n: int = 6, sh_degree: int = 1) -> Gaussians:
    """A scene for what is laid out around a file."""
    generator = torch.Generator().manual_seed(0)
    shapes = [(n, 3), (n, 3), (n, 4), (n, 1), (n, 3), (n, (sh_degree + 1) ** 2 - 1, 3)]
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def _scene_at(path: Path, file: Path | None = None) -> Read:
    """Reads a scene at ``path`` once bytes are in ``file``."""

    def read(data: bytes) -> Gaussians:
        (file or path).write_bytes(data)
        scene = read_scene(path)
        if not bool(scene.usable().all()):
            raise AssertionError("a Gaussian that cannot be drawn was kept")
        return scene

    return read


@reader
def ply(folder: Path) -> Read:
    """Binary of both byte orders and ASCII."""
    return _scene_at(folder / "a.ply")


@reader
def compressed_ply(folder: Path) -> Read:
    """PlayCanvas' compressed PLY."""
    return _scene_at(folder / "a.compressed.ply")


@reader
def splat(folder: Path) -> Read:
    """antimatter15's rows."""
    return _scene_at(folder / "a.splat")


@reader
def spz(folder: Path) -> Read:
    """What SPZ files of versions 2 and 3 hold inside gzip."""
    read = _scene_at(folder / "a.spz")
    return lambda data: read(gzip.compress(data, 1, mtime=0))


@reader
def spz_file(folder: Path) -> Read:
    """SPZ files as they are, of version 4 too."""
    return _scene_at(folder / "a.spz")


@reader
def sog(folder: Path) -> Read:
    """SOG files as they are: zip archives."""
    return _scene_at(folder / "a.sog")


@reader
def sog_meta(folder: Path) -> Read:
    """The description in a SOG folder, whose images are as they should be."""
    save(some_scene(), folder / "meta.json")
    return _scene_at(folder, folder / "meta.json")


@reader
def sog_image(folder: Path) -> Read:
    """An image in a SOG folder, whose description is as it should be."""
    save(some_scene(), folder / "meta.json")
    return _scene_at(folder, folder / "quats.webp")


@reader
def ksplat(folder: Path) -> Read:
    """The first 64 bytes of each of two headers, which zeros fill up, and the rows."""
    read = _scene_at(folder / "a.ksplat")
    return lambda data: read(data[:64].ljust(4096, b"\0") + data[64:128].ljust(1024, b"\0") + data[128:])


def _checkpoint_bytes(scene: Gaussians) -> bytes:
    content = {
        "step": 1,
        "pipeline": {f"_model.gauss_params.{name}": value for name, value in scene.items()},
        "optimizers": {},
        "schedulers": {},
        "scalers": {},
    }
    stream = io.BytesIO()
    torch.save(content, stream)
    return stream.getvalue()


@reader
def checkpoint(folder: Path) -> Read:
    """Checkpoints as they are: zip archives, or the pickles of earlier versions of torch."""
    return _scene_at(folder / "a.ckpt")


@reader
def checkpoint_pickle(folder: Path) -> Read:
    """The pickle in a checkpoint, whose numbers are as they should be."""
    with zipfile.ZipFile(io.BytesIO(_checkpoint_bytes(some_scene()))) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    read = _scene_at(folder / "a.ckpt")

    def with_pickle(data: bytes) -> object:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name, part in parts.items():
                archive.writestr(name, data if name.endswith("/data.pkl") else part)
        return read(stream.getvalue())

    return with_pickle


def _safetensors(header: bytes, numbers: int) -> bytes:
    return struct.pack("<Q", len(header)) + header + bytes(numbers)


@reader
def weights(folder: Path) -> Read:
    """The header of a feedback refiner's safetensors file; as many zeros follow as it says."""
    from pointsplat_ns.refiner.feedback import read_feedback_refiner

    path = folder / "a.safetensors"

    def read(data: bytes) -> object:
        try:
            ends = [entry["data_offsets"][1] for name, entry in json.loads(data).items() if name != "__metadata__"]
            numbers = min(max(ends, default=0), 1 << 16)
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
            numbers = 0
        path.write_bytes(_safetensors(data, max(numbers, 0) if isinstance(numbers, int) else 0))
        return read_feedback_refiner(path)

    return read


@reader
def refiner_metadata(folder: Path) -> Read:
    """The metadata of a refiner's safetensors file, whose tensors are as they should be."""
    from pointsplat_ns.compression.trained_refiner import load_refiner
    from pointsplat_ns.refiner import Refiner, RefinerConfig

    sizes = {"grid": None, "enc_channels": (2,), "enc_depths": (1,), "enc_heads": (1,), "strides": (), "patch": 4}
    none = {"dec_channels": (), "dec_depths": (), "dec_heads": ()}
    config = RefinerConfig(sh_degree=1, **sizes, **none, head_width=2, head_depth=2, feature_dim=2, color_hidden=2)
    tensors, at = {}, 0
    for name, value in Refiner(config).state_dict().items():
        kind = {torch.float32: "F32", torch.int64: "I64"}[value.dtype]
        end = at + value.numel() * value.element_size()
        tensors[name] = {"dtype": kind, "shape": list(value.shape), "data_offsets": [at, end]}
        at = end
    rest = json.dumps(tensors).encode()[1:]
    path = folder / "a.safetensors"

    def read(data: bytes) -> object:
        path.write_bytes(_safetensors(b'{"__metadata__":' + data + b"," + rest, at))
        return load_refiner(path, "cpu")

    return read


@reader
def pruned_scene(folder: Path) -> Read:
    """Pruned scenes that trainings keep."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pruned_store import read_pruned

    path = folder / "a.safetensors"

    def read(data: bytes) -> object:
        path.write_bytes(data)
        return read_pruned(path)

    return read


def _run_at(folder: Path) -> tuple[Path, Path]:
    """The ``config.yml`` and the checkpoints' folder of a run to be."""
    place = folder / "run" / "nerfstudio_models"
    place.mkdir(parents=True)
    (place / "step-000000001.ckpt").write_bytes(_checkpoint_bytes(some_scene()))
    return folder / "run" / "config.yml", place


@reader
def config(folder: Path) -> Read:
    """``config.yml`` of a run: what the run is, its data, its name, its network if it is a refiner's."""
    from pointsplat_ns.compression.trained_refiner import load_refiner
    from pointsplat_ns.io.runs import name_of, open_run

    path, _ = _run_at(folder)

    def read(data: bytes) -> object:
        path.write_bytes(data)
        run = open_run(path.parent, need_data=False)
        for use in (name_of, open_run, lambda place: load_refiner(place, "cpu")):
            try:
                use(path.parent)
            except PointSplatError as error:
                _one_line(error)
        return run, run.is_gaussian_scene, run.rasterize_mode

    return read


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


@reader
def frame_of_run(folder: Path) -> Read:
    """``dataparser_transforms.json`` of a run."""
    from pointsplat_ns.io.runs import TRANSFORMS_NAME, read_transforms

    path = folder / TRANSFORMS_NAME

    def read(data: bytes) -> object:
        path.write_bytes(data)
        return read_transforms(path)

    return read


@reader
def dataset(folder: Path) -> Read:
    """``transforms.json`` of the photos that a run was trained on, which nerfstudio reads."""
    from PIL import Image

    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
    from pointsplat_ns.nerfstudio_plugin.third_party_warnings import import_nerfstudio

    import_nerfstudio()
    from nerfstudio.utils.rich_utils import CONSOLE

    path, _ = _run_at(folder)
    path.write_bytes(CONFIG)
    place = path.parent / "data"
    (place / "images").mkdir(parents=True)
    for index in range(3):
        Image.new("RGB", (8, 6)).save(place / "images" / f"{index}.png")

    def read(data: bytes) -> object:
        (place / "transforms.json").write_bytes(data)
        with mock.patch.object(CONSOLE, "quiet", True):
            return dataset_views(path.parent)

    return read


def _one_line(error: PointSplatError) -> None:
    if "\n" in str(error) or not str(error).strip():
        raise AssertionError(f"an error that is not one line: {error!r}")
