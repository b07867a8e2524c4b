"""Long runs: does memory grow, are handles left, does work slow down?

    python benchmarks/soak.py training --minutes 60 --json training.json
    python benchmarks/soak.py rendering --minutes 60 --json rendering.json
    python benchmarks/soak.py viewer --minutes 60 --json viewer.json

Each watches a process of its own from outside: its memory, open files and sockets, threads, and CPU seconds for a unit
of its work, which other programs on the machine stretch less than seconds. Printed are medians over the first and the
last quarter of the time, without a tenth at the beginning.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Literal

import psutil
import tyro
from options import write_whole

import pointsplat_ns as ps
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.commands import train_scene_command
from pointsplat_ns.rooms import write_room

What = Literal["training", "rendering", "viewer"]

WARM = 0.1
"""Share of the time at the beginning that is left out."""

RENDER = """
import sys
import pointsplat_ns as ps
room = ps.load(sys.argv[1])
views = ps.sample_views(room, 6)
done = 0
while True:
    for view in views:
        ps.render(room, view)
        done += 1
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

    def __init__(self, words: list[str], counts: re.Pattern[str] | None):
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
            if self._counts is not None and (found := self._counts.search(line)):
                self.done = int(found[1])

    def sample(self, start: float) -> Sample:
        """How the process is now.

        Raises:
            PointSplatError: if it has ended.
        """
        if self.process.poll() is not None:
            raise PointSplatError(f"it ended with status {self.process.returncode}: {self.last}")
        seen = psutil.Process(self.process.pid)
        cpu = seen.cpu_times()
        return Sample(
            time.monotonic() - start, seen.memory_info().rss / 2**20, seen.num_fds(), seen.num_threads(),
            cpu.user + cpu.system, self.done,
        )  # fmt: skip


def soak(
    what: tyro.conf.Positional[What],
    minutes: float = 60,
    every: float = 10,
    side: int = 96,
    json_file: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Watch one kind of work for some time.

    Args:
        what: training of a small room, drawing the room that ships, or its viewer with a client that moves about, goes
            and comes again each half minute.
        minutes: how long.
        every: seconds between two looks.
        side: width of the training's photos, pixels.
        json_file: all samples go there, after each look.
    """
    with tempfile.TemporaryDirectory() as folder, _started(what, Path(folder), side) as watched:
        start, samples = time.monotonic(), []
        while (now := time.monotonic() - start) < 60 * minutes:
            if watched.done:  # it works, not only starts
                samples.append(watched.sample(start))
            elif watched.process.poll() is not None:
                raise PointSplatError(f"it ended with status {watched.process.returncode}: {watched.last}")
            write_whole(json_file, {"what": what, "minutes": now / 60, "samples": [asdict(s) for s in samples]})
            time.sleep(every)
    for line in report(what, samples):
        print(line)


def report(what: str, samples: list[Sample]) -> list[str]:
    """Medians over the first and the last quarter, a Markdown row each.

    Raises:
        PointSplatError: if there are too few samples.
    """
    samples = samples[round(WARM * len(samples)) :]
    quarter = len(samples) // 4
    if quarter < 2:
        raise PointSplatError(f"{len(samples)} looks at the process; expected at least 8: take more minutes")
    first, last = samples[:quarter], samples[-quarter:]

    def row(name: str, of: Callable[[list[Sample]], float], form: str) -> str:
        return f"| {what}: {name} | {of(first):{form}} | {of(last):{form}} |"

    def cost(part: list[Sample]) -> float:
        return 1000 * (part[-1].cpu - part[0].cpu) / max(1, part[-1].done - part[0].done)

    done, hours = samples[-1].done, samples[-1].seconds / 3600
    return [
        f"| {what}, {hours:.2f} h, {done:,} units | first quarter | last quarter |",
        "|---|---|---|",
        row("memory, MiB", lambda part: median(s.mebibytes for s in part), ".0f"),
        row("open files and sockets", lambda part: median(s.handles for s in part), ".0f"),
        row("threads", lambda part: median(s.threads for s in part), ".0f"),
        row("CPU ms a unit", cost, ".1f"),
    ]


@contextmanager
def _started(what: What, folder: Path, side: int) -> Iterator[Watched]:
    """The process, which is interrupted at the end."""
    room = folder / "room.ply"
    ps.save(ps.example_room()[::4], room)
    stop = threading.Event()
    if what == "training":
        write_room(folder / "room", 1, 24, side, 3 * side // 4)
        options = {"pipeline.model.stop-split-at": 1000, "scale-schedules": "False", "steps-per-save": 500}
        words = train_scene_command(folder / "room", folder, "soak", 10**7, "t", 4000, options).split()
        watched = Watched(_console(words), re.compile(r"^\W*(\d+) \(\d+\.\d+%\)"))
    elif what == "rendering":
        watched = Watched([sys.executable, "-c", RENDER, str(room)], re.compile(r"^(\d+)$"))
    else:
        watched = Watched(_console(["pointsplat", "view", str(room), "--port", "7351"]), None)
        threading.Thread(target=_move, args=(watched, "ws://127.0.0.1:7351", stop), daemon=True).start()
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
    import msgspec
    from viser._messages import ViewerCameraMessage
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    step = 0
    while not stop.is_set():
        try:
            with connect(url, max_size=None) as socket:
                for _ in range(60):
                    if stop.is_set():
                        return
                    step += 1
                    place = (0.3 * (step % 7), 0.2 * (step % 5), 1.2)
                    message = ViewerCameraMessage((1.0, 0, 0, 0), place, 1.0, 4 / 3, (0.0, 0, 0), (0.0, 0, 1))
                    socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))
                    end = time.monotonic() + 0.5
                    while (left := end - time.monotonic()) > 0:
                        try:
                            data = socket.recv(timeout=left)
                        except TimeoutError:
                            break
                        watched.done += str(data).count("BackgroundImageMessage")
        except (OSError, WebSocketException):
            time.sleep(1)  # it has not started yet


def main() -> None:
    """Run; what goes wrong ends it with one line."""
    try:
        tyro.cli(soak)
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
