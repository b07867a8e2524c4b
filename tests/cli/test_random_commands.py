"""Random command lines over odd files (hypothesis, always the same examples) end with a result or with one line."""

import contextlib
import functools
import inspect
import io
import json
import os
import re
import signal
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import COMMANDS, _command, main
from pointsplat_ns.cli.help import STATUSES
from pointsplat_ns.pages.viewer import Viewer

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")

SECONDS = 300
"""Longest time of a command; most take some milliseconds."""

FAST = {
    "compact": "--effort instant",
    "tradeoff": "--keep 10% --views 1 --repairs none",
    "render": "--width 16 --height 12 --seconds 0.1",
}
"""Options that come first, so that a command which can work does not work long."""

LONG = {"train"}
"""Commands that cannot be made short."""

OTHERS = [
    "cameras.json",
    "null.json",
    "deep.json",
    "empty.json",
    "run",
    "sog",
    ".",
    "/dev/zero",
    "/dev/stdin",
    "",
    "no",
]

OUTPUTS = [
    *("out.ply", "new/out.spz", "out.sog", "out.png", "out.html", "out.mp4", "out", ".", "", "-"),
    *("good.ply", "pipe.ply", "folder.ply", "good.ply/out.ply", "/proc/out.ply", "/dev/stdout", "/dev/full"),
    *("x" * 300 + ".ply", "two\nlines.ply", "\x1b[31m.ply", "\udcff.ply"),
]

NUMBERS = ["0", "1", "2", "3", "-1", "0.5", "1e309", "nan", "inf", "-inf", "1_0", "٣"]

VALUES = [
    *NUMBERS,
    *("50%", "5MB", "12kb", "auto", "auto:35", "merge", "opacity", "64x48", "0x0", "-y", "z:-y", "2/1", "shipped"),
    *("", " ", "--", "\x1b]0;x\x07", "🙂"),
]

SPECIALS = ["folder.ply", "loop.ply", "dangling.ply", "pipe.ply", "sparse.splat"]


