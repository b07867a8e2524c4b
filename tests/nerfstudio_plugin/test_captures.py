"""Captures in every layout that people have, read by nerfstudio's dataparsers and trained on by both methods."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import Trainer

from captures import BAD, FRAMES, SEEDS, Capture, Lens, colors_at, seen_from
from making import pipeline_of
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.nerfstudio_plugin.frames import Frame
from pointsplat_ns.nerfstudio_plugin.scannetpp import SeededScanNetppDataParserConfig

FISHEYE = Lens("OPENCV_FISHEYE", (0.02, -0.01, 0.003, -0.001), focal=(30.0, 30.5))


@dataclass
class Layout:
    """How a capture is laid out, and what reads it."""

    lens: Lens
    write: Callable[[Capture, Path], Path]
    dataparser: Callable[[], DataParserConfig]
    frames: int = FRAMES
    """Photos that are used."""
    wrong: float = 0.002
    """How far photos may be off on average, in [0, 1]: rounding to 8 bits is 0.001; undistorting interpolates."""


def as_colmap(capture: Capture, folder: Path) -> Path:
    names = capture.write_photos(folder / "images")
    capture.write_colmap(folder / "colmap/sparse/0", names)
    return folder


def nerfstudio_data() -> NerfstudioDataParserConfig:
    return NerfstudioDataParserConfig(load_3D_points=True)


LAYOUTS = {
    "nerfstudio-data": Layout(Lens(), Capture.write_nerfstudio, nerfstudio_data),
    "nerfstudio-data, equidistant fisheye": Layout(
        Lens("OPENCV_FISHEYE", focal=(30.0, 30.5)), Capture.write_nerfstudio, nerfstudio_data
    ),
    "colmap": Layout(Lens(distortion=(0.12, -0.05, 0.004, -0.003)), as_colmap, ColmapDataParserConfig),
    # With a k4, nerfstudio's parser refuses even a fisheye.
    "colmap, fisheye": Layout(
        dataclasses.replace(FISHEYE, distortion=(0.02, -0.01, 0.003, 0.0)), as_colmap, ColmapDataParserConfig
    ),
    "scannetpp-seeded": Layout(
        FISHEYE, Capture.write_scannetpp, SeededScanNetppDataParserConfig, frames=FRAMES - len(BAD)
    ),
}


@dataclass
class Trained:
    """A capture on which splatfacto-cpu was trained."""

    capture: Capture
    layout: Layout
    run: Path
    trainer: Trainer
    losses: list[float]

    @property
    def outputs(self) -> DataparserOutputs:
        return self.trainer.pipeline.datamanager.train_dataparser_outputs


@pytest.fixture(scope="module", params=LAYOUTS)
def trained(request, wall_config, run_training, tmp_path_factory) -> Trained:
    layout = LAYOUTS[request.param]
    capture, folder = Capture(layout.lens), tmp_path_factory.mktemp("capture")
    steps = 18 if request.param == "nerfstudio-data" else 1  # how it learns does not depend on the layout
    config = wall_config(layout.write(capture, folder / "data"), folder / "outputs", steps)
    config.pipeline.datamanager.dataparser = layout.dataparser()
    config.pipeline.model.num_random, config.pipeline.model.random_scale = 300, 2.0
    # Losses of the first steps and the last are of one kind.
    config.pipeline.model.num_downscales, config.pipeline.model.background_color = 0, "black"
    trainer, losses = run_training(config)
    return Trained(capture, layout, config.get_base_dir(), trainer, losses)


def wrongness(frame: Frame, outputs: DataparserOutputs) -> float:
    """Mean difference, in [0, 1], between a photo and what its camera sees in the room, where no mask is."""
    camera, data = frame
    rays = camera.generate_rays(0)
    turn, shift = outputs.dataparser_transform.double().split([3, 1], dim=1)
    eye = (rays.origins[0, 0].double() / outputs.dataparser_scale - shift[:, 0]) @ turn
    seen = colors_at(seen_from(eye.numpy(), (rays.directions.double() @ turn).numpy()))
    difference = np.abs(data["image"].numpy() / 255 - seen).mean(axis=-1)
    if "mask" not in data:
        return float(difference.mean())
    # nerfstudio keeps pixels that are mixed with hidden ones.
    sure = cv2.erode(data["mask"].numpy().astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert 0.5 < sure.mean() < 0.97, "a mask that hides nothing, or all, proves nothing"
    return float(difference[sure].mean())


def test_every_pixel_shows_what_its_camera_sees(trained):
    manager = trained.trainer.pipeline.datamanager
    frames = [*manager.train_frames, *manager.eval_frames]
    assert len(manager.eval_frames) > 0 and len(frames) == trained.layout.frames
    assert all(wrongness(frame, trained.outputs) < trained.layout.wrong for frame in frames)
    camera, data = frames[0]
    camera.cx = camera.cx + 0.5
    assert wrongness((camera, data), trained.outputs) > trained.layout.wrong, "half a pixel would not be noticed"


def test_a_scene_starts_from_the_points_of_the_capture_and_learns(trained):
    photos = len(trained.trainer.pipeline.datamanager.train_frames)  # each is used once before any is repeated
    learns = np.mean(trained.losses[-photos:]) < 0.98 * np.mean(trained.losses[:photos])
    assert learns or len(trained.losses) == 1
    outputs = trained.outputs
    transform = outputs.dataparser_transform.double()
    points = torch.from_numpy(trained.capture.seeds)
    placed = (points @ transform[:, :3].T + transform[:, 3]) * outputs.dataparser_scale
    # 1e-5: float32
    torch.testing.assert_close(outputs.metadata["points3D_xyz"].double(), placed, atol=1e-5, rtol=0)
    assert np.array_equal(outputs.metadata["points3D_rgb"].numpy(), trained.capture.seed_colors)
    assert trained.trainer.pipeline.model.num_points == SEEDS


def test_a_refiner_trains_on_the_same_photos(trained):
    pipeline = pipeline_of(trained.run).train()
    frames = pipeline.datamanager.next_train(0)[1]
    assert all(wrongness(frame, trained.outputs) < trained.layout.wrong for frame in frames)
    _, losses, metrics = pipeline.get_train_loss_dict(0)
    losses["l1"].backward()
    assert losses["l1"].isfinite() and metrics["faults"] == []
    assert any(p.grad is not None and p.grad.any() for p in pipeline.model.refiner.parameters())


def test_views_of_the_dataset_are_those_of_the_undistorted_photos(trained):
    views = dataset_views(trained.run)
    cameras = [camera for camera, _ in trained.trainer.pipeline.datamanager.train_frames]
    assert torch.equal(views.Ks, torch.cat([camera.get_intrinsics_matrices() for camera in cameras]))
    assert all((int(camera.width), int(camera.height)) == (views.width, views.height) for camera in cameras)
