"""Outputs: refused, claimed, replaced, interrupted."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from refusing import refusal

import pointsplat_ns as ps
from making import REPOSITORY, ball
from pointsplat_ns.cli import main
from pointsplat_ns.errors import SceneError
from pointsplat_ns.pipeline import repair
from pointsplat_ns.pipeline.repair_state import RepairStateFile
from pointsplat_ns.pruning.merging.cells import Scratch
from pointsplat_ns.system import files, outputs

pytestmark = pytest.mark.usefixtures("quick")

FAILING = (
    "prune damaged.ply -o OUT.ply",
    "compact damaged.ply -o OUT.spz",
    "compact damaged.ply -o small.ply --html OUT.html",
    "convert damaged.ply OUT.sog",
    "info damaged.ply --views OUT.png",
    "render damaged.ply -o OUT.mp4",
    "lod damaged.ply -o OUT",
    "tradeoff damaged.ply -o OUT",
    "render damaged.ply -o OUT",
)
"""Commands that fail at their work, because the scene is damaged, unless they find before that they
cannot write."""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("damaged.ply").write_text("ply")
    return tmp_path


@pytest.mark.parametrize("words", FAILING)
def test_a_place_that_takes_no_files_is_named_before_the_scene_is_read(words, here, capsys):
    words = words.replace("OUT", "damaged.ply/OUT")
    output = next(word for word in words.split() if "OUT" in word)
    assert refusal(capsys, here, *words.split()).startswith(f"error: {output}: cannot be written (")


WRITES = {
    "room_pruned.ply": ("prune", "room.ply", "--keep", "50%", "--by", "opacity"),
    "small.sog": ("compact", "room.ply", "--keep", "50%", "--effort", "instant", "-o", "small.sog"),
    "first.png": ("render", "room.ply", "-o", "first.png", "--width", "16", "--height", "12"),
}
"""Commands by a file that they write."""


@pytest.mark.parametrize("name", WRITES)
def test_an_interrupted_write_leaves_nothing_new_and_what_was_there_stays(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(40, opacity=1.0, bright=1.0), "room.ply")
    Path(name).write_text("from before")
    replace = os.replace

    def interrupted(part, target):
        if Path(target).name == name:
            assert Path(part).stat().st_size > 0, "nothing was written yet"
            raise KeyboardInterrupt
        replace(part, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(SystemExit) as end:
        main([*WRITES[name], "--force"])
    assert end.value.code == 130 and capsys.readouterr().err.endswith("interrupted\n")
    assert Path(name).read_text() == "from before"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


HALF = ("--keep", "50%", "--by", "opacity", "--resolution", "32x24")
COMPACT = ("compact", "room.ply", *HALF, "--effort", "instant")
SMALL = ("--width", "16", "--height", "12")
WORK = {
    "room_pruned.ply": ("prune", "room.ply", *HALF),
    "small.spz": (*COMPACT, "-o", "small.spz"),
    "page.html": (*COMPACT, "--html", "page.html"),
    "pair.png": (*COMPACT, "--picture", "pair.png"),
    "room_clean.ply": ("clean", "room.ply", "--strength", "0", "--resolution", "32x24"),
    "gone.png": ("clean", "room.ply", "--resolution", "32x24", "--picture", "gone.png"),
    "room.splat": ("convert", "room.ply", "room.splat"),
    "own.sog": ("export", "room.ply", "-o", "own.sog"),
    "first.png": ("render", "room.ply", "-o", "first.png", *SMALL),
    "room.mp4": ("render", "room.ply", "--seconds", "0.1", *SMALL),
    "sheet.png": ("info", "room.ply", "--views", "sheet.png", "--resolution", "32x24"),
    "room.rad": ("lod", "room.ply", "--levels", "50%", "-o", "room.rad"),
    "all.html": ("compact", "scenes", *HALF, "--effort", "instant", "--html", "all.html"),
    "all.png": ("compact", "scenes", *HALF, "--effort", "instant", "--picture", "all.png"),
    "demo.ply": ("demo", "-o", "demo.ply"),
    "trade/tradeoff.json": (
        *("tradeoff", "room.ply", "-o", "trade", "--keep", "50%", "--repairs", "none"),
        *("--views", "2", "--resolution", "32x24"),
    ),
    "scenes_compact/1.ply": ("compact", "scenes", *HALF, "--effort", "instant"),
}
"""Commands by a file that they write."""

FOLDERS = {
    "room_lod": ("lod", "room.ply", "--levels", "50%"),
    "stream": ("lod", "room.ply", "--levels", "50%", "--stream", "-o", "stream"),
    "tiles": ("lod", "room.ply", "--levels", "50%", "--tiles", "-o", "tiles"),
    "frames": ("render", "room.ply", "-o", "frames", "--seconds", "0.1", *SMALL),
}
"""Commands by a folder that they write."""


@pytest.fixture()
def scenes(here) -> None:
    """A scene, and a folder of another one."""
    scene = ball(40, opacity=1.0, bright=1.0)
    ps.save(scene, "room.ply")
    ps.save(scene, "scenes/1.ply")


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name.startswith(".")]


def called_before(monkeypatch, module: object, name: str, first: Callable[..., None]) -> None:
    """Let a function of a module be preceded by a call of ``first`` with its arguments."""
    usual = getattr(module, name)

    def both(*arguments):
        first(*arguments)
        return usual(*arguments)

    monkeypatch.setattr(module, name, both)


def without_hard_links(*arguments: object, **options: object) -> None:
    raise PermissionError(1, "Operation not permitted")


@pytest.mark.parametrize(
    ("name", "links"), [*((name, True) for name in WORK), ("room_pruned.ply", False)]
)
def test_a_file_that_appears_during_the_work_stays(name, links, scenes, here, capsys, monkeypatch):
    def appear(path, *_):
        if Path(path).name == Path(name).name:
            Path(name).parent.mkdir(exist_ok=True)
            Path(name).write_text("a stranger's")

    if not links:
        monkeypatch.setattr(os, "link", without_hard_links)
    called_before(monkeypatch, files, "require_space", appear)
    with pytest.raises(SystemExit) as end:
        main([*WORK[name]])
    said = capsys.readouterr()
    assert end.value.code == 1
    assert f"{name}: another file of this name appeared meanwhile" in said.err + said.out
    assert Path(name).read_text() == "a stranger's"
    assert not hidden(here)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_that_appears_during_the_work_stays(name, scenes, here, capsys, monkeypatch):
    taken = {"room_lod": "lod.json", "stream": "lod-meta.json", "tiles": "tileset.json"}
    file = Path(name) / taken.get(name, "frame_00000.png")

    def appear(*_):
        file.parent.mkdir(exist_ok=True)
        file.write_text("a stranger's")

    called_before(monkeypatch, files, "put_folder", appear)
    with pytest.raises(SystemExit) as end:
        main([*FOLDERS[name]])
    assert end.value.code == 1
    assert f"{file}: another file of this name appeared" in capsys.readouterr().err
    assert file.read_text() == "a stranger's" and [*Path(name).iterdir()] == [file]
    assert not hidden(here)


@pytest.mark.parametrize("name", WORK | FOLDERS)
def test_a_second_command_is_refused_at_its_start(name, scenes, here, capsys):
    output = Path(name).parent if name.startswith("scenes_compact") else Path(name)
    claimed = threading.Event()
    ended = threading.Event()

    def work() -> None:
        with outputs.outputs_claimed():
            outputs.claim(output)
            claimed.set()
            ended.wait(60)

    first = threading.Thread(target=work)  # locks of open files do not know of processes
    first.start()
    claimed.wait(60)
    try:
        error = refusal(capsys, here, *(WORK | FOLDERS)[name])
        assert f"{output}: another command is writing it" in error
    finally:
        ended.set()
        first.join()
    assert not hidden(here)


@pytest.mark.parametrize("planted", ["file", "link", "folder", "pipe"])
def test_a_claim_that_a_killed_command_or_a_stranger_left_refuses_nothing(
    planted, scenes, here, capsys
):
    claim = Path(".room_pruned.ply.claim.part")
    Path("secret").write_text("secret")
    plant = {
        "file": claim.touch,
        "link": lambda: claim.symlink_to("secret"),
        "folder": claim.mkdir,
        "pipe": lambda: os.mkfifo(claim),
    }
    plant[planted]()
    main([*WORK["room_pruned.ply"]])
    assert len(ps.load("room_pruned.ply")) == 20
    assert Path("secret").read_text() == "secret"
    assert hidden(here) == ([] if planted in ("file", "pipe") else [here / claim])


def test_a_repair_of_another_version_does_not_continue(tmp_path, monkeypatch):
    monkeypatch.setattr(RepairStateFile, "SECONDS", 0.0)
    scene = ball(4, opacity=1.0, bright=1.0)
    state = dict(scene.items())
    RepairStateFile(tmp_path / "state", scene, "work").save(3, lambda: state)
    assert RepairStateFile(tmp_path / "state", scene, "work").state(state) is not None
    monkeypatch.setattr(ps, "__version__", "0.0.0")
    assert RepairStateFile(tmp_path / "state", scene, "work").state(state) is None


def test_steps_in_cells_stay_after_an_error_only_if_one_was_taken(tmp_path, monkeypatch):
    folder = tmp_path / "cells"
    with pytest.raises(SceneError, match="needs"):
        Scratch(folder, {}, 1 << 62)
    assert not folder.exists()
    with suppress(SystemExit), Scratch(folder, {}).left_if_useful():
        raise SystemExit
    assert not folder.exists()
    scratch = Scratch(folder, {})
    with suppress(SystemExit), scratch.left_if_useful():
        scratch.make("a", lambda: {"a": torch.zeros(1)})
        raise SystemExit
    assert scratch.has("a")


@pytest.mark.skipif(not hasattr(os, "fork") or os.geteuid() != 0, reason="becomes another user")
@pytest.mark.parametrize(
    "check", [lambda path: files.need_writable(path, False), files.need_folder]
)
def test_a_folder_that_takes_no_files_of_an_ordinary_user_is_named(check, here):
    here.chmod(0o555)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setuid(65534)
            check(Path("out"))
        except SceneError as error:
            status = 0 if str(error).startswith("out: cannot be written (") else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert os.listdir() == ["damaged.ply"]


def test_a_command_that_fails_leaves_no_folder_that_it_made(here):
    for words in FAILING:
        with suppress(SystemExit):
            main(words.replace("OUT", "new/folder/OUT").split())
        assert os.listdir() == ["damaged.ply"], words


@pytest.mark.parametrize("options", [(), ("--json",)], ids=["text", "json"])
def test_a_repair_that_is_interrupted_is_written_and_the_status_says_so(
    options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(150, log_size=-1.0, opacity=1.0, bright=1.0), "room.ply")
    steps = repair.optimised

    def interrupted(*arguments):
        yield next(steps(*arguments))
        raise KeyboardInterrupt

    monkeypatch.setattr(repair, "optimised", interrupted)
    with pytest.raises(SystemExit) as end:
        main(
            ["compact", "room.ply", "--keep", "50%", "--by", "opacity", "--seconds", "60", *options]
        )
    out, err = capsys.readouterr()
    assert end.value.code == 130 and err.endswith("interrupted\n")
    assert "room_compact.ply" in out and len(ps.load("room_compact.ply")) == 75


PROCESSES = {
    "room_pruned.ply": ("prune", "room.ply", "--keep", "50%", "--by", "opacity"),
    "room.splat": ("convert", "room.ply", "room.splat"),
    "room_lod": ("lod", "room.ply", "--levels", "50%"),
}
"""Commands of which two are started at once, by what they write."""


@pytest.mark.parametrize("name", PROCESSES)
def test_of_two_processes_with_one_output_only_one_succeeds(name, scenes, here):
    code = "import sys; from pointsplat_ns.start import program; sys.exit(program())"
    command = [sys.executable, "-c", code, *PROCESSES[name]]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    started = [
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        for _ in range(2)
    ]
    errors = [process.communicate()[1] for process in started]
    assert sorted(process.returncode for process in started) == [0, 1], errors
    (refused,) = (
        error for error, process in zip(errors, started, strict=True) if process.returncode
    )
    # Claimed by the other one, written by it before, or put there meanwhile.
    assert "another command is writing it" in refused or "exists already" in refused
    assert not hidden(here)
