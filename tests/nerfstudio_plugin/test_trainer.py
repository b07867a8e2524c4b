"""The folder of a training, and the numbers of steps that it takes."""

import copy
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml

from making import small_config
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

METHODS = pytest.mark.parametrize("method", [splatfacto_cpu_config, pointsplat_config])


def config_of(method, output: Path):
    config = method()
    config.output_dir, config.experiment_name, config.timestamp = output, "room", "2026-01-01_120000"
    return config


@METHODS
def test_trainings_of_one_timestamp_get_a_folder_each(method, tmp_path):
    configs = [config_of(method, tmp_path) for _ in range(6)]
    with ThreadPoolExecutor(len(configs)) as pool:
        for started in [pool.submit(config.save_config) for config in configs]:
            started.result()
    folders = [config.get_base_dir() for config in configs]
    assert len(set(folders)) == len(configs)
    expected = {"2026-01-01_120000", *(f"2026-01-01_120000_{number}" for number in range(2, 7))}
    assert {folder.name for folder in folders} == expected
    for config, folder in zip(configs, folders, strict=True):
        assert yaml.load((folder / "config.yml").read_text(), yaml.Loader) == config  # of this test's own making


@METHODS
def test_a_training_resumed_in_its_own_folder_stays_there(method, tmp_path):
    first = config_of(method, tmp_path)
    first.save_config()
    folder = first.get_checkpoint_dir()
    for name, value in (("load_dir", folder), ("load_checkpoint", folder / "step-000000001.ckpt")):
        again = config_of(method, tmp_path)
        setattr(again, name, value)
        again.save_config()
        assert again.get_base_dir() == first.get_base_dir()
    other = copy.deepcopy(first)
    other.load_dir = tmp_path / "elsewhere"
    other.save_config()
    assert other.get_base_dir() != first.get_base_dir()


@METHODS
def test_a_folder_that_cannot_be_made_is_one_error(method, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(PointSplatError, match="file/room.*: cannot be made .* name another --output-dir"):
        config_of(method, tmp_path / "file").save_config()


@pytest.mark.parametrize("resumed", [False, True])
@pytest.mark.parametrize("number", [0, -3])
def test_no_steps_are_refused_and_leave_no_folder(number, resumed, wall_scene, wall_config, tmp_path):
    configs = [wall_config(wall_scene, tmp_path / "scene", 2), small_config(wall_scene, tmp_path / "refiner", 2)]
    for config in configs:
        config.max_num_iterations = number
        config.load_dir = tmp_path / "checkpoints" if resumed else None
        with pytest.raises(PointSplatError, match=f"--max-num-iterations {number}: expected at least 1"):
            config.save_config()
        assert not config.output_dir.exists()