@functools.cache
def contents() -> dict[str, bytes]:
    """Bytes of odd files by their names."""
    with tempfile.TemporaryDirectory() as folder:
        good = {}
        for suffix in (".ply", ".spz", ".sog", ".splat"):
            path = Path(folder, f"good{suffix}")
            ps.save(ball(30, opacity=1.0, bright=1.0), path)
            good[path.name] = path.read_bytes()
    ply = good["good.ply"]
    camera = {"id": 0, "img_name": "a", "width": 16, "height": 12, "position": [0, 0, -3], "fx": 12, "fy": 12}
    return {
        **good,
        **{f"cut.{name}": data[: len(data) * 2 // 3] for name, data in good.items()},
        **{f"empty.{suffix}": b"" for suffix in ("ply", "spz", "sog", "splat", "ckpt", "safetensors", "json", "yml")},
        **{f"text.{suffix}": b"no scene\n" for suffix in ("ply", "spz", "ckpt", "safetensors", "yml")},
        **{
            name: ply for name in ("a b.ply", "\x1b]0;x\x07.ply", "two\nlines.ply", "ünï🙂.ply", "-o.ply", "\udcff.ply")
        },
        "ply.spz": ply,
        "spz.ply": good["good.spz"],
        "scene.txt": ply,
        "many.ply": re.sub(rb"vertex \d+", b"vertex 999999999999999", ply),
        "none.ply": re.sub(rb"vertex \d+", b"vertex 0", ply),
        "long.ply": ply.replace(b"element", b"comment " + b"x" * (1 << 21) + b"\nelement", 1),
        "cameras.json": json.dumps([{**camera, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}]).encode(),
        "null.json": b"null",
        "deep.json": b"[" * 100_000,
        "run/config.yml": b"!!python/object/apply:os.system ['touch ran']",
        "sog/meta.json": b"{}",
    }


def write_all(folder: Path) -> None:
    for name, data in contents().items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    (folder / "folder.ply").mkdir()
    (folder / "loop.ply").symlink_to("loop.ply")
    (folder / "dangling.ply").symlink_to("nowhere.ply")
    os.mkfifo(folder / "pipe.ply")
    with (folder / "sparse.splat").open("wb") as stream:
        stream.truncate(1 << 40)


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command with files and options, mostly those that it has, with values mostly of the right type."""
    command = draw(st.sampled_from([name for name in COMMANDS if name not in LONG]))
    words = [command, *FAST.get(command, "").split()]
    scenes = st.sampled_from([*contents(), *SPECIALS])
    parameters = inspect.signature(_command(command)).parameters.values()
    for parameter in draw(st.lists(st.sampled_from([*parameters, None]), max_size=4, unique=True)):
        if parameter is not None and not (
            "Positional" in parameter.annotation or parameter.annotation.startswith("options.Scene")
        ):
            name = "json" if parameter.name == "json_output" else parameter.name.replace("_", "-")
            words += [f"--{name}", *draw(values(parameter.name, parameter.annotation))]
        elif parameter is None:
            words.append(draw(st.sampled_from(["--no-such", "--help", "-h", "--no-json", "more.ply"])))
    needed = [p for p in parameters if p.default is p.empty or "Positional" in p.annotation]
    for parameter in needed:
        if parameter.name == "output":
            words += ["-o"] * (command != "convert") + [draw(st.sampled_from(OUTPUTS))]
        elif parameter.default is parameter.empty or draw(st.booleans()):
            words.append(draw(st.one_of(scenes, scenes, st.sampled_from(OTHERS))))
    return words if draw(st.integers(0, 19)) else draw(st.permutations(words))


def values(name: str, kind: str) -> st.SearchStrategy[list[str]]:
    """What follows an option, by its name and the annotation of its parameter."""
    if kind in ("bool", "options.Json", "options.Force", "options.Verbose"):
        return st.just([])
    known = re.findall(r"'([^']+)'", kind)
    words = st.sampled_from(known if known and "Literal" in kind else VALUES)
    if name in ("output", "picture", "html", "plot", "views") and "int" not in kind:
        words = st.sampled_from(OUTPUTS)
    elif "Path" in kind or name in ("poses", "path", "data"):
        words = st.sampled_from([*OTHERS, *contents()])
    elif kind.startswith(("int", "float", "tuple[int", "tuple[float")) or name in ("jobs", "threads"):
        words = st.sampled_from(NUMBERS)
    return st.one_of(words, words, words, st.sampled_from(VALUES)).map(lambda word: [word])


def hangs(number, frame):
    pytest.fail(f"still running after {SECONDS} s")


@pytest.fixture()
def quick(monkeypatch):
    """The viewer ends at once."""
    monkeypatch.setattr(Viewer, "wait", lambda self: None)
    before = signal.signal(signal.SIGALRM, hangs)
    yield
    signal.signal(signal.SIGALRM, before)


@settings(
    max_examples=50,
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(words=command_lines())
def test_random_command_lines_end_with_a_result_or_one_line_and_a_documented_status(quick, words):
    here, status = os.getcwd(), 0
    with tempfile.TemporaryDirectory() as folder:
        write_all(Path(folder))
        os.chdir(folder)
        out, err = io.StringIO(), io.StringIO()
        signal.alarm(SECONDS)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                main(words)
        except SystemExit as end:
            status = end.code or 0
        finally:
            signal.alarm(0)
            os.chdir(here)
        assert not Path(folder, "ran").exists()
    errors = err.getvalue()
    assert status in STATUSES and "Traceback" not in errors, errors
    assert not re.search(r"[^\n\x20-\x7e\xa0-\U0010ffff]", out.getvalue() + errors)
    assert [line.startswith("error: ") for line in errors.splitlines()].count(True) == (status == 1), errors
