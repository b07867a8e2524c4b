"""Shared test data: a tiny scene whose every pixel is known."""

import json
import math
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import quick_start.sitecustomize  # noqa: F401  (before nerfstudio)
import torch

from browser import chromium
from making import SHARED_DATA, ball, losses_of, small_config
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.sampler import sample_views
from quick import quick_settings
from replica_scenes import write_frames

SEED = 20
LPIPS_WEIGHTS = SHARED_DATA / "weights"


def wall_colors(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours (..., 3) in [0, 1] of the wall at x, y in scene units."""
    return np.stack(
        [0.5 + 0.4 * np.sin(4 * x), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * x + 2 * y)],
        axis=-1,
    )


@pytest.fixture(scope="session")
def wall_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exact photos, depth images and poses of a painted wall, in the Replica layout; shared by all
    tests, so do not write to it. The cameras stand 2 units before the wall z = 0, look along +z and
    step sideways."""
    folder = tmp_path_factory.mktemp("replica")
    width = 64
    height = 48
    focal = 60.0
    scale = 6553.5
    camera = {
        "w": width,
        "h": height,
        "fx": focal,
        "fy": focal,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
    }
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, "scale": scale}}))
    places = np.array([(0.6 * math.cos(i), 0.4 * math.sin(2 * i), -2.0) for i in range(11)])
    rays = (
        np.stack(np.meshgrid(np.arange(width) - camera["cx"], np.arange(height) - camera["cy"]))
        / focal
    )
    walls = (wall_colors(*(place[:2, None, None] + 2 * rays)) for place in places)
    photos = (np.round(255 * colors).astype(np.uint8) for colors in walls)
    return write_frames(folder / "wall", photos, places, round(2 * scale))


@pytest.fixture(scope="session")
def wall_config() -> Callable:
    """A function (scene, output_dir, steps) that gives the config of a short splatfacto-cpu
    training."""
    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    def config_of(scene: Path, output_dir: Path, steps: int):
        config = splatfacto_cpu_config()
        config.machine.device_type = "cpu"
        config.output_dir = output_dir
        config.max_num_iterations = steps
        config.pipeline.datamanager.dataparser = ReplicaDataParserConfig(num_seed_points=300)
        config.pipeline.datamanager.data = config.data = scene
        config.pipeline.model.refine_every = 10
        config.pipeline.model.densify_grad_thresh = 1e-4
        config.set_timestamp()
        return config

    return config_of


@pytest.fixture(scope="session")
def run_training() -> Callable:
    """A function that trains a config with nerfstudio's trainer and gives the trainer and the loss
    of every step."""

    def run(config):
        torch.manual_seed(SEED)
        config.save_config()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        losses = losses_of(trainer)
        with warnings.catch_warnings():
            # torch: "lr_scheduler.step() before optimizer.step()", because it does not see the
            # gradient scaler's step
            warnings.filterwarnings("ignore", category=UserWarning, module="torch.optim.*")
            trainer.train()
        return trainer, losses

    return run


@pytest.fixture(scope="session")
def trained_walls(wall_scene, wall_config, run_training, tmp_path_factory) -> Path:
    """Folder with two short splatfacto-cpu runs: ``wall-a``, and ``wall-b`` of SH degree 1,
    antialiased, over white.

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
    """LPIPS from the weights at hand; without them, none and no attempt at a download. Says
    which."""
    if LPIPS_WEIGHTS.exists():
        monkeypatch.setenv("POINTSPLAT_LPIPS_WEIGHTS", str(LPIPS_WEIGHTS))
    else:
        request.getfixturevalue("no_lpips")
    return LPIPS_WEIGHTS.exists()


@pytest.fixture(scope="session")
def make_refined_run() -> Callable:
    """A function that writes a pointsplat run as nerfstudio saves it, whose network adds ``moved``
    to every opacity logit and nothing else, and gives its folder."""
    from pointsplat_ns.refinement import Refiner, refiner_preset

    def make(
        folder: Path, data: Path, eval_scenes: tuple[str, ...] = (), moved: float = 0.0, **model
    ) -> Path:
        config = small_config(data, folder, 10, **model)
        config.pipeline.datamanager.eval_scenes = eval_scenes
        config.write_config()
        torch.manual_seed(SEED)
        refiner = Refiner(refiner_preset("tiny"))
        with torch.no_grad():
            [*refiner.heads.mlps["opacities"].modules()][-1].bias.fill_(moved)
        state = {f"_model.refiner.{name}": value for name, value in refiner.state_dict().items()}
        # The rate of a cosine schedule is a numpy number, which torch refuses to load unless it is
        # told otherwise.
        state = {
            "step": 9,
            "pipeline": state,
            "schedulers": {"encoder": {"_last_lr": [np.float64(0.1)]}},
        }
        config.get_checkpoint_dir().mkdir()
        torch.save(
            state | {"optimizers": {}, "scalers": {}},
            config.get_checkpoint_dir() / "step-000000009.ckpt",
        )
        return config.get_base_dir()

    return make


@pytest.fixture(scope="session")
def hollow_ball() -> Gaussians:
    """The inside of a ball of radius 2 about (5, 0, 0), covered with opaque blobs, and an outlier
    far away; shared by all tests, so do not write to it."""
    scene = ball(1500, 2, log_size=math.log(0.12))
    noise = 0.3 * torch.randn(1500, 3, generator=torch.Generator().manual_seed(1))
    scene = scene.replace(
        means=scene.means + torch.tensor([5.0, 0.0, 0.0]), features_dc=scene.features_dc + noise
    )
    scene.means[0] = 1e6
    return scene


@pytest.fixture(scope="session")
def ball_views(hollow_ball: Gaussians) -> Views:
    """Four small views from within."""
    with quick_settings():
        return sample_views(hollow_ball, 4, 64, 48)


@pytest.fixture(scope="module")
def browser() -> Iterator:
    """A headless Chromium."""
    with chromium() as opened:
        yield opened


@pytest.fixture(autouse=True)
def signals_as_they_were():
    """Whatever a test starts, SIGTERM ends the process afterwards as it did before."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.fixture()
def time_limit() -> Iterator[None]:
    """End a test that hangs, as one that waits for a pipe does, after two minutes."""

    def hangs(number, frame):
        pytest.fail("still running after 120 s")

    before = signal.signal(signal.SIGALRM, hangs)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
