"""The recipe of ``make-refiner``: its rooms differ, and its commands are ones that ns-train understands."""

from pathlib import Path

import pytest

from making import parsed_by_ns_train
from pointsplat_ns.nerfstudio_plugin.pointsplat.make_refiner import (
    RECIPE,
    refiner_command,
    scene_settings,
)


def test_settings_follow_from_the_seed_and_differ_between_seeds():
    assert not set(RECIPE.train_seeds) & set(RECIPE.unseen_seeds)
    every = [scene_settings(seed) for seed in (*RECIPE.train_seeds, *RECIPE.unseen_seeds)]
    assert every == [scene_settings(seed) for seed in (*RECIPE.train_seeds, *RECIPE.unseen_seeds)]
    for name in ("steps", "seed_points", "densify_grad_thresh"):
        assert len({getattr(s, name) for s in every}) > 0.9 * len(every), name
    for name in ("width", "cull_alpha_thresh", "antialiased", "scale_regularization"):
        assert len({getattr(s, name) for s in every}) > 1, name


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
    assert model.pruned_folder == Path("o/pruned")
