"""``ns-render``: the four ways to choose cameras, by both methods."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.scripts import render
from nerfstudio.utils import install_checks
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from captures import Capture
from ns_commands import Run, started
from pointsplat_ns.errors import DataError

WIDTH, HEIGHT, FIELD_OF_VIEW = 40, 30, 60.0


@pytest.fixture(autouse=True)
def pictures_without_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    """ns-render wants ffmpeg even for pictures, which need none."""
    monkeypatch.setattr(install_checks, "check_ffmpeg_installed", lambda: None)


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")) / 255


def drawn(run: Run, way: str, folder: Path, *options: object) -> list[np.ndarray]:
    """The pictures that ``ns-render`` makes."""
    words = ["--load-config", run.config, "--output-path", folder / "out", "--image-format", "png", *options]
    started(render, way, *words, "--output-format", "images")
    pictures = [pixels(path) for path in sorted((folder / "out").iterdir())]
    assert all(picture.std() > 0.03 for picture in pictures), "a plain picture proves nothing"
    return pictures


@torch.no_grad()
def drawn_by_the_model(pipeline: Pipeline, camera: Cameras) -> np.ndarray:
    return pipeline.model.get_outputs_for_camera(camera)["rgb"].numpy()


def camera_path(file: Path, pose: np.ndarray, kind: str = "perspective") -> Path:
    """A path that stands still, as the viewer saves it."""
    cameras = [{"camera_to_world": pose.reshape(-1).tolist(), "fov": FIELD_OF_VIEW, "aspect": WIDTH / HEIGHT}] * 2
    size = {"render_width": WIDTH, "render_height": HEIGHT, "seconds": 1, "fps": 2, "camera_type": kind}
    file.write_text(json.dumps({**size, "camera_path": cameras}))
    return file


def test_camera_path_draws_what_the_model_draws_from_there(run: Run, capture: Capture, tmp_path):
    pose = capture.poses[0]
    path = camera_path(tmp_path / "path.json", pose)
    pictures = drawn(run, "camera-path", tmp_path, "--camera-path-filename", path)
    focal = HEIGHT / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Cameras(torch.from_numpy(pose[None, :3]).float(), focal, focal, WIDTH / 2, HEIGHT / 2)
    expected = drawn_by_the_model(eval_setup(run.config, test_mode="inference")[1], camera)
    assert len(pictures) == 2 and pictures[0].shape == (HEIGHT, WIDTH, 3)
    # 1/255: rounding to 8 bits, down
    assert all(np.abs(picture - expected).max() <= 1 / 255 + 1e-6 for picture in pictures)


@pytest.mark.parametrize("kind", ["fisheye", "equirectangular"])
def test_camera_path_of_another_lens_is_refused_and_not_drawn_as_a_pinholes(kind, run: Run, capture: Capture, tmp_path):
    path = camera_path(tmp_path / "path.json", capture.poses[0], kind)
    with pytest.raises(DataError, match=f"cameras of kind {kind}: expected perspective"):
        drawn(run, "camera-path", tmp_path, "--camera-path-filename", path)


def test_interpolate_goes_from_camera_to_camera(run: Run, tmp_path):
    options = ("--pose-source", "train", "--interpolation-steps", "2", "--downscale-factor", "2")
    pictures = drawn(run, "interpolate", tmp_path, *options)
    assert len(pictures) == 2 * 7  # between 8 photos
    assert np.abs(pictures[0] - pictures[-1]).mean() > 0.02


def test_spiral_turns_about_the_first_held_out_camera(run: Run, tmp_path):
    pictures = drawn(run, "spiral", tmp_path, "--seconds", "0.5", "--frame-rate", "8", "--radius", "0.3")
    assert len(pictures) == 4
    assert np.abs(pictures[0] - pictures[1]).mean() > 0.005


def test_dataset_puts_beside_each_render_the_photo_as_its_camera_would_have_taken_it(run: Run, tmp_path):
    words = ["--load-config", run.config, "--output-path", tmp_path, "--image-format", "png"]
    started(render, "dataset", *words, "--split", "train+test", "--rendered-output-names", "rgb", "gt-rgb", "depth")
    _, pipeline, _, _ = eval_setup(run.config, test_mode="test")
    manager = pipeline.datamanager
    for split, dataset, count in (("train", manager.train_dataset, 8), ("test", manager.eval_dataset, 2)):
        names = [sorted((tmp_path / split / kind).iterdir()) for kind in ("rgb", "gt-rgb", "depth")]
        assert len(names[0]) == len(names[1]) == len(names[2]) == count
        for index, (render_path, photo_path) in enumerate(zip(*names[:2], strict=True)):
            photo, picture = pixels(photo_path), pixels(render_path)
            assert photo.shape == picture.shape != (48, 64, 3), "the lens was not undone"
            assert np.abs(photo - dataset[index]["image"].numpy()).max() <= 1 / 255 + 1e-6
            shown = drawn_by_the_model(pipeline, dataset.cameras[index : index + 1])
            assert np.abs(picture - shown).max() <= 1 / 255 + 1e-6
