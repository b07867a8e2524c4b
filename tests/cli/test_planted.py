"""Files that a stranger put beside the scenes: no command imports, runs or obeys them."""

import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

import pointsplat_ns as ps
from making import normal_scene

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
        "pointsplat_ns/system/workers.py"
    }  # Python itself, without the current folder on its path
