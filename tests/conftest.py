"""Shared test data: a tiny scene whose every pixel is known."""

import json
import math
import signal
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.configs import external_methods

from making import SHARED_DATA
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.views import Views

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
WALL_DISTANCE = 2.0
DEPTH_SCALE = 6553.5
NUM_FRAMES = 11


# nerfstudio lists the methods that others offer. For each of these 26 it looks at the stack, and searches all modules
# for the sources of what runs: more than ten seconds.
external_methods.get_external_methods = lambda: ({}, {})


def wall_colors(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours (..., 3) in [0, 1] of the wall at x, y in scene units."""
    return np.stack([0.5 + 0.4 * np.sin(4 * x), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * x + 2 * y)], axis=-1)


def write_wall(scene: Path, num_frames: int = NUM_FRAMES, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Write exact photos, depth images and poses of a painted wall, in the Replica layout.

    The cameras stand ``WALL_DISTANCE`` before the wall z = 0, look along +z and step sideways."""
    (scene / "results").mkdir(parents=True)
    cx, cy = (width - 1) / 2, (height - 1) / 2
    camera = {"w": width, "h": height, "fx": FOCAL, "fy": FOCAL, "cx": cx, "cy": cy, "scale": DEPTH_SCALE}
    (scene.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    poses = []
    for i in range(num_frames):
        x, y = 0.6 * np.cos(i), 0.4 * np.sin(2 * i)
        colors = wall_colors(x + (u - cx) / FOCAL * WALL_DISTANCE, y + (v - cy) / FOCAL * WALL_DISTANCE)
        photo = np.round(255 * colors).astype(np.uint8)
        cv2.imwrite(str(scene / "results" / f"frame{i:06d}.png"), photo[..., ::-1])
        depth = np.full((height, width), round(WALL_DISTANCE * DEPTH_SCALE), dtype=np.uint16)
        cv2.imwrite(str(scene / "results" / f"depth{i:06d}.png"), depth)
        pose = np.eye(4)
        pose[:3, 3] = x, y, -WALL_DISTANCE
        poses.append(" ".join(f"{value:.9g}" for value in pose.reshape(-1)))
    (scene / "traj.txt").write_text("\n".join(poses) + "\n")
    return scene


@pytest.fixture(scope="session")
def wall_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the painted wall; shared by all tests, so do not write to it."""
    return write_wall(tmp_path_factory.mktemp("replica") / "wall")


SEED = 20
LPIPS_WEIGHTS = SHARED_DATA / "weights"


@pytest.fixture(scope="session")
def wall_config() -> Callable:
    """A function (scene, output_dir, steps) that gives the config of a short splatfacto-cpu training."""
    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    def config_of(scene: Path, output_dir: Path, steps: int):
        config = splatfacto_cpu_config()
        config.machine.device_type = "cpu"
        config.output_dir, config.max_num_iterations = output_dir, steps
        config.pipeline.datamanager.dataparser = ReplicaDataParserConfig(num_seed_points=300)
        config.pipeline.datamanager.data = config.data = scene
        config.pipeline.model.refine_every = 10
        config.pipeline.model.densify_grad_thresh = 1e-4
        config.set_timestamp()
        return config

    return config_of


@pytest.fixture(scope="session")
def run_training() -> Callable:
    """A function that trains a config with nerfstudio's trainer and gives the trainer and the loss of every step."""

    def run(config):
        torch.manual_seed(SEED)
        config.save_config()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        losses, iteration = [], trainer.train_iteration

        def recorded(step):
            result = iteration(step)
            losses.append(result[0].item())
            return result

        trainer.train_iteration = recorded
        with warnings.catch_warnings():
            # torch: "lr_scheduler.step() before optimizer.step()", because it does not see the gradient scaler's step
            warnings.filterwarnings("ignore", category=UserWarning, module="torch.optim.*")
            trainer.train()
        return trainer, losses

    return run


@pytest.fixture(scope="session")
def trained_walls(wall_scene, wall_config, run_training, tmp_path_factory) -> Path:
    """Folder with two short splatfacto-cpu runs: ``wall-a``, and ``wall-b`` of SH degree 1, antialiased, over white.

    Shared by all tests, so do not write to it.
    """
    folder = tmp_path_factory.mktemp("trained")
    for name in ("wall-a", "wall-b"):
        config = wall_config(wall_scene, folder, steps=30)
        config.experiment_name = name
        if name == "wall-b":
            config.pipeline.model.sh_degree = 1
            config.pipeline.model.rasterize_mode = "antialiased"
            config.pipeline.model.background_color = "white"
        run_training(config)
    return folder


@pytest.fixture()
def no_lpips(tmp_path_factory, monkeypatch):
    """A machine with no LPIPS weights and no network."""
    nothing = tmp_path_factory.mktemp("no_weights")
    monkeypatch.setenv("POINTSPLAT_LPIPS_WEIGHTS", str(nothing))
    monkeypatch.setenv("TORCH_HOME", str(nothing))

    def no_network(*args, **kwargs):
        raise OSError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", no_network)


@pytest.fixture()
def some_lpips(request, monkeypatch) -> bool:
    """LPIPS from the weights at hand; without them, none and no attempt at a download. Says which."""
    if LPIPS_WEIGHTS.exists():
        monkeypatch.setenv("POINTSPLAT_LPIPS_WEIGHTS", str(LPIPS_WEIGHTS))
    else:
        request.getfixturevalue("no_lpips")
    return LPIPS_WEIGHTS.exists()


@pytest.fixture(scope="session")
def make_refined_run() -> Callable:
    """A function that writes a pointsplat run as nerfstudio saves it, whose network adds ``moved`` to every opacity
    logit and nothing else, and gives its folder."""
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
    from pointsplat_ns.refiner import Refiner, preset

    def make(folder: Path, data: Path, eval_scenes: tuple[str, ...] = (), moved: float = 0.0, **model) -> Path:
        config = pointsplat_config()
        config.output_dir, config.experiment_name = folder, "refiner"
        config.pipeline.datamanager.data = config.data = data
        config.pipeline.datamanager.eval_scenes = eval_scenes
        for name, value in {"size": "tiny", "keep": 0.5, "by": "paper", **model}.items():
            setattr(config.pipeline.model, name, value)
        config.set_timestamp()
        config.save_config()
        torch.manual_seed(SEED)
        refiner = Refiner(preset("tiny"))
        with torch.no_grad():
            [*refiner.heads.mlps["opacities"].modules()][-1].bias.fill_(moved)
        state = {f"_model.refiner.{name}": value for name, value in refiner.state_dict().items()}
        # The rate of a cosine schedule is a numpy number, which torch refuses to load unless it is told otherwise.
        schedules = {"encoder": {"_last_lr": [np.float64(0.1)]}}
        config.get_checkpoint_dir().mkdir()
        torch.save(
            {"step": 9, "pipeline": state, "optimizers": {}, "schedulers": schedules, "scalers": {}},
            config.get_checkpoint_dir() / "step-000000009.ckpt",
        )
        return config.get_base_dir()

    return make


@pytest.fixture(scope="session")
def make_hollow_ball() -> Callable[..., Gaussians]:
    """A function that makes the inside of a ball of radius 2 about (5, 0, 0), covered with opaque blobs, and an outlier
    far away."""

    def make(n: int = 1500, seed: int = 0, degree: int = 2) -> Gaussians:
        generator = torch.Generator().manual_seed(seed)
        place = torch.randn(n, 3, generator=generator)
        place = 2 * place / place.norm(dim=1, keepdim=True)
        scene = Gaussians(
            means=place + torch.tensor([5.0, 0.0, 0.0]),
            scales=torch.full((n, 3), math.log(0.12)) + 0.2 * torch.randn(n, 3, generator=generator),
            quats=torch.randn(n, 4, generator=generator),
            opacities=2 + torch.randn(n, 1, generator=generator),
            features_dc=torch.sin(2 * place) + 0.3 * torch.randn(n, 3, generator=generator),
            features_rest=0.03 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator),
        )
        scene.means[0] = 1e6
        return scene

    return make


@pytest.fixture(scope="session")
def hollow_ball(make_hollow_ball) -> Gaussians:
    """Shared by all tests here, so do not write to it."""
    return make_hollow_ball()


@pytest.fixture(scope="session")
def ball_views(hollow_ball: Gaussians) -> Views:
    """Four small views from within."""
    return sample_views(hollow_ball, 4, 64, 48)


@pytest.fixture(autouse=True)
def signals_as_they_were():
    """Whatever a test starts, SIGTERM ends the process afterwards as it did before."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    assert signal.getsignal(signal.SIGTERM) == before
