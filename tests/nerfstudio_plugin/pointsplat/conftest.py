"""Trainings of the refiner and evaluations that several modules look at."""

import json
import shutil
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import box_room, fast_config, views_sampled_once
from pointsplat_ns.io import write_ply


@pytest.fixture(scope="session", autouse=True)
def poses_sampled_once():
    with views_sampled_once():
        yield


@pytest.fixture(scope="session")
def trained(trained_walls, run_training, tmp_path_factory):
    """A short training on wall-a with wall-b held out: its config, its trainer, and which scenes gave photos."""
    config = fast_config(trained_walls, tmp_path_factory.mktemp("refined"))
    config.pipeline.datamanager.eval_scenes = ("wall-b",)
    config.steps_per_eval_image = 4
    from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel

    used, losses = [], PointSplatModel.losses

    def recorded(self, index, frames):
        used.append((self.training, index))
        return losses(self, index, frames)

    with mock.patch.object(PointSplatModel, "losses", recorded):
        trainer, _ = run_training(config)
    return config, trainer, used


@pytest.fixture(scope="session")
def evaluated(trained):
    """The pipeline as ns-eval opens it."""
    config, _, _ = trained
    return eval_setup(config.get_base_dir() / "config.yml")[1]


@pytest.fixture(scope="session")
def lens_run(wall_scene, wall_config, run_training, tmp_path_factory) -> Path:
    """A run of SH degree 0 over black on the wall's photos, read by nerfstudio-data, as if through a lens."""
    scene = tmp_path_factory.mktemp("lens") / "scene"
    shutil.copytree(wall_scene / "results", scene / "images", ignore=shutil.ignore_patterns("depth*"))
    frames = []
    for i, line in enumerate((wall_scene / "traj.txt").read_text().splitlines()):
        pose = np.array(line.split(), dtype=float).reshape(4, 4) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/frame{i:06d}.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV", "k1": 0.15, "k2": 0.02, "p1": 0.004, "p2": -0.003}
    camera = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 24.5, "w": 64, "h": 48, **lens}
    (scene / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    config = wall_config(scene, scene.parent / "outputs", steps=15)
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig()
    config.pipeline.model.sh_degree, config.pipeline.model.background_color = 0, "black"
    config.pipeline.model.num_random, config.pipeline.model.random_scale = 300, 2.0
    run_training(config)
    return config.get_base_dir()


@pytest.fixture(scope="session")
def three_rooms(tmp_path_factory) -> Path:
    """A folder of three PLY files and nothing else."""
    folder = tmp_path_factory.mktemp("three_rooms")
    for seed in range(3):
        write_ply(box_room(seed, size=0.12, smooth=True), folder / f"room{seed}.ply")
    return folder
