"""Every command, option, path and Python example of the documentation is one that works.

Commands are read by the parsers of the programs that they name, with the functions behind them
taken out; those that make the example room small are really run, on a cut of it.
"""

import pkgutil
import re
import shlex
import shutil
from pathlib import Path

import pytest

import pointsplat_ns as ps
from documented import (
    BLOCKS,
    COMMANDS,
    NS_PROGRAMS,
    PAGES,
    ROOT,
    check_arguments,
    help_of,
    inline_code,
    start,
)
from pointsplat_ns.cli.help import EXAMPLES

pytestmark = pytest.mark.usefixtures("quick")

OF_OTHERS = {
    "--decimate",
    "--eval_mode",
    "--inplace",
    "--no-build-isolation",
    "--only-binary",
    "--tyro-print-completion",
}
"""Options that the documentation names and that belong to programs of others."""

OTHERS = ("dask", "docker", "export", "git", "npm", "pip", "pre-commit", "tensorboard", "uv")
"""Programs of others, whose arguments nothing here reads."""

CUT = 1500
"""Gaussians of the scene that commands are run on: enough to draw, few enough for a second each."""


def runs_quickly(words: tuple[str, ...]) -> bool:
    """Whether a command makes the example room small with nothing else at hand and no
    optimisation."""
    ours = (
        words[:1] == ("pointsplat",)
        and words[1] in ("prune", "compact")
        and words[2:3] == ("room.ply",)
    )
    takes_long = {"--seconds", "--target-db", "--photos"} & {*words}
    return ours and not takes_long and not any(word.startswith("outputs/") for word in words)


def kind(words: tuple[str, ...]) -> tuple[str, ...]:
    """What a command does, apart from how much it keeps and how its files are called."""
    return tuple(sorted(re.sub(r"[\d.]+|\w+(?=\.[a-z]+$)", "", word) for word in words))


QUICK = {
    kind(command.words): command for command in reversed(COMMANDS) if runs_quickly(command.words)
}
"""Commands to run, each kind once however many pages show it."""
PYTHON = sorted({block.page for block in BLOCKS if block.language == "python"})


