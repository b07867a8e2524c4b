"""Which trainings have finished: asking changes nothing, and only interrupted ones are removed."""

from __future__ import annotations

from pathlib import Path

import pytest

from making import write_run
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.running import finished, remove_interrupted


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("steps", "planned", "wanted"), [(30, 30, 30), (12, 30, 30), (12, 30, 12)])
def test_asking_whether_a_training_has_finished_changes_nothing(steps, planned, wanted, tmp_path):
    write_run(tmp_path, steps, planned)
    before = files(tmp_path)
    assert finished(tmp_path, wanted) == (steps == planned)
    assert before == files(tmp_path) and len(before) == 2


def test_a_folder_without_a_checkpoint_and_none_at_all_are_no_finished_training(tmp_path):
    write_run(tmp_path, 30, 30).unlink()
    assert not finished(tmp_path, 30) and (tmp_path / "config.yml").is_file()
    assert not finished(tmp_path / "nothing", 30)
    remove_interrupted(tmp_path / "nothing")


def test_a_finished_training_of_another_number_of_steps_is_said_with_what_to_do(tmp_path):
    write_run(tmp_path, 30, 30)
    with pytest.raises(SceneError, match="a finished training of 30 steps; expected one of 20 .*; do this instead"):
        finished(tmp_path, 20, "do this instead")


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
    assert finished(tmp_path, 30)
    with pytest.raises(SceneError, match="holds a finished training"):
        remove_interrupted(tmp_path)
