"""Command lines that ns-train and ns-eval understand, whatever folders are called."""

from __future__ import annotations

import shlex
from pathlib import Path

from making import parsed_by_ns_train
from pointsplat_ns.nerfstudio_plugin.running import (
    evaluate_command,
    run_folder,
    train_refiner_command,
    train_scene_command,
)


def test_the_command_of_a_scene_says_what_was_asked_for():
    config = parsed_by_ns_train(train_scene_command(Path("my rooms/a"), Path("my scenes"), "a", 30, "now", 500))
    assert (config.method_name, config.max_num_iterations, config.data) == ("splatfacto-cpu", 30, Path("my rooms/a"))
    assert config.pipeline.datamanager.dataparser.num_seed_points == 500
    assert config.get_base_dir() == run_folder(Path("my scenes"), "a", "splatfacto-cpu", "now")


def test_the_command_of_a_refiner_says_what_was_asked_for():
    options = {"pipeline.model.more-keeps": (0.25, 40.0), "pipeline.model.augment": True, "rate-factor": 2.5}
    command = train_refiner_command(Path("my scenes"), Path("out"), "r", 30, "now", ("a", "b"), options)
    config = parsed_by_ns_train(command)
    assert (config.method_name, config.max_num_iterations, config.rate_factor) == ("pointsplat", 30, 2.5)
    assert config.pipeline.datamanager.eval_scenes == ("a", "b") and config.data == Path("my scenes")
    assert config.pipeline.model.more_keeps == (0.25, 40.0) and config.pipeline.model.augment is True
    assert config.get_base_dir() == run_folder(Path("out"), "r", "pointsplat", "now")


def test_no_scene_is_held_out_unless_one_is_named():
    assert "eval-scenes" not in train_refiner_command(Path("scenes"), Path("out"), "r", 30, "now")


def test_the_command_of_an_evaluation_quotes_its_paths():
    words = shlex.split(evaluate_command(Path("a run"), Path("an evaluation.json"), Path("pictures")))
    assert words[:3] == ["ns-eval", "--load-config", "a run/config.yml"]
    assert words[3:] == ["--output-path", "an evaluation.json", "--render-output-path", "pictures"]
