"""Trainings of the refiner and evaluations that several modules look at."""

from pathlib import Path

import pytest
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import box_room, fast_config, views_sampled_once
from pointsplat_ns.scene.ply import write_ply
from quick import quick_settings


@pytest.fixture(scope="session", autouse=True)
def poses_sampled_once():
    with views_sampled_once():
        yield


@pytest.fixture(scope="session")
def trained(trained_walls, run_training, tmp_path_factory):
    """A short training on wall-a with wall-b held out: its config and its trainer."""
    config = fast_config(trained_walls, tmp_path_factory.mktemp("refined"))
    config.pipeline.datamanager.eval_scenes = ("wall-b",)
    config.steps_per_eval_image = 4
    with quick_settings():
        return config, run_training(config)[0]


@pytest.fixture(scope="session")
def evaluated(trained):
    with quick_settings():
        return eval_setup(trained[0].get_base_dir() / "config.yml")[1]


@pytest.fixture(scope="session")
def three_rooms(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("three_rooms")
    for seed in range(3):
        write_ply(box_room(seed, size=0.12, smooth=True), folder / f"room{seed}.ply")
    return folder
