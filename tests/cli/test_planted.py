"""Files that a stranger put beside the scenes: no command imports, runs or obeys them."""

import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

import pointsplat_ns as ps
from making import ball, normal_scene
from pointsplat_ns.cli import main
from pointsplat_ns.pipeline import repair_budget
from pointsplat_ns.pipeline.repair_state import RepairStateFile
from pointsplat_ns.pruning.merging.cells import Scratch
from pointsplat_ns.scene.discovery import FOLDER_FILES

REPOSITORY = Path(__file__).parents[2]

PLANTED = """import os
with open({log!r}, "a") as log:
    log.write(__name__ + "\\n")
"""

COMMANDS = (
    "compact scenes -o compacted --keep 4 --effort instant --jobs 2 --resolution 32x24",
    "prune scenes/1.ply -o merged.ply --keep 4",  # loads the kernels
)
"""Commands that start processes."""


@pytest.fixture()
def planted(tmp_path) -> Path:
    """A folder of two scenes, and of modules and programs with all names that Python or a command
    might look for. Each writes its name to the file ``../log``."""
    folder = tmp_path / "stranger"
    log = str(tmp_path / "log")
    for name in ("1", "2"):
        ps.save(normal_scene(8), folder / "scenes" / f"{name}.ply")
    modules = {
        "torch",
        "numpy",
        "scipy",
        "plyfile",
        "kornia",
        "tyro",
        "rich",
        "PIL",
        "yaml",
        "nerfstudio",
        "av",
    }
    modules |= {
        "pointsplat_ns",
        "method_configs",
        "sitecustomize",
        "usercustomize",
        "safetensors",
        "psutil",
    }
    for name in modules | sys.stdlib_module_names:
        (folder / f"{name}.py").write_text(PLANTED.format(log=log))
    programs = folder / "node_modules" / ".bin"
    programs.mkdir(parents=True)
    names = (
        "c++",
        "g++",
        "clang++",
        "cc1plus",
        "as",
        "ld",
        "git",
        "npx",
        "splat-transform",
        "ns-train",
        "ffmpeg",
    )
    for path in (place / name for place in (folder, programs) for name in names):
        path.write_text(f"#!/bin/sh\necho program {path.name} >> {log}\nexit 1\n")
        path.chmod(0o755)
    return folder


