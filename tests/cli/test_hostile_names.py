"""Names of files that steer a terminal: what is printed shows their characters and sends none."""

import ast
import io
import json
import re
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from unittest import mock

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main
from pointsplat_ns.nerfstudio_plugin.console import CONSOLE, log
from pointsplat_ns.system.progress import progress_bar
from pointsplat_ns.system.terminal import print_table, say

ORDERS = "x\x1b[9A\x1b[2K\x1b[31mwiped\x9b2J\r\n\x07\u202e[bold]"
"""Moves up, wipes a line, and so on; with a line break, a character that turns text round, and
markup of rich's."""
SHOWN = r"x\x1b[9A\x1b[2K\x1b[31mwiped\x9b2J\r\n\x07\u202e[bold]"

PACKAGE = Path(ps.__file__).parent


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(params=[False, True], ids=["pipe", "terminal"])
def printed(request, monkeypatch) -> Callable[[Callable[[], object]], str]:
    """What a call prints to standard output and standard error, of a pipe or a terminal."""
    monkeypatch.setenv("TERM", "xterm-256color")

    def run(call: Callable[[], object]) -> str:
        stream = Terminal() if request.param else io.StringIO()
        with redirect_stdout(stream), redirect_stderr(stream), suppress(SystemExit):
            call()
        return stream.getvalue()

    return run


def need_shown(text: str, whole: bool = True) -> None:
    """No order of the name is in a text that was printed, and the name is."""
    for order in ("\x1b[9A\x1b[2K", "\x1b[31mwiped", "\x9b", "\x07", "\u202e", "wiped\\x9b2J\r"):
        assert order not in text, repr(text)
    if whole:
        assert SHOWN in text.replace("\n", ""), repr(text)


@pytest.fixture()
def scene(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    ps.save(ball(40, opacity=1.0, bright=1.0), Path(f"{ORDERS}.ply"))
    return f"{ORDERS}.ply"


@pytest.mark.parametrize(
    "words",
    [
        "info {scene}",
        "info {scene} {scene}",
        "info {orders}",
        "info --{orders}",
        "{orders}",
        "prune {scene} --by opacity --keep 50% --poses none",
        "prune {scene} --by opacity --keep {orders}",
        "convert {scene} {orders}.spz",
        "convert {scene} {orders}.txt",
        "lod {scene} --levels 50%",
        "view {orders}",
    ],
)
def test_no_command_sends_what_a_name_orders(words, scene, printed):
    each = [word.format(scene=scene, orders=ORDERS) for word in words.split()]
    text = printed(lambda: main(each))
    assert "wiped" in text or "x\\x1b" in text
    need_shown(text, whole=False)


@pytest.mark.parametrize(
    "words", ["info {scene}", "prune {scene} --by opacity --keep 50% --poses none"]
)
def test_a_result_shows_the_whole_name(words, scene, capsys):
    main([word.format(scene=scene) for word in words.split()])
    text = "".join(capsys.readouterr())
    need_shown(text.replace(".ply", "").replace("_pruned", ""))


def test_lines_tables_and_progress_show_names(printed):
    need_shown(printed(lambda: say(ORDERS)))
    table = printed(lambda: print_table([ORDERS], [[ORDERS]], caption=ORDERS, title=ORDERS))
    need_shown(table, whole=False)

    def work() -> None:
        with progress_bar() as show:
            show(ORDERS, 0.1)
            show(ORDERS, 0.5)

    monotonic = iter(range(0, 10**6, 40)).__next__
    with mock.patch("pointsplat_ns.system.progress.time.monotonic", monotonic):
        text = printed(work)
    assert "wiped" in text
    need_shown(text, whole=False)


def test_the_log_of_trainings_shows_names():
    with CONSOLE.capture() as captured:
        log(ORDERS)
    text = captured.get()
    assert "[bold]" in text
    need_shown(text, whole=False)


def test_json_has_the_name_itself(scene, capsys):
    main(["info", scene, "--json"])
    text = capsys.readouterr().out
    assert json.loads(text)["file"] == scene
    need_shown(text, whole=False)


def test_nothing_else_in_the_package_prints():
    """Who prints takes ``say``, ``print_table``, the package's log or, in plugins, ``log``."""
    doors = {"system/terminal.py", "system/progress.py", "cli/printing.py", "start.py"}
    doors |= {"nerfstudio_plugin/console.py"}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and re.fullmatch(
                r"print|CONSOLE\.(log|print)|console\.print|sys\.std(out|err)\.write",
                ast.unparse(node.func),
            ):
                found.add(path.relative_to(PACKAGE).as_posix())
    assert found <= doors
