"""Folders that replace others: all of their files, or none."""

import os
from pathlib import Path

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.system import outputs
from pointsplat_ns.system.files import replacing_folder

OLD = {"list.json": "old", "a.ply": "old", "b/c.ply": "old"}
NEW = {"list.json": "new", "a.ply": "new", "b/d.ply": "new", "e.ply": "new"}
OURS = r"list\.json|[a-z]\.ply|b"
FOREIGN = {"notes.txt": "a user's"}


def fill(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def held(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write(folder: Path, force: bool = True, named: bool = True) -> None:
    with replacing_folder(folder, "list.json", OURS, force, named) as part:
        fill(part, NEW)


@pytest.mark.parametrize("exchange", [True, False], ids=["at once", "one by one"])
def test_a_folder_of_ours_is_replaced(exchange, tmp_path, monkeypatch):
    if not exchange:
        monkeypatch.setattr(outputs, "_exchanged", lambda *_: False)
    fill(tmp_path / "out", OLD)
    (tmp_path / "out").chmod(0o750)
    write(tmp_path / "out")
    assert held(tmp_path / "out") == NEW
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o750
    assert os.listdir(tmp_path) == ["out"]


def test_files_of_others_in_the_folder_stay(tmp_path):
    fill(tmp_path / "out", OLD | FOREIGN)
    write(tmp_path / "out")
    assert held(tmp_path / "out") == NEW | FOREIGN
    assert os.listdir(tmp_path) == ["out"]


def test_the_current_folder_stays_the_current_folder(tmp_path, monkeypatch):
    fill(tmp_path / "out", OLD)
    monkeypatch.chdir(tmp_path / "out")
    write(Path("."))
    assert held(Path.cwd()) == NEW and held(tmp_path / "out") == NEW


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize("late", [True, False], ids=["after", "before"])
def test_one_by_one_an_interrupt_puts_back_what_was_there(force, late, tmp_path, monkeypatch):
    """After or before each renaming."""
    monkeypatch.setattr(outputs, "_exchanged", lambda *_: False)
    rename = os.rename
    link = os.link
    left = [0]

    def counted(usual, source, target):
        left[0] -= 1
        if left[0] == 0:
            if late:
                usual(source, target)
            raise KeyboardInterrupt
        usual(source, target)

    monkeypatch.setattr(os, "rename", lambda *names: counted(rename, *names))
    monkeypatch.setattr(os, "link", lambda *names: counted(link, *names))
    before = (OLD if force else {}) | FOREIGN
    steps = 0
    done = False
    while not done:
        steps += 1
        folder = tmp_path / f"{steps}" / "out"
        fill(folder, before)
        left[0] = steps
        try:
            write(folder, force)
            done = True
        except KeyboardInterrupt:
            assert held(folder) == before, steps
        assert os.listdir(folder.parent) == ["out"]
    assert held(folder) == NEW | FOREIGN
    assert steps > 4


def test_a_link_in_place_of_a_folder_that_nobody_named_is_refused(tmp_path):
    fill(tmp_path / "user", FOREIGN)
    (tmp_path / "out").symlink_to("user")
    with pytest.raises(SceneError, match="a link to .*, which the command did not name"):
        write(tmp_path / "out", named=False)
    assert held(tmp_path / "user") == FOREIGN
    write(tmp_path / "out")
    assert held(tmp_path / "user") == FOREIGN | NEW
