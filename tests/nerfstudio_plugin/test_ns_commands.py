"""nerfstudio's commands by both methods, each trained once by ``ns-train``, with the viewer open,
on a tiny capture taken through a lens."""

import json
import os
import signal
import sys
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.scripts import eval as evaluate
from nerfstudio.scripts import render, train
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.utils import install_checks, writer
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.viewer import Viewer
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from captures import Capture, Lens
from ns_viewer import Look, look
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainer

pytestmark = pytest.mark.usefixtures("quick")

STEPS = {"splatfacto-cpu": 20, "pointsplat": 4}
VIEWER = ("--viewer.websocket-host", "127.0.0.1", "--viewer.image-format", "png")
WIDTH = 40
HEIGHT = 30
FIELD_OF_VIEW = 60.0


def started(program: types.ModuleType, *words: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [program.__name__, *map(str, words)])
        patch.setattr(writer, "EVENT_WRITERS", [])  # those of trainings before in this process
        patch.setattr(
            install_checks, "check_ffmpeg_installed", lambda: None
        )  # ns-render wants it even for pictures
        program.entrypoint()


@dataclass
class Run:
    """A method, a run of it, and what was seen of it in the viewer while it was trained."""

    method: str
    folder: Path
    seen: Look

    @property
    def config(self) -> Path:
        return self.folder / "config.yml"


def with_the_viewer_open(
    method: str, capture: Capture, output: Path, words: list, data: list[str]
) -> Run:
    """Train, look at the viewer after the second step, and end it by Ctrl-C when the training is
    complete."""
    seen: list[Look] = []
    update = StoppableTrainer._update_viewer_state
    complete = Viewer.training_complete

    def looked_at(trainer: StoppableTrainer, step: int) -> None:
        update(trainer, step)
        if step == 2:
            seen.append(look(trainer.viewer_state, capture.poses[0]))

    def interrupted(viewer: Viewer) -> None:
        complete(viewer)
        viewer.viser_server.stop()
        os.kill(os.getpid(), signal.SIGINT)

    options = ["--vis", "viewer+tensorboard", *VIEWER, "--viewer.max-num-display-images", "3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StoppableTrainer, "_update_viewer_state", looked_at)
        patch.setattr(Viewer, "training_complete", interrupted)
        before = signal.signal(
            signal.SIGINT, signal.default_int_handler
        )  # in the background of a shell it is ignored
        try:
            started(train, method, *words, *options, "--max-num-iterations", STEPS[method], *data)
        finally:
            signal.signal(signal.SIGINT, before)
    (folder,) = (output / "room" / method).iterdir()
    return Run(method, folder, *seen)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return Capture(Lens(distortion=(0.12, -0.05, 0.004, -0.003)))


@pytest.fixture(scope="module")
def runs(capture, tmp_path_factory) -> dict[str, Run]:
    folder = tmp_path_factory.mktemp("commands")
    capture.write_nerfstudio(folder / "capture")
    usual = ["--output-dir", folder, "--experiment-name", "room", "--machine.device-type", "cpu"]
    usual += ["--logging.steps-per-log", "1", "--data"]
    data = ["nerfstudio-data", "--load-3D-points", "True", "--train-split-fraction", "0.8"]
    words = [*usual, folder / "capture", "--pipeline.model.num-downscales", "0"]
    scene = with_the_viewer_open("splatfacto-cpu", capture, folder, words, data)
    words = [*usual, scene.folder, "--pipeline.model.size", "tiny", "--pipeline.model.by", "paper"]
    words += ["--pipeline.model.lpips-weight", "0", "--pipeline.model.keep", "0.5"]
    return {
        run.method: run
        for run in (scene, with_the_viewer_open("pointsplat", capture, folder, words, []))
    }


@pytest.fixture(params=STEPS)
def run(request, runs) -> Run:
    return runs[request.param]


def test_training_serves_what_the_model_draws_and_logs_every_loss(run: Run):
    run.seen.check()
    (path,) = run.folder.glob("events.out.tfevents.*")
    losses = EventAccumulator(str(path)).Reload().Scalars("Train Loss")
    assert [event.step for event in losses] == list(range(STEPS[run.method]))
    assert all(np.isfinite(event.value) for event in losses)


def test_viewer_serves_its_page_and_what_the_model_draws_until_ctrl_c(run: Run, capture: Capture):
    viewers: list[Viewer] = []

    def opened(*args, **options) -> Viewer:
        viewers.append(Viewer(*args, **options))
        return viewers[-1]

    def between_looks(_: float) -> None:
        look(viewers[0], capture.poses[0]).check()
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_viewer, "ViewerState", opened)
        patch.setattr(run_viewer, "time", types.SimpleNamespace(sleep=between_looks))
        try:
            with pytest.raises(KeyboardInterrupt):
                started(run_viewer, "--load-config", run.config, *VIEWER)
        finally:
            for viewer in viewers:
                viewer.viser_server.stop()