@pytest.fixture(scope="module")
def cut_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example room, cut to few Gaussians."""
    path = tmp_path_factory.mktemp("cut") / "room.ply"
    ps.save(ps.prune(ps.example_room(), CUT, by="coverage"), path)
    return path


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.where)
def test_block_names_its_language_and_reads_a_room_that_was_written(block):
    assert block.language in ("bash", "python", "text")
    read = [
        number
        for number, line in enumerate(block.text.splitlines())
        if re.search(r"(?<![\w/])room\.ply", line)
    ]
    if read and block.language != "text":
        lines = block.page.read_text("utf-8").splitlines()
        assert any("pointsplat demo" in line for line in lines[: block.line + read[0]])


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_command_is_one_that_works(command, tmp_path, monkeypatch):
    words = command.words
    assert not {"|", "&&", ";", ">", "<"} & set(words), "one command a line, please"
    program = words[0]
    if words[1:2] == ("--tyro-write-completion",):
        with pytest.raises(SystemExit):
            start((*words[:-1], str(tmp_path / "script")), monkeypatch)
        assert program in (tmp_path / "script").read_text()
    elif program in ("pointsplat", *NS_PROGRAMS):
        check_arguments(words, monkeypatch)
    elif program == "ns-process-data":  # which looks for programs before it has read its arguments
        for check in ("check_ffmpeg_installed", "check_colmap_installed"):
            monkeypatch.setattr(f"nerfstudio.utils.install_checks.{check}", lambda *_: None)
        check_arguments(words, monkeypatch)
    elif words[:3] == ("python", "-m", "pytest"):
        assert all((ROOT / word).exists() for word in words[3:] if not word.startswith("-"))
    elif words[:2] == ("python", "-m"):
        assert words[2].startswith("lab."), "no rule for this module"
        check_arguments(words, monkeypatch)
    elif words[:2] == ("python", "setup.py"):
        assert words[2:] == ("build_ext", "--inplace") and (ROOT / "setup.py").is_file()
    elif program == "make":
        targets = re.findall(
            r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), flags=re.MULTILINE
        )
        assert {word for word in words[1:] if "=" not in word} <= set(targets)
    elif words[:2] == ("docker", "run"):
        check_arguments(words[words.index("pointsplat") :], monkeypatch)
    else:
        assert program in OTHERS, f"no rule checks {program}; add one"


@pytest.mark.parametrize("command", QUICK.values(), ids=str)
def test_command_makes_the_room_small(command, cut_room, tmp_path, monkeypatch):
    shutil.copy(cut_room, tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    words = command.words
    start(words, monkeypatch)
    default = {"prune": "room_pruned.ply", "compact": "room_compact.ply"}[words[1]]
    default = "room_web.sog" if "--for" in words else default
    output = Path(words[words.index("-o") + 1] if "-o" in words else default)
    if "auto:35" in words:  # few Gaussians may all be needed
        # as conftest.py has it
        small = ps.load(output)
        views = ps.sample_views(ps.load("room.ply"), 12, 64, 48)
        errors = (
            (ps.render(small, views) - ps.render(ps.load("room.ply"), views))
            .double()
            .square()
            .mean()
        )
        assert errors < 10**-3.4  # 35 dB, and what the rounding of an SPZ adds
    else:
        assert 0 < len(ps.load(output)) < CUT + bool({"--for"} & {*words})  # all of it may fit
    assert (
        "--picture" not in words or Path(words[words.index("--picture") + 1]).stat().st_size > 1000
    )


@pytest.mark.parametrize("page", PYTHON, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_examples_run(page, cut_room, tmp_path, monkeypatch):
    shutil.copy(cut_room, tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in BLOCKS:
        if block.page == page and block.language == "python":
            exec(compile(block.text, block.where, "exec"), names)


def test_options_named_in_text_and_promised_by_the_changelog_exist(monkeypatch, capsys):
    programs = [("pointsplat", name) for name in EXAMPLES]
    programs += [
        ("ns-train", "pointsplat"),
        ("ns-train", "splatfacto-cpu"),
        ("ns-render", "interpolate"),
    ]
    programs += [
        ("ns-train", "splatfacto-cpu", parser) for parser in ("replica-data", "scannetpp-seeded")
    ]
    programs += [
        ("python", "-m", words[2])
        for words in {c.words[:3] for c in COMMANDS}
        if "lab." in str(words[2:])
    ]
    helps = "\n".join(help_of(words, monkeypatch, capsys) for words in programs)
    known = set(re.findall(r"--[a-z][\w.-]*", helps)) | OF_OTHERS | {"--help", "--version"}
    promised = (ROOT / "CHANGELOG.md").read_text("utf-8").partition("### Removed")[0]
    codes = [
        *inline_code(),
        *((ROOT / "CHANGELOG.md", code) for code in re.findall(r"`([^`\n]+)`", promised)),
    ]
    for page, code in codes:
        unknown = set(re.findall(r"(?<!\S)--[a-z][\w.-]*", code)) - known
        assert not unknown, page.name


def test_training_options_named_in_text_are_accepted_with_their_values(monkeypatch):
    named = {
        code for _, code in inline_code() if re.match(r"--\S+ \S", code) and "pipeline" in code
    }
    assert named, "expected some, such as `--pipeline.model.encoder concat`"
    for code in sorted(named):
        check_arguments(("ns-train", "pointsplat", *shlex.split(code)), monkeypatch)


def test_names_of_the_package_and_paths_in_text_exist():
    for page, code in inline_code():
        if match := re.match(r"pointsplat_ns(\.\w+)+", code):
            pkgutil.resolve_name(match[0])
        if re.fullmatch(r"(pointsplat_ns|lab|docs|tests|method_configs)/[\w./-]*", code):
            assert (ROOT / code).exists(), f"{page.name}: {code}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\((?!https?://)([^)#\s]+)", page.read_text("utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]
