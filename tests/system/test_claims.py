"""Locks: what lies at their paths is neither changed nor followed."""

import os
import threading
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import normal_scene
from pointsplat_ns.cli import main
from pointsplat_ns.system.claims import claim


@pytest.mark.parametrize("there", [True, False])
def test_a_lock_that_is_a_link_is_refused_and_not_followed(there, tmp_path):
    target, lock = tmp_path / "diary.txt", tmp_path / "lock"
    if there:
        target.write_text("precious")
    lock.symlink_to(target)
    with pytest.raises(OSError, match="its lock lock is a link, remove it"), claim(lock):
        pass
    assert target.read_text() == "precious" if there else not target.exists()


def test_a_lock_that_is_a_pipe_or_folder_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(OSError), claim(tmp_path / name, wait=True):
            pass


def test_whoever_waits_for_a_lock_that_is_removed_gets_the_new_one(tmp_path):
    lock, entered, leave = tmp_path / "lock", threading.Event(), threading.Event()

    def second() -> None:
        with claim(lock, wait=True) as held:
            assert held
            entered.set()
            leave.wait(10)

    other = threading.Thread(target=second)
    with claim(lock):
        other.start()
        assert not entered.wait(0.1)
        lock.unlink()
    assert entered.wait(10)
    with claim(lock) as third:  # the file that the second holds is the one at the path
        assert not third
    leave.set()
    other.join()


@pytest.mark.parametrize("kind", ["symbolic", "hard"])
@pytest.mark.parametrize("words", ["prune x.ply --keep 4 --by paper -o o.ply", "convert x.ply o.ply"])
def test_a_planted_lock_of_an_output_does_not_empty_a_file(words, kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ps.save(normal_scene(8), "x.ply")
    Path("diary.txt").write_text("precious")
    if kind == "symbolic":
        Path(".o.ply.lock").symlink_to("diary.txt")
        with pytest.raises(SystemExit):
            main(words.split())
        assert "its lock .o.ply.lock is a link, remove it" in capsys.readouterr().err
    else:
        os.link("diary.txt", ".o.ply.lock")
        main(words.split())
    assert Path("diary.txt").read_text() == "precious"
