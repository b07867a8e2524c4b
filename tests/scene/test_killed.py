"""Writers that are killed at every operation on files, or find the disk full."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.errors import SceneError
from pointsplat_ns.tools.levels.folder import write_levels

pytestmark = [
    pytest.mark.usefixtures("quick"),
    pytest.mark.skipif(not hasattr(os, "fork"), reason="kills processes that it forks"),
]

WORK = """
import os, resource, shutil, signal, sys
from pathlib import Path
import plyfile, torch
import pointsplat_ns as ps
from pointsplat_ns.tools.levels.folder import write_levels

base = here = Path(sys.argv[1])
new = ps.load(base / "new.ply")

def levels(scene, out):
    write_levels(out / "lod", [scene] * 2, {}, [{}, {}], force=True)

WRITERS = {
    "ply": lambda scene, out: ps.save(scene, out / "a.ply", overwrite=True),
    "sog": lambda scene, out: ps.save(scene, out / "a.sog", overwrite=True),
    "levels": levels,
}
EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.chmod")

def child(work):
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os._exit(0)
        except BaseException as error:
            (here / "said.txt").write_text(f"{type(error).__name__}: {error}")
            os._exit(1)
    return pid

def ended(pid):
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])

def killed_at(count, write):
    left = [count]
    def heard(event, args):
        if event in EVENTS and str(here) in str(args[0]):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(heard)
    write(new, here / "out")

def at_every_operation(write):
    count, status = 0, -1
    while status != 0:
        count += 1
        shutil.rmtree(here / "out")
        shutil.copytree(here / "before", here / "out")
        status = ended(child(lambda: killed_at(count, write)))
        assert status in (0, -signal.SIGKILL), status
        shutil.copytree(here / "out", here / f"after-{count}")

def full(write):
    def limited():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        # The limit is for the file alone, and not for what the child says of it.
        resource.setrlimit(resource.RLIMIT_FSIZE, (700, resource.RLIM_INFINITY))
        try:
            write(new, here / "out")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    ended(child(limited))

for here in sorted(base.glob("*/*/")):
    shutil.copytree(here / "before", here / "out")
    {"killed": at_every_operation, "full": full}[here.parent.name](WRITERS[here.name])
"""
"""Does the work of all tests here: forks children of one process that has imported everything,
which takes seconds."""

KINDS = {"killed": ("ply", "levels"), "full": ("ply", "sog")}


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    """A folder with one of each kind for each test, ``before`` and ``out`` in it, and what was
    ``said``."""
    base = tmp_path_factory.mktemp("work")
    ps.save(cloud(50, 1, 0), base / "new.ply")
    for what, kinds in KINDS.items():
        for kind in kinds:
            (out := base / what / kind / "before").mkdir(parents=True)
            if kind == "levels":
                write_levels(out / "lod", [cloud(30, 3, 0)], {}, [{}])
            else:
                ps.save(cloud(30, 3, 0), out / f"a.{kind}")
    alone = {**os.environ, "OMP_NUM_THREADS": "1"}  # what is forked has one thread
    command = [sys.executable, "-c", WORK, str(base)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=alone)
    assert done.returncode == 0, done.stderr
    return base


def shown(folder: Path) -> dict[str, bytes]:
    """The files below a folder, but for what is unfinished, which is hidden."""
    files = {str(path.relative_to(folder)): path for path in folder.rglob("*") if path.is_file()}
    return {
        name: path.read_bytes() for name, path in files.items() if not path.name.startswith(".")
    }


@pytest.mark.parametrize("kind", KINDS["killed"])
def test_a_killed_writer_leaves_the_old_file_or_the_new_one(kind, work):
    before = shown(work / "killed" / kind / "before")
    kills = sorted((work / "killed" / kind).glob("after-*"), key=lambda path: int(path.name[6:]))
    assert len(kills) > 3
    after = shown(kills[-1])
    assert after != before and not [path for path in kills[-1].rglob(".*")]
    unfinished = 0
    for kill in kills[:-1]:
        left = shown(kill)
        unfinished += any(path.name.endswith(".part") for path in kill.rglob(".*"))
        if kind == "levels":  # its parts belong together: this file is there only with all of them
            assert "lod/lod.json" not in left or left in (before, after), kill.name
        else:
            assert all(
                data in (before.get(name), after.get(name)) for name, data in left.items()
            ), kill.name
    assert unfinished > 1


@pytest.mark.parametrize("kind", KINDS["full"])
def test_a_file_beyond_the_size_limit_is_one_error_and_the_old_stays(kind, work):
    place = work / "full" / kind
    said = (place / "said.txt").read_text()
    assert (
        said.startswith(f"SceneError: {place / 'out'}")
        and "cannot be written (File too large)" in said
    )
    assert shown(place / "out") == shown(place / "before") and not list((place / "out").rglob(".*"))


def test_a_disk_without_room_is_told_before_anything_is_written(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=3000))
    path = tmp_path / "a.ply"
    with pytest.raises(
        SceneError, match=r"a\.ply: needs 3\.81 kB, 3\.00 kB are free there, so nothing"
    ):
        ps.save(cloud(50, 1, 0), path)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(total=0, free=0))
    ps.save(cloud(50, 1, 0), path)  # a file system that tells nothing
    assert len(ps.load(path)) == 50