def pointsplat(folder: Path, words: str) -> subprocess.CompletedProcess[str]:
    """Run the program as pip installs it: a script in a folder of its own."""
    script = folder.parent / "bin" / "pointsplat"
    script.parent.mkdir(exist_ok=True)
    script.write_text(
        f"#!{sys.executable}\nfrom pointsplat_ns.start import program\nif __name__ == "
        "'__main__':\n    program()\n"
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(
        [sys.executable, script, *words.split()],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize("words", COMMANDS)
def test_nothing_in_the_current_folder_is_imported_or_run(words, planted):
    done = pointsplat(planted, words)
    assert done.returncode == 0, done.stderr
    log = planted.parent / "log"
    assert not log.exists(), sorted(set(log.read_text().splitlines()))


def test_a_matplotlibrc_of_the_current_folder_is_not_obeyed(planted):
    (planted / "matplotlibrc").write_text("figure.facecolor: red\nsavefig.facecolor: red\n")
    assert (
        pointsplat(planted, "clean scenes/1.ply --resolution 32x24 --picture gone.png").returncode
        == 0
    )
    with Image.open(planted / "gone.png") as picture:
        assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_each_place_that_starts_processes_is_known():
    """Who adds one looks at what the current folder can do to it, and at ``COMMANDS`` above."""
    modules = r"subprocess|multiprocessing|concurrent.futures.process|pty|asyncio"
    calls = r"os\.(system|popen|fork|posix_spawn|exec[lv]|spawn)"
    starts = re.compile(rf"^ *(import|from) ({modules})\b|\b{calls}", re.MULTILINE)
    paths = [
        *(REPOSITORY / "pointsplat_ns").rglob("*.py"),
        *(REPOSITORY / "method_configs").rglob("*.py"),
    ]
    found = {
        str(path.relative_to(REPOSITORY))
        for path in paths
        if starts.search(path.read_text("utf-8"))
    }
    assert found == {
        "pointsplat_ns/system/cluster.py",  # asyncio, for a connection alone
        "pointsplat_ns/system/workers.py",  # Python itself, without the current folder on its path
    }


HALF = ("--keep", "50%", "--by", "opacity", "--resolution", "32x24")
FOLDER = ("compact", "scenes", *HALF, "--effort", "instant", "--picture", "all.png", "--force")

LINKS = {
    "room_pruned.ply": ("prune", "room.ply", *HALF, "--force"),
    "room_clean.ply": ("clean", "room.ply", "--strength", "0", "--force"),
    "room_web.html": ("compact", "room.ply", "--for", "web", "--effort", "instant", "--force"),
    "room.mp4": (
        *("render", "room.ply", "--width", "16", "--height", "12"),
        "--seconds",
        "0.1",
        "--force",
    ),
    "room_tradeoff/tradeoff.html": (
        *("tradeoff", "room.ply", "--keep", "50%", "--repairs", "none"),
        *("--views", "2", "--resolution", "32x24", "--force"),
    ),
    "room_lod/level_0.ply": ("lod", "room.ply", "--levels", "50%", "--force"),
    "room_stream/0_0/meta.json": ("lod", "room.ply", "--levels", "50%", "--stream", "--force"),
    "room_tiles/tileset.json": ("lod", "room.ply", "--levels", "50%", "--tiles", "--force"),
    "scenes_compact/1.ply": FOLDER,
    "scenes_compact/1.ply.json": FOLDER,
    "scenes_compact/1.ply.png": FOLDER,
    f"scenes_compact/{FOLDER_FILES.scenes}": FOLDER,
    f"scenes_compact/{FOLDER_FILES.scenes_table}": FOLDER,
    ".room_compact.ply.unfinished": ("compact", "room.ply", *HALF, "--force"),
}
"""Commands by a file that they write, or remove, and that nobody named."""


@pytest.fixture()
def secret(tmp_path, monkeypatch) -> Path:
    """A user's file outside of the current folder, which has a scene, and a folder of another."""
    path = tmp_path / "secret"
    path.write_text("secret")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    scene = ball(150, log_size=-1.0, opacity=1.0, bright=1.0)
    ps.save(scene, "room.ply")
    ps.save(scene, "scenes/1.ply")
    return path


@pytest.mark.parametrize("name", LINKS)
def test_nothing_is_written_or_removed_through_a_link_that_nobody_named(name, secret, monkeypatch):
    monkeypatch.setattr(RepairStateFile, "SECONDS", 0.0)  # the state of a repair is written at once
    monkeypatch.setitem(repair_budget.STEPS, "quick", 4)
    link = Path(name)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(secret)
    main([*LINKS[name]])
    assert secret.read_text() == "secret"
    assert not link.is_symlink()


@pytest.mark.parametrize("name", [name for name in LINKS if "/" in name])
def test_no_folder_that_nobody_named_is_a_link(name, secret, capsys):
    user = secret.with_name("user")
    user.mkdir()
    folder = Path(name).parts[0]
    Path(folder).symlink_to(user)
    with pytest.raises(SystemExit) as end:
        main([*LINKS[name]])
    assert end.value.code == 1
    assert f"{folder}: a link to {user}" in capsys.readouterr().err
    assert list(user.iterdir()) == []


def test_a_folder_of_results_has_no_links_in_it(secret, capsys):
    user = secret.with_name("user")
    user.mkdir()
    shutil.copytree("scenes", "scenes/more")
    Path("scenes_compact").mkdir()
    Path("scenes_compact/more").symlink_to(user)
    with pytest.raises(SystemExit) as end:
        main([*FOLDER])
    assert end.value.code == 1 and "1 of 2 scenes failed" in capsys.readouterr().err
    assert list(user.iterdir()) == []


def test_a_result_with_its_record_is_not_replaced_through_a_link(secret, capsys):
    words = [word for word in FOLDER if word != "--force"]
    main(words)
    shutil.move("scenes_compact/1.ply", secret)
    Path("scenes_compact/1.ply").symlink_to(secret)
    before = secret.read_bytes()
    ps.save(ball(60, opacity=1.0, bright=1.0), "scenes/1.ply", overwrite=True)
    with pytest.raises(SystemExit):
        main(words)
    assert "1.ply: exists already" in capsys.readouterr().out
    main([*FOLDER])
    assert secret.read_bytes() == before
    assert len(ps.load("scenes_compact/1.ply")) == 30


def test_the_state_of_a_repair_is_not_read_through_a_link(secret, monkeypatch):
    monkeypatch.setattr(RepairStateFile, "SECONDS", 0.0)
    scene = normal_scene(8)
    state = dict(scene.items())
    RepairStateFile(secret, scene, "work").save(3, lambda: state)
    assert RepairStateFile(secret, scene, "work").state(state) is not None
    link = Path(".room_compact.ply.unfinished")
    link.symlink_to(secret)
    assert RepairStateFile(link, scene, "work").state(state) is None


@pytest.mark.parametrize("planted", ["folder", "step"])
def test_steps_of_merging_in_cells_are_not_read_or_written_through_a_link(planted, secret):
    folder = Path(".room_pruned.ply.cells")
    scene = dict(normal_scene(8).items())
    user = secret.with_name("user")
    made = Scratch(user, {"work": 1}).tensors("a", lambda: scene)
    before = {path.name: path.read_bytes() for path in user.iterdir()}
    if planted == "folder":
        folder.symlink_to(user)
    else:
        shutil.copytree(user, folder)
        (folder / "a.safetensors").unlink()
        (folder / "a.safetensors").symlink_to(user / "a.safetensors")
    other = {name: 0 * value for name, value in made.items()}
    assert all(
        not bool(value.any())
        for value in Scratch(folder, {"work": 1}).tensors("a", lambda: other).values()
    )
    assert {path.name: path.read_bytes() for path in user.iterdir()} == before