def test_eval_writes_numbers_and_pictures_of_the_held_out_photo(run: Run, no_lpips, tmp_path):
    path = tmp_path / "eval.json"
    started(
        evaluate,
        "--load-config",
        run.config,
        "--output-path",
        path,
        "--render-output-path",
        tmp_path / "pictures",
    )
    report = json.loads(
        path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert report["method_name"] == run.method
    assert report["results"]["psnr"] > 8 and 0 < report["results"]["ssim"] <= 1
    assert report["results"]["lpips"] is None and "no network" in report["results"]["lpips_note"]
    assert any(file.is_file() for file in (tmp_path / "pictures").rglob("*"))


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")) / 255


def drawn(run: Run, way: str, folder: Path, *options: object) -> list[np.ndarray]:
    words = [
        "--load-config",
        run.config,
        "--output-path",
        folder / "out",
        "--image-format",
        "png",
        *options,
    ]
    started(render, way, *words, "--output-format", "images")
    pictures = [pixels(path) for path in sorted((folder / "out").iterdir())]
    assert all(picture.std() > 0.03 for picture in pictures), "a plain picture proves nothing"
    return pictures


@torch.no_grad()
def drawn_by_the_model(pipeline: Pipeline, camera: Cameras) -> np.ndarray:
    return pipeline.model.get_outputs_for_camera(camera)["rgb"].numpy()


def test_camera_path_draws_what_the_model_draws_and_no_other_lens(
    run: Run, capture: Capture, tmp_path
):
    pose = capture.poses[0]
    file = tmp_path / "path.json"
    cameras = [
        {
            "camera_to_world": pose.reshape(-1).tolist(),
            "fov": FIELD_OF_VIEW,
            "aspect": WIDTH / HEIGHT,
        }
    ] * 2
    saved = {
        "render_width": WIDTH,
        "render_height": HEIGHT,
        "seconds": 1,
        "fps": 2,
        "camera_path": cameras,
    }
    file.write_text(json.dumps({**saved, "camera_type": "fisheye"}))
    with pytest.raises(DataError, match="cameras of kind fisheye: expected perspective"):
        drawn(run, "camera-path", tmp_path, "--camera-path-filename", file)
    file.write_text(json.dumps({**saved, "camera_type": "perspective"}))
    pictures = drawn(run, "camera-path", tmp_path, "--camera-path-filename", file)
    focal = HEIGHT / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Cameras(torch.from_numpy(pose[None, :3]).float(), focal, focal, WIDTH / 2, HEIGHT / 2)
    expected = drawn_by_the_model(eval_setup(run.config, test_mode="inference")[1], camera)
    assert len(pictures) == 2 and pictures[0].shape == (HEIGHT, WIDTH, 3)
    # 1/255: rounding to 8 bits, down
    assert all(np.abs(picture - expected).max() <= 1 / 255 + 1e-6 for picture in pictures)


def test_interpolate_draws_between_the_photos(run: Run, tmp_path):
    options = "--pose-source train --interpolation-steps 2 --downscale-factor 2"
    pictures = drawn(run, "interpolate", tmp_path, *options.split())
    assert len(pictures) == 14, "two between each two of eight photos"
    assert np.abs(pictures[0] - pictures[6]).mean() > 0.02


def test_dataset_puts_the_undistorted_photo_beside_each_render(runs, tmp_path):
    run = runs["splatfacto-cpu"]
    words = ["--load-config", run.config, "--output-path", tmp_path, "--image-format", "png"]
    started(
        render,
        "dataset",
        *words,
        "--split",
        "train+test",
        "--rendered-output-names",
        "rgb",
        "gt-rgb",
        "depth",
    )
    _, pipeline, _, _ = eval_setup(run.config, test_mode="test")
    manager = pipeline.datamanager
    for split, dataset, count in (
        ("train", manager.train_dataset, 8),
        ("test", manager.eval_dataset, 2),
    ):
        names = [sorted((tmp_path / split / kind).iterdir()) for kind in ("rgb", "gt-rgb", "depth")]
        assert len(names[0]) == len(names[1]) == len(names[2]) == count
        for index, (render_path, photo_path) in enumerate(zip(*names[:2], strict=True)):
            photo = pixels(photo_path)
            picture = pixels(render_path)
            assert photo.shape == picture.shape != (48, 64, 3), "the lens was not undone"
            assert np.abs(photo - dataset[index]["image"].numpy()).max() <= 1 / 255 + 1e-6
            shown = drawn_by_the_model(pipeline, dataset.cameras[index : index + 1])
            assert np.abs(picture - shown).max() <= 1 / 255 + 1e-6
