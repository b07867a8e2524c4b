"""Every command, option, path and Python example of the documentation is one that works.

Commands are read by the parsers of the programs that they name, with the functions behind them taken out; those that
make the example room small are really run, on a cut of it.
"""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
import pkgutil
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro
from torch.distributed.run import get_args_parser as torchrun_parser

import pointsplat_ns as ps
from pointsplat_ns.api import EXAMPLE

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    EXAMPLE.with_name("README.md"),
    *sorted((ROOT / "docs").glob("*.md")),
]
BENCHMARKS = ROOT / "benchmarks"

NS_PROGRAMS = ("ns-train", "ns-eval", "ns-export", "ns-viewer")
OF_OTHERS = {"--decimate", "--no-build-isolation", "--only-binary"}
"""Options that the documentation names and that belong to programs of others."""

CUT = 1500
"""Gaussians of the scene that commands are run on: enough to draw, few enough for a second each."""


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


@dataclass(frozen=True)
class Command:
    """One command line."""

    where: str
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.where} {shlex.join(self.words)}"


def blocks_of(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, also those indented in a list."""
    language, first, indent, lines = None, 0, 0, []
    for number, line in enumerate(page.read_text("utf-8").splitlines(), 1):
        fence = re.match(r"( *)```(\w*)\s*$", line)
        if fence and language is None:
            indent, language, first, lines = len(fence[1]), fence[2], number + 1, []
        elif fence and language is not None:
            yield Block(page, first, language, "\n".join(lines))
            language = None
        elif language is not None:
            lines.append(line[indent:])
    assert language is None, f"{page}: the block at line {first} does not end"


def commands_of(block: Block) -> Iterator[Command]:
    """The command lines of a block, without comments and without settings of the environment before them."""
    joined = block.text.replace("\\\n", " ")
    for line in joined.splitlines():
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            words.pop(0)
        if words:
            yield Command(block.where, tuple(words))


def inline_code() -> Iterator[tuple[Path, str]]:
    """The code within lines of text."""
    for page in PAGES:
        text = re.sub(r"^ *```.*?^ *```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
        for code in re.findall(r"`([^`\n]+)`", text):
            yield page, code


def files_of(words: tuple[str, ...]) -> list[str]:
    """The files of requirements that pip is given."""
    return [words[index + 1] for index, word in enumerate(words) if word == "-r"]


def runs_quickly(words: tuple[str, ...]) -> bool:
    """Whether a command makes the example room small with nothing else at hand and no optimisation."""
    ours = words[:1] == ("pointsplat",) and words[1] in ("prune", "compact") and words[2] == "room.ply"
    optimises = {"--fine-tune", "--seconds"} & {*words}
    return ours and not optimises and not any(word.startswith("outputs/") for word in words)


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
COMMANDS = [command for block in BLOCKS if block.language == "bash" for command in commands_of(block)]
QUICK = {command.words: command for command in COMMANDS if runs_quickly(command.words)}
"""Commands to run, each once however many pages show it."""
PYTHON = sorted({block.page for block in BLOCKS if block.language == "python"})


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
    parse, parse_commands = tyro.cli, tyro.extras.subcommand_cli_from_dict

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
    """Start a console script, or a script by ``python path``, in this process."""
    with monkeypatch.context() as patch:
        if words[0] == "python":
            script = ROOT / words[1]
            patch.setattr(sys, "argv", [str(script), *words[2:]])
            patch.syspath_prepend(str(script.parent))
            before = set(sys.modules)
            try:
                runpy.run_path(str(script), run_name="__main__")
            finally:
                for name in set(sys.modules) - before:  # the script's neighbours, which have names such as "report"
                    if str(script.parent) in (getattr(sys.modules[name], "__file__", None) or ""):
                        del sys.modules[name]
        else:
            [script] = importlib.metadata.entry_points(group="console_scripts", name=words[0])
            patch.setattr(sys, "argv", list(words))
            script.load()()


def check_arguments(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """Fail unless the program's own parser takes the arguments."""
    with parsers_only(monkeypatch):
        try:
            start(words, monkeypatch)
        except Parsed:
            return
        except SystemExit as end:
            pytest.fail(f"{shlex.join(words)}: exit status {end.code}\n{''.join(capsys.readouterr())}")
    pytest.fail(f"{shlex.join(words)}: the program read no arguments")


def help_of(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> str:
    """What a program says of its options."""
    with parsers_only(monkeypatch), pytest.raises(SystemExit):
        start((*words, "--help"), monkeypatch)
    return capsys.readouterr().out


@pytest.fixture(scope="module")
def cut_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example room, cut to few Gaussians."""
    path = tmp_path_factory.mktemp("cut") / "room.ply"
    ps.save(ps.prune(ps.example_room(), CUT, by="coverage"), path)
    return path


def test_pages_have_commands():
    assert len(COMMANDS) > 30


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.where)
def test_block_says_what_it_is(block):
    assert block.language in ("bash", "python", "text")


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_command_is_one_that_works(command, monkeypatch, capsys):
    words = command.words
    assert not {"|", "&&", ";", ">", "<"} & set(words), "one command a line, please"
    program = words[0]
    if program in ("pointsplat", *NS_PROGRAMS):
        check_arguments(words, monkeypatch, capsys)
    elif program == "torchrun":
        started = torchrun_parser().parse_args(words[1:])
        assert started.no_python and started.training_script == "pointsplat", "no rule for this program"
        check_arguments((started.training_script, *started.training_script_args), monkeypatch, capsys)
    elif program == "python" and words[1:2] == ("-m",):
        assert words[2] == "pytest", "no rule for this module"
        assert all((ROOT / word).exists() for word in words[3:] if not word.startswith("-"))
    elif program == "python":
        assert Path(words[1]).parts[0] == "benchmarks", "no rule for this script"
        check_arguments(words, monkeypatch, capsys)
    elif program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.MULTILINE)
        assert {word for word in words[1:] if "=" not in word} <= set(targets)
    elif program == "pip":
        assert words[1] == "install" and set(files_of(words)) <= {"requirements/core.txt", "oldest.txt"}
    elif program == "uv":
        assert words[1:3] == ("pip", "compile") and {word for word in words if word.startswith("requirements/")} == {
            str(path.relative_to(ROOT)) for path in (ROOT / "requirements").iterdir()
        }
    elif program == "pre-commit":
        assert words[1] in ("install", "run")
        assert (ROOT / ".pre-commit-config.yaml").is_file()
    elif program == "npm":
        assert words == ("npm", "install", "@playcanvas/splat-transform")
    else:
        pytest.fail(f"no rule checks {program}; add one")


@pytest.mark.parametrize("command", QUICK.values(), ids=str)
def test_command_makes_the_room_small(command, cut_room, tmp_path, monkeypatch):
    shutil.copy(cut_room, tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    words = command.words
    start(words, monkeypatch)
    default = {"prune": "room_pruned.ply", "compact": "room_compact.ply"}[words[1]]
    output = Path(words[words.index("-o") + 1] if "-o" in words else default)
    if "--dry-run" in words:
        assert not output.exists()
    elif "auto:35" in words:  # few Gaussians may all be needed
        small, views = ps.load(output), ps.sample_views(ps.load("room.ply"), 12, 64, 48)  # as conftest.py has it
        errors = (ps.render(small, views) - ps.render(ps.load("room.ply"), views)).double().square().mean()
        assert errors < 10**-3.5
    else:
        assert 0 < len(ps.load(output)) < CUT
    for option in ("--plot", "--picture"):
        assert option not in words or Path(words[words.index(option) + 1]).stat().st_size > 1000


@pytest.mark.parametrize("page", PYTHON, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_examples_run(page, cut_room, tmp_path, monkeypatch):
    shutil.copy(cut_room, tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in BLOCKS:
        if block.page == page and block.language == "python":
            exec(compile(block.text, block.where, "exec"), names)


def test_readme_shows_the_ten_lines():
    [block] = [block for block in BLOCKS if block.page.name == "README.md" and block.language == "python"]
    calls = re.findall(r"ps\.(\w+)\(", block.text)
    assert {"load", "prune", "load_refiner", "refine", "sample_views", "render", "psnr", "compact", "save"} <= {*calls}


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text("utf-8").split()) <= 800


def test_options_named_in_text_exist(monkeypatch, capsys):
    programs = [
        ("pointsplat", name)
        for name in (
            *("prune", "compact", "lod", "tradeoff", "tables", "convert", "info", "view", "render", "export", "report"),
            "rooms",
            *("make-refiner", "make-feedback", "demo"),
        )
    ]
    programs += [
        ("ns-train", "pointsplat"),
        ("ns-train", "splatfacto-cpu"),
        ("ns-train", "splatfacto-cpu", "replica-data"),
    ]
    programs += [("python", "benchmarks/compaction.py"), ("python", "benchmarks/rasterizer.py")]
    helps = "\n".join(help_of(words, monkeypatch, capsys) for words in programs)
    known = set(re.findall(r"--[a-z][\w.-]*", helps)) | OF_OTHERS | {"--help"}
    unknown = {
        f"{page.name}: {option}"
        for page, code in inline_code()
        for option in re.findall(r"(?<!\S)--[a-z][\w.-]*", code)
        if option not in known
    }
    assert not unknown


def test_training_options_named_in_text_are_accepted_with_their_values(monkeypatch, capsys):
    named = {code for _, code in inline_code() if re.match(r"--\S+ \S", code) and "pipeline" in code}
    assert named, "expected some, such as `--pipeline.model.encoder concat`"
    for code in sorted(named):
        check_arguments(("ns-train", "pointsplat", *shlex.split(code)), monkeypatch, capsys)


def test_names_of_the_package_in_text_exist():
    for _, code in inline_code():
        if match := re.match(r"pointsplat_ns(\.\w+)+", code):
            pkgutil.resolve_name(match[0])


def test_paths_named_in_text_exist():
    tops = "pointsplat_ns|benchmarks|docs|tests|method_configs"
    missing = {
        f"{page.name}: {code}"
        for page, code in inline_code()
        if re.fullmatch(rf"({tops})/[\w./-]*", code) and not (ROOT / code).exists()
    }
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\((?!https?://)([^)#\s]+)", page.read_text("utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]
