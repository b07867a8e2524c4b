"""Which trainings have finished, and the command lines of trainings and evaluations."""

import shlex
from pathlib import Path

import pytest

from making import parsed_by_ns_train, write_run
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.running import (
    evaluate_command,
    folder_of_run,
    has_finished,
    remove_interrupted,
    train_refiner_command,
    train_scene_command,
)


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("steps", "planned", "wanted"), [(30, 30, 30), (12, 30, 30), (12, 30, 12)])
def test_asking_whether_a_training_has_finished_changes_nothing(steps, planned, wanted, tmp_path):
    write_run(tmp_path, steps, planned)
    before = files(tmp_path)
    assert has_finished(tmp_path, wanted) == (steps == planned)
    assert before == files(tmp_path) and len(before) == 2


def test_a_training_of_another_number_of_steps_is_said_and_one_without_a_checkpoint_has_not_finished(tmp_path):
    checkpoint = write_run(tmp_path, 30, 30)
    with pytest.raises(SceneError, match="a finished training of 30 steps; expected one of 20 .*; do this instead"):
        has_finished(tmp_path, 20, "do this instead")
    checkpoint.unlink()
    assert not has_finished(tmp_path, 30) and (tmp_path / "config.yml").is_file()
    assert not has_finished(tmp_path / "nothing", 30)
    remove_interrupted(tmp_path / "nothing")


def test_only_an_interrupted_training_is_removed(tmp_path):
    done, stopped = tmp_path / "done", tmp_path / "stopped"
    write_run(done, 30, 30)
    write_run(stopped, 12, 30)
    remove_interrupted(stopped)
    assert not stopped.exists()
    with pytest.raises(SceneError, match="holds a finished training"):
        remove_interrupted(done)
    assert len(files(done)) == 2


def test_a_run_that_does_not_say_how_long_it_was_to_be_is_kept(tmp_path):
    write_run(tmp_path, 30, 30)
    config = tmp_path / "config.yml"
    config.write_text(config.read_text().replace("max_num_iterations: 30\n", ""))
    assert has_finished(tmp_path, 30)
    with pytest.raises(SceneError, match="holds a finished training"):
        remove_interrupted(tmp_path)


def test_the_command_of_a_scene_says_what_was_asked_for():
    config = parsed_by_ns_train(train_scene_command(Path("my rooms/a"), Path("my scenes"), "a", 30, "now", 500))
    assert (config.method_name, config.max_num_iterations, config.data) == ("splatfacto-cpu", 30, Path("my rooms/a"))
    assert config.pipeline.datamanager.dataparser.num_seed_points == 500
    assert config.get_base_dir() == folder_of_run(Path("my scenes"), "a", "splatfacto-cpu", "now")


def test_the_command_of_a_refiner_says_what_was_asked_for():
    options = {"pipeline.model.more-keeps": (0.25, 40.0), "pipeline.model.augment": True, "rate-factor": 2.5}
    command = train_refiner_command(Path("my scenes"), Path("out"), "r", 30, "now", ("a", "b"), options)
    config = parsed_by_ns_train(command)
    assert (config.method_name, config.max_num_iterations, config.rate_factor) == ("pointsplat", 30, 2.5)
    assert config.pipeline.datamanager.eval_scenes == ("a", "b") and config.data == Path("my scenes")
    assert config.pipeline.model.more_keeps == (0.25, 40.0) and config.pipeline.model.augment is True
    assert config.get_base_dir() == folder_of_run(Path("out"), "r", "pointsplat", "now")


def test_the_command_of_an_evaluation_quotes_its_paths():
    words = shlex.split(evaluate_command(Path("a run"), Path("an evaluation.json"), Path("pictures")))
    assert words[:3] == ["ns-eval", "--load-config", "a run/config.yml"]
    assert words[3:] == ["--output-path", "an evaluation.json", "--render-output-path", "pictures"]
