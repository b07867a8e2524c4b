"""Trains a scene from a capture whose layout is recognised: posed photos that a dataparser of nerfstudio reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.registration import import_nerfstudio

if TYPE_CHECKING:
    from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig


def train_capture(capture: Path, keep: int | None, output: Path, steps: int, scale: float) -> tuple[Path, int]:
    """Train a scene by the method ``splatfacto-cpu``. nerfstudio's log goes to standard output.

    Args:
        capture: folder of posed photos.
        keep: number of Gaussians; None for as many as Splatfacto makes.
        output: folder for runs.
        steps: number of steps.
        scale: factor on the width and height of the photos, at most 1.

    Returns:
        The run, and its number of Gaussians.

    Raises:
        DataError: if the layout of the capture is not known, or its photos cannot be used.
        PointSplatError: if a number is out of range.
    """
    if steps < 1 or not 0 < scale <= 1:
        raise PointSplatError(f"{steps} steps at a scale of {scale:g}; expected at least 1, and above 0 up to 1")
    dataparser = dataparser_for(capture)
    from nerfstudio.scripts.train import main

    from pointsplat_ns.io import open_run, read_scene
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    config = splatfacto_cpu_config()
    config.data, config.output_dir, config.experiment_name = capture, output, capture.resolve().name
    config.max_num_iterations = steps
    config.pipeline.datamanager.dataparser = dataparser  # type: ignore[attr-defined]
    config.pipeline.datamanager.camera_res_scale_factor = scale  # type: ignore[attr-defined]
    config.pipeline.model.max_gs_num = keep  # type: ignore[attr-defined]
    main(config)
    run = config.get_base_dir()
    return run, len(read_scene(open_run(run).checkpoint))


def dataparser_for(capture: Path) -> DataParserConfig:
    """The dataparser that reads a capture, by the files that it has: ScanNet++, Replica as NICE-SLAM or Semantic-NeRF
    lay it out, nerfstudio's ``transforms.json``, or a COLMAP model. Raises DataError if it has none of these."""
    if not capture.is_dir():
        raise DataError(f"{capture}: no such folder; expected a capture: a folder of posed photos")
    import_nerfstudio()
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.replica.layout import NICE_SLAM, SEMANTIC_NERF
    from pointsplat_ns.nerfstudio_plugin.scannetpp import SOURCES, SeededScanNetppDataParserConfig

    if (capture / "dslr").is_dir() or any((capture / source["transforms_path"]).is_file() for source in SOURCES):
        return SeededScanNetppDataParserConfig()
    if any((capture / names.trajectory).is_file() for names in (NICE_SLAM, SEMANTIC_NERF)):
        return ReplicaDataParserConfig()
    if (capture / "transforms.json").is_file():
        return NerfstudioDataParserConfig(load_3D_points=True)
    for model in ("colmap/sparse/0", "sparse/0", "sparse", "colmap/sparse", "colmap"):
        if (capture / model / "cameras.bin").is_file() or (capture / model / "cameras.txt").is_file():
            return ColmapDataParserConfig(colmap_path=Path(model))
    raise DataError(
        f"{capture}: no capture that is known; expected transforms.json, a COLMAP model (colmap/sparse/0), dslr "
        "(ScanNet++) or traj.txt (Replica) in it; ns-process-data makes transforms.json from photos or a video"
    )
