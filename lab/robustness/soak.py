"""Long runs: does memory grow, are handles left, does work slow down?

    python -m lab.robustness.soak training --minutes 60 --json training.json
    python -m lab.robustness.soak rendering --minutes 60 --json rendering.json
    python -m lab.robustness.soak viewer --minutes 60 --json viewer.json

Each watches a process of its own from outside: its memory, open files and sockets, threads, and CPU seconds for a unit
of its work, which other programs on the machine stretch less than seconds. Printed are medians over the first and the
last quarter of the time, without a tenth at the beginning.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from email.message import Message
from pathlib import Path
from statistics import median
from typing import Literal

import psutil
import tyro

import pointsplat_ns as ps
from lab.common.printing import markdown, start
from lab.common.results import write_json
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.commands import train_scene_command
from pointsplat_ns.rooms import write_room

What = Literal["training", "rendering", "viewer"]

WARM = 0.1
"""Share of the time at the beginning that is left out."""

PORT = "7351"

RENDER = """
import itertools, sys
import pointsplat_ns as ps
room = ps.load(sys.argv[1])
for done, view in enumerate(itertools.cycle(ps.sample_views(room, 6)), 1):
    ps.render(room, view)
    print(done, flush=True)
"""


@dataclass(frozen=True)
class Sample:
    """A look at the process."""

    seconds: float  # since it was started
    mebibytes: float
    handles: int
    threads: int
    cpu: float  # seconds, so far
    done: int  # units of work, so far


class Watched:
    """A process, and the number of units of work that it has said it did."""

    def __init__(self, words: list[str], counts: str | None):
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        self.process = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment, errors="replace"
        )
        self.done, self.last = 0, ""
        self._counts = counts
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.last = line.strip() or self.last
            if self._counts is not None and (found := re.search(self._counts, line)):
                self.done = int(found[1])

    def sample(self, seconds: float) -> Sample | None:
        """How the process is now; None while it starts.

        Raises:
            PointSplatError: if it has ended.
        """
        if self.process.poll() is not None:
            raise PointSplatError(f"it ended with status {self.process.returncode}: {self.last}")
        seen = psutil.Process(self.process.pid)
        cpu, memory = seen.cpu_times(), seen.memory_info().rss / 2**20
        sample = Sample(seconds, memory, seen.num_fds(), seen.num_threads(), cpu.user + cpu.system, self.done)
        return sample if self.done else None


def report(what: str, samples: list[Sample]) -> str:
    """Medians over the first and the last quarter, as a Markdown table.

    Raises:
        PointSplatError: if there are too few samples.
    """
    samples = samples[round(WARM * len(samples)) :]
    quarter = len(samples) // 4
    if quarter < 2:
        raise PointSplatError(f"{len(samples)} looks at the process; expected at least 8: take more minutes")
    parts = samples[:quarter], samples[-quarter:]
    names = {"mebibytes": "memory, MiB", "handles": "open files and sockets", "threads": "threads"}
    rows = [
        [f"{what}: {name}", *(f"{median(getattr(sample, field) for sample in part):.0f}" for part in parts)]
        for field, name in names.items()
    ]
    cost = [1000 * (part[-1].cpu - part[0].cpu) / max(1, part[-1].done - part[0].done) for part in parts]
    rows.append([f"{what}: CPU ms a unit", *(f"{value:.1f}" for value in cost)])
    title = f"{what}, {samples[-1].seconds / 3600:.2f} h, {samples[-1].done:,} units"
    return markdown([title, "first quarter", "last quarter"], rows)


@contextmanager
def started(what: What, folder: Path, side: int) -> Iterator[Watched]:
    """The process, which is interrupted at the end."""
    room = folder / "room.ply"
    ps.save(ps.example_room()[::4], room)
    stop = threading.Event()
    if what == "training":
        write_room(folder / "room", 1, 24, side, 3 * side // 4)
        options = {"pipeline.model.stop-split-at": 1000, "scale-schedules": "False", "steps-per-save": 500}
        words = train_scene_command(folder / "room", folder, "soak", 10**7, "t", 4000, options).split()
        watched = Watched(_console(words), r"^\W*(\d+) \(\d+\.\d+%\)")
    elif what == "rendering":
        watched = Watched([sys.executable, "-c", RENDER, str(room)], r"^(\d+)$")
    else:
        watched = Watched(_console(["pointsplat", "view", str(room), "--port", PORT]), None)
        threading.Thread(target=_move, args=(watched, f"http://127.0.0.1:{PORT}", stop), daemon=True).start()
    try:
        yield watched
    finally:
        stop.set()
        watched.process.send_signal(signal.SIGINT)
        try:
            watched.process.wait(60)
        except subprocess.TimeoutExpired:
            watched.process.kill()
            watched.process.wait()


def _console(words: list[str]) -> list[str]:
    """A command of this environment."""
    return [str(Path(sys.executable).parent / words[0]), *words[1:]]


def _move(watched: Watched, url: str, stop: threading.Event) -> None:
    """A page's part: moves a camera twice a second, counts the pictures that come, goes and comes again."""
    step = 0
    while not stop.is_set():
        client, look, number = f"soak {time.monotonic_ns():020}", 0, 0
        try:
            for look in range(60):
                step += 1
                eye = [0.3 * (step % 7), 0.2 * (step % 5), 1.2]
                camera = {"eye": eye, "right": [1, 0, 0], "down": [0, 0, -1], "ahead": [0, 1, 0], "fov": 1.2}
                window = {"width": 960, "height": 720, "wipe": 1, "kept": [100]}
                _post(url, "/look", {"client": client, "stage": 1, "camera": camera, "look": look, **window})
                end = time.monotonic() + 0.5
                while time.monotonic() < end and not stop.is_set():
                    waits = {"client": client, "stage": 1, "number": number, "texts": 0}
                    state = json.loads(_post(url, "/picture", waits)["X-State"])
                    watched.done += state["number"] != number
                    number = state["number"]
                    if state["look"] == look:
                        time.sleep(max(end - time.monotonic(), 0))
        except OSError:
            time.sleep(1)  # it has not started yet


def _post(url: str, path: str, values: dict) -> Message:
    """Send a request as the viewer's page does; the headers of the answer."""
    request = urllib.request.Request(url + path, json.dumps(values).encode(), {"Origin": url})
    with urllib.request.urlopen(request, timeout=60) as answer:
        answer.read()
        return answer.headers


def main(
    what: tyro.conf.Positional[What], minutes: float = 60, every: float = 10, side: int = 96, json: Path | None = None
) -> None:
    """Watch one kind of work for some time.

    Args:
        what: training of a small room, drawing the room that ships, or its viewer with a client that moves about, goes
            and comes again each half minute.
        minutes: how long.
        every: seconds between two looks.
        side: width of the training's photos, pixels.
        json: all samples go there, after each look.
    """
    samples: list[Sample] = []
    with tempfile.TemporaryDirectory() as folder, started(what, Path(folder), side) as watched:
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < 60 * minutes:
            if (sample := watched.sample(now)) is not None:
                samples.append(sample)
            write_json(json, {"what": what, "minutes": now / 60, "samples": [asdict(s) for s in samples]})
            time.sleep(every)
    print(report(what, samples))


if __name__ == "__main__":
    start(main)
