"""A trained run as nerfstudio itself writes one, shared by the tests of this folder."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from making import normal_scene


def saved_by_nerfstudio(scene, step=29999, prefix="_model.gauss_params."):
    """The content of a checkpoint with all that nerfstudio's trainer puts in one."""
    parameters = {name: torch.nn.Parameter(value.clone()) for name, value in scene.items()}
    optimizers = {}
    schedulers = {}
    for name, value in parameters.items():
        optimizer = torch.optim.Adam([value], lr=1e-3, eps=1e-15)
        value.grad = torch.ones_like(value)
        optimizer.step()
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: np.float64(0.5))
        optimizers[name] = optimizer.state_dict()
        schedulers[name] = scheduler.state_dict()
    pipeline = {prefix + name: value for name, value in scene.items()}
    return {
        "step": step,
        "pipeline": {**pipeline, "_model.lpips.net.weight": torch.zeros(3)},
        "optimizers": optimizers,
        "schedulers": schedulers,
        "scalers": {},
    }


@pytest.fixture
def checkpoint_of():
    return saved_by_nerfstudio


@pytest.fixture(scope="session")
def config_texts():
    """``config.yml`` of splatfacto and of nerfacto, as the installed nerfstudio dumps them."""
    data = Path("data/kitchen")
    found = {}
    for method, model in (("splatfacto", SplatfactoModelConfig()), ("nerfacto", ModelConfig())):
        parser = NerfstudioDataParserConfig(load_3D_points=True)
        manager = FullImageDatamanagerConfig(data=data, dataparser=parser)
        optimizer = {
            "optimizer": AdamOptimizerConfig(lr=1e-3),
            "scheduler": ExponentialDecaySchedulerConfig(),
        }
        config = TrainerConfig(
            method_name=method,
            data=data,
            output_dir=Path("outputs"),
            timestamp="2024-05-06_070809",
            pipeline=VanillaPipelineConfig(datamanager=manager, model=model),
            optimizers={"means": optimizer},
        )
        config.set_experiment_name()
        found[method] = yaml.dump(config)
    return found


@pytest.fixture
def make_run(tmp_path, config_texts):
    def make(
        experiment="kitchen",
        method="splatfacto",
        time="2024-05-06_070809",
        steps=(1999,),
        scene=None,
    ):
        folder = tmp_path / "outputs" / experiment / method / time
        (folder / "nerfstudio_models").mkdir(parents=True)
        text = config_texts.get(method, config_texts["splatfacto"])
        text = text.replace("experiment_name: kitchen", f"experiment_name: {experiment}")
        text = text.replace("method_name: splatfacto", f"method_name: {method}")
        text = text.replace("timestamp: 2024-05-06_070809", f"timestamp: {time}")
        (folder / "config.yml").write_text(text)
        for step in steps:
            content = saved_by_nerfstudio(normal_scene(seed=step) if scene is None else scene, step)
            torch.save(content, folder / "nerfstudio_models" / f"step-{step:09d}.ckpt")
        (tmp_path / "data" / "kitchen").mkdir(parents=True, exist_ok=True)
        return folder

    return make
