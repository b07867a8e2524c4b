"""The recipe of a refiner: the commands that it gives."""

from pathlib import Path

import pytest

from lab.make_refiner import RECIPE, refiner_command, scene_settings
from making import parsed_by_ns_train


def test_the_scene_command_says_what_the_settings_say():
    settings = scene_settings(RECIPE.train_seeds[0])
    config = parsed_by_ns_train(settings.train_command(Path("rooms/a b"), Path("scenes"), "recipe"))
    model = config.pipeline.model
    assert config.method_name == "splatfacto-cpu" and config.experiment_name == settings.name
    assert config.max_num_iterations == settings.steps
    assert model.densify_grad_thresh == pytest.approx(settings.densify_grad_thresh, rel=0.05)  # two digits
    assert model.cull_alpha_thresh == settings.cull_alpha_thresh
    assert model.rasterize_mode == ("antialiased" if settings.antialiased else "classic")
    assert model.use_scale_regularization == settings.scale_regularization
    assert config.pipeline.datamanager.dataparser.num_seed_points == settings.seed_points
    assert config.data == Path("rooms/a b")


def test_the_refiner_command_holds_the_unseen_rooms_out():
    config = parsed_by_ns_train(refiner_command(Path("o/scenes"), Path("o/refiners"), "name", "recipe", "tiny", 70, 3))
    manager, model = config.pipeline.datamanager, config.pipeline.model
    assert config.method_name == "pointsplat" and config.max_num_iterations == 70
    assert manager.eval_scenes == tuple(f"room{seed}" for seed in RECIPE.unseen_seeds)
    assert (manager.supervision, manager.seed) == ("dense", 3)
    assert model.keep == RECIPE.keep and model.size == "tiny" and model.by == "merge"
