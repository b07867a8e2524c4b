"""Trainings that go on from a checkpoint have its settings, and options as they are typed."""

import shutil
from pathlib import Path
from unittest import mock

import pytest
import tyro

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import small_config
from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import (
    PointSplatTrainerConfig,
    pointsplat_config,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig
from pointsplat_ns.pipeline.trained_refiner import load_refiner
from pointsplat_ns.pruning import METHODS


def resumed(trained, data: Path, output_dir: Path, **model) -> PointSplatTrainerConfig:
    """The method as it ships, with some settings of the model, going on from a run."""
    config = pointsplat_config()
    config.machine.device_type = "cpu"
    config.pipeline.datamanager.data = config.data = data
    config.output_dir = output_dir
    config.load_dir = trained[0].get_checkpoint_dir()
    config.max_num_iterations = 1
    config.pipeline.model.lpips_weight = 0.0
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    return config


def test_a_training_resumes_without_options_as_the_network_and_selection_of_its_checkpoint(
    trained, trained_walls, tmp_path
):
    config = resumed(trained, trained_walls, tmp_path)
    config.set_timestamp()
    model = config.pipeline.model
    assert (model.size, model.keep, model.by) == ("tiny", 0.5, "paper")
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    assert trainer._start_step == 10
    trainer.save_checkpoint(10)
    again = load_refiner(config.get_base_dir())
    assert again.settings == load_refiner(trained[0].get_base_dir()).settings


def test_a_selection_that_is_named_stays_and_another_network_is_refused_before_anything_is_read(
    trained, trained_walls, tmp_path
):
    config = resumed(trained, trained_walls, tmp_path, keep="20%")
    config.set_timestamp()
    assert (config.pipeline.model.size, config.pipeline.model.keep) == ("tiny", "20%")
    config = resumed(trained, tmp_path / "nothing here", tmp_path, size="full")
    with pytest.raises(
        PointSplatError, match=r"--pipeline.model.size full: .*ckpt holds a network with tiny"
    ):
        config.set_timestamp()


def test_a_checkpoint_outside_of_a_run_changes_nothing(trained, trained_walls, tmp_path):
    (path,) = trained[0].get_checkpoint_dir().iterdir()
    (tmp_path / "deep" / "alone").mkdir(parents=True)
    shutil.copy(path, tmp_path / "deep" / "alone")
    config = resumed(trained, trained_walls, tmp_path)
    config.load_dir = tmp_path / "deep" / "alone"
    config.set_timestamp()
    assert config.pipeline.model == PointSplatModelConfig(lpips_weight=0.0)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"keep": "10MB"}, "for several scenes"),
        ({"more_keeps": ("5%", "many")}, "keep is 'many'"),
        ({"opacity_weight": 1.5}, "lambda, the opacity weight, is 1.5; expected 0 to 1"),
        ({"by": "merge", "opacity_weight": 0.3}, "merge does not weigh opacity"),
    ],
)
def test_a_selection_that_cannot_be_is_refused_before_anything_is_read(model, message, tmp_path):
    config = pointsplat_config()
    config.output_dir = tmp_path / "out"
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    with pytest.raises(PointSplatError, match=message) as error:
        config.set_timestamp()
    assert "ckpt" not in str(error.value) and not config.output_dir.exists()


def test_a_bare_small_count_is_questioned_before_the_first_step(tmp_path, three_rooms):
    config = small_config(three_rooms, tmp_path, 1, keep="10")
    model = config.pipeline.setup(device="cpu", test_mode="val").model
    with (
        mock.patch("pointsplat_ns.pruning.methods.len", lambda scene: 5000, create=True),
        pytest.raises(BudgetError, match=r"room0.*did you mean 10%"),
    ):
        model.pruned_scene(0)


@pytest.mark.parametrize("flag", ["--lambda", "--pipeline.model.lambda"])
def test_lambda_is_an_option_by_its_own_name(flag):
    found = tyro.cli(PointSplatTrainerConfig, args=[flag, "0.5"], default=pointsplat_config())
    assert found.pipeline.model.opacity_weight == 0.5


def test_help_of_by_names_all_methods():
    text = (Path(method_configs.__file__).parents[1] / "pointsplat_ns").joinpath(
        "nerfstudio_plugin", "pointsplat", "model.py"
    )
    described = text.read_text().partition('    by: str = "paper"')[2].partition('"""\n')[0]
    assert all(name in described for name in METHODS)


def test_a_training_says_nothing_of_itself_or_of_interrupted_ones(trained_walls, tmp_path, caplog):
    shutil.copytree(trained_walls, tmp_path / "outputs")
    config = small_config(tmp_path / "outputs", tmp_path / "outputs", 1)
    config.write_config()  # of a training that saved no checkpoint
    manager = ScenesDataManagerConfig(data=tmp_path / "outputs", cache_gigabytes=0.01)
    assert len(manager.setup(test_mode="val").scenes) == 2
    assert "skipped" not in caplog.text


def test_a_scene_whose_photos_moved_is_not_said_to_be_gone(trained, trained_walls, tmp_path, capfd):
    from making import run_of, without_data

    runs = without_data(trained_walls, tmp_path / "runs")
    shutil.copy(
        run_of(trained_walls, "wall-b") / "config.yml", run_of(runs, "wall-b") / "config.yml"
    )
    pipeline = small_config(runs, tmp_path, 1).pipeline.setup(device="cpu", test_mode="val")
    capfd.readouterr()
    pipeline.set_extra_state({"trained_on": ["wall-x/y step 1", *pipeline.datamanager.left_out]})
    said = capfd.readouterr().out.replace("\n", " ")
    assert "wall-x" in said and "wall-a" not in said
    with pytest.raises(SceneError, match="wall-a.*config.yml"):
        ScenesDataManagerConfig(data=run_of(runs, "wall-a"), scene_data=tmp_path).setup()
