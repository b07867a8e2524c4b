"""The documentation and the examples of ``--help``: their code, and the parsers of the programs
that it names."""

import functools
import importlib.metadata
import inspect
import re
import runpy
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
import tyro

from pointsplat_ns.api import EXAMPLE
from pointsplat_ns.cli import main
from pointsplat_ns.cli.help import EXAMPLES

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "lab" / "README.md",
    EXAMPLE.with_name("README.md"),
    *sorted((ROOT / "docs").rglob("*.md")),
]
NS_PROGRAMS = ("ns-train", "ns-eval", "ns-render", "ns-export", "ns-viewer")


class Block(NamedTuple):
    """A fenced block of code."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


class Command(NamedTuple):
    """One command line."""

    where: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.where} {shlex.join(self.words)}"


def blocks_of(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, also those indented in a list."""
    text = page.read_text("utf-8")
    assert len(re.findall(r"^ *```", text, re.MULTILINE)) % 2 == 0, f"{page}: a block does not end"
    for found in re.finditer(r"^( *)```(\w*)\n(.*?)^ *```$", text, re.MULTILINE | re.DOTALL):
        lines = [line.removeprefix(found[1]) for line in found[3].splitlines()]
        yield Block(page, text.count("\n", 0, found.start(3)) + 1, found[2], "\n".join(lines))


def commands_of(block: Block) -> Iterator[Command]:
    """The command lines of a block, without comments and without settings of the environment before
    them."""
    for line in block.text.replace("\\\n", " ").splitlines():
        words = shlex.split(re.sub(r"^([A-Z_]+=\S* )+", "", line), comments=True)
        if words:
            yield Command(block.where, tuple(words))


def inline_code() -> Iterator[tuple[Path, str]]:
    """The code within lines of text."""
    for page in PAGES:
        text = re.sub(
            r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE
        )
        for code in re.findall(r"`([^`\n]+)`", text):
            yield page, code


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
EVERY = [
    *(command for block in BLOCKS if block.language == "bash" for command in commands_of(block)),
    *(
        Command(page.name, (*shlex.split(code),))
        for page, code in inline_code()
        if page == PAGES[0] and " " in code
    ),
    *(
        Command(f"pointsplat {name} --help", (*shlex.split(text),))
        for name in EXAMPLES
        for _, text in EXAMPLES[name]
    ),
]
COMMANDS = [*{command.words: command for command in reversed(EVERY)}.values()]
"""Each command line once, where it is shown first."""


class Parsed(BaseException):
    """Raised in place of what a program would do with its arguments."""


def without_body(function: Callable) -> Callable:
    """A function of the same signature and help that does nothing."""

    @functools.wraps(function)
    def nothing(*args: object, **options: object) -> None:
        raise Parsed

    return nothing


@contextmanager
def parsers_only(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """While this is open, programs read their arguments and do no more."""
    parse = tyro.cli
    parse_commands = tyro.extras.subcommand_cli_from_dict

    def cli(target, *args, **options):
        parse(without_body(target) if inspect.isfunction(target) else target, *args, **options)
        raise Parsed

    def subcommand_cli_from_dict(commands, *args, **options):
        parse_commands({name: without_body(f) for name, f in commands.items()}, *args, **options)
        raise Parsed

    with monkeypatch.context() as patch:
        patch.setattr(tyro, "cli", cli)
        patch.setattr(tyro.extras, "subcommand_cli_from_dict", subcommand_cli_from_dict)
        yield


def start(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Start a console script, or a program of the lab by ``python -m module``, in this process."""
    with monkeypatch.context() as patch, warnings.catch_warnings(), ExitStack() as after:
        # a program that has a process to itself may change it
        after.callback(signal.signal, signal.SIGTERM, signal.getsignal(signal.SIGTERM))
        if words[:2] == ("python", "-m"):
            warnings.simplefilter("ignore", RuntimeWarning)  # the module may be imported already
            patch.setattr(sys, "argv", [words[2], *words[3:]])
            runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        elif words[0] == "pointsplat":
            main(list(words[1:]))  # its program ends the process
        else:
            [script] = importlib.metadata.entry_points(group="console_scripts", name=words[0])
            patch.setattr(sys, "argv", list(words))
            script.load()()


def check_arguments(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail unless the program's own parser takes the arguments."""
    with parsers_only(monkeypatch), pytest.raises(Parsed):
        start(words, monkeypatch)


def help_of(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> str:
    """What a program says of its options."""
    with parsers_only(monkeypatch), pytest.raises(SystemExit):
        start((*words, "--help"), monkeypatch)
    return capsys.readouterr().out
