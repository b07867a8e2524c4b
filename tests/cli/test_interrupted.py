"""Ctrl-C and SIGTERM: the command and all that it started end at once, with the usual status, and leave nothing."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main
from pointsplat_ns.compression import repair

HEEDED = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
"""
"""Where the tests run in the background of a shell or by nohup, SIGINT or SIGHUP is ignored, also by what they start,
unless told otherwise."""


ROOMS = """
import sys
from pathlib import Path
from pointsplat_ns.cli import main
from pointsplat_ns.rooms import write

here, render = Path(sys.argv[1]), write.render_room
def noted(*arguments):
    (here / "0.pid").touch()
    return render(*arguments)
write.render_room = noted
main(["rooms", "-o", str(here / "rooms"), "--seeds", "0", "--frames", "500", "--width", "96", "--height", "64"])
"""


WRITES = {
    "room_pruned.ply": ("prune", "room.ply", "--keep", "50%", "--by", "opacity"),
    "room.spz": ("convert", "room.ply", "room.spz"),
    "room.compressed.ply": ("convert", "room.ply", "room.compressed.ply"),
    "meta.json": ("convert", "room.ply", "meta.json"),
    "small.sog": ("compact", "room.ply", "--keep", "50%", "--effort", "instant", "-o", "small.sog"),
    "seen.png": ("prune", "room.ply", "--keep", "50%", "--by", "opacity", "--dry-run", "--plot", "seen.png"),
    "first.png": ("render", "room.ply", "-o", "first.png", "--width", "16", "--height", "12"),
}
"""Commands by a file that they write."""


@pytest.fixture()
def start(tmp_path):
    """A function that starts a script in a process group of its own and waits until ``count`` trainings run."""
    started: list[subprocess.Popen[str]] = []

    def run(script: str, count: int) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", HEEDED + script, str(tmp_path)],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        deadline = time.monotonic() + 120
        while len(list(tmp_path.glob("*.pid"))) < count:
            assert process.poll() is None, process.communicate()[1]
            assert time.monotonic() < deadline, "nothing started"
            time.sleep(0.05)
        return process

    yield run
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize("name", WRITES)
def test_what_is_interrupted_while_it_is_written_is_not_there_and_what_was_there_stays(
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
    if name == "meta.json":  # in the middle of putting several files in place: parts of two scenes are no scene
        assert not Path(name).exists()
    else:
        assert Path(name).read_text() == "from before"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("options", [(), ("--json",)], ids=["text", "json"])
def test_a_repair_that_is_interrupted_is_written_and_the_status_says_so(options, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(150, log_size=-1.0, opacity=1.0, bright=1.0), "room.ply")
    steps = repair.optimised

    def interrupted(*arguments):
        yield next(steps(*arguments))
        raise KeyboardInterrupt

    monkeypatch.setattr(repair, "optimised", interrupted)
    with pytest.raises(SystemExit) as end:
        main(["compact", "room.ply", "--keep", "50%", "--by", "opacity", "--seconds", "60", *options])
    out, err = capsys.readouterr()
    assert end.value.code == 130 and err.endswith("interrupted\n")
    assert "room_compact.ply" in out and len(ps.load("room_compact.ply")) == 75


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_room_that_is_interrupted_leaves_nothing(start, tmp_path, number, status):
    process = start(ROOMS, count=1)
    process.send_signal(number)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == status, errors
    assert "Traceback" not in errors
    assert list((tmp_path / "rooms").iterdir()) == []
