"""Writers that are killed at every operation on files, or find the disk full."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats.sog_stream import Node, write_sog_stream
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
from pointsplat_ns.scene.formats.sog_stream import Node, write_sog_stream
from pointsplat_ns.tools.levels.folder import write_levels

base = here = Path(sys.argv[1])
new = ps.load(base / "new.ply")

def levels(scene, out):
    write_levels(out / "lod", [scene] * 2, {}, [{}, {}], force=True)

def stream(scene, out):
    rows = torch.arange(len(scene))
    path = out / "stream" / "lod-meta.json"
    write_sog_stream([scene] * 2, Node(rows=(rows, rows)), path, 100)

WRITERS = {
    "ply": lambda scene, out: ps.save(scene, out / "a.ply", overwrite=True),
    "sog": lambda scene, out: ps.save(scene, out / "a.sog", overwrite=True),
    "new": lambda scene, out: ps.save(scene, out / "b.ply"),
    "levels": levels,
    "stream": stream,
}
EVENTS = ("open", "os.rename", "os.link", "os.listdir", "os.mkdir", "os.chmod")
EVENTS += ("os.remove", "os.rmdir", "shutil.rmtree")

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

KINDS = {"killed": ("ply", "new", "levels", "stream"), "full": ("ply", "sog")}


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
                write_levels(out / "lod", [cloud(30, 3, 0)] * 3, {}, [{}] * 3)
            elif kind == "stream":
                rows = torch.arange(30)
                path = out / "stream" / "lod-meta.json"
                write_sog_stream([cloud(30, 3, 0)], Node(rows=(rows,)), path, 100)
            elif kind == "new":
                ps.save(cloud(30, 3, 0), out / "a.ply")
            else:
                ps.save(cloud(30, 3, 0), out / f"a.{kind}")
    alone = {**os.environ, "OMP_NUM_THREADS": "1"}  # what is forked has one thread
    command = [sys.executable, "-c", WORK, str(base)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=alone)
    assert done.returncode == 0, done.stderr
    return base


def shown(folder: Path) -> dict[str, bytes]:
    """The files below a folder, but for what is unfinished, which is hidden."""
    files = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    return {
        str(name): path.read_bytes()
        for name, path in files.items()
        if not any(part.startswith(".") for part in name.parts)
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
        assert left in (before, after), kill.name
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
