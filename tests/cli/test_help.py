"""What ``--help`` shows beyond the options, exit statuses, and completion in shells."""

import inspect
import re
import shlex
from pathlib import Path

import pytest

from pointsplat_ns.cli import COMMANDS as COMMAND_NAMES
from pointsplat_ns.cli import main
from pointsplat_ns.cli.compact import compact
from pointsplat_ns.cli.help import EXAMPLES, STATUSES
from pointsplat_ns.cli.info import info
from pointsplat_ns.cli.make_feedback import make_feedback
from pointsplat_ns.cli.view import view

COMMANDS = {"compact": compact, "info": info, "make-feedback": make_feedback, "view": view}

PAGE = Path(__file__).parents[2] / "docs" / "command_line.md"


def shown(capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main([*words])
    assert end.value.code in (None, 0)
    return capsys.readouterr().out


def listed(text: str) -> list[str]:
    """The commands that the usage of the program lists."""
    return re.search(r"usage: pointsplat \[-h\] \{([\w,-]+)\}", text)[1].split(",")


def words_of(text: str) -> str:
    """Text in one line, without the frames around it."""
    return " ".join(re.sub(r"[^\w .,`-]", " ", text).split())


def test_every_command_has_examples_of_itself(capsys):
    assert listed(shown(capsys, "--help")) == [*EXAMPLES]
    for name, examples in EXAMPLES.items():
        assert examples and all(shlex.split(command)[:2] == ["pointsplat", name] for _, command in examples)


@pytest.mark.parametrize("name", ["prune", "view"])
def test_the_help_of_a_command_ends_with_its_examples(name, capsys):
    _, _, after = shown(capsys, name, "--help").partition("\nexamples:\n")
    assert [line.strip() for line in after.splitlines()] == [
        line for what, command in EXAMPLES[name] for line in (f"# {what}", command)
    ]


def test_the_list_of_commands_has_one_sentence_for_each_and_the_exit_statuses(capsys):
    text = shown(capsys, "--help")
    plain = words_of(text)
    for name, command in COMMANDS.items():
        first, *rest = re.split(r"(?<=\.) ", words_of(inspect.getdoc(command).partition("\n\nArgs:")[0]))
        assert f" {name} {first}" in plain and not any(sentence in plain for sentence in rest)
    for status, meaning in STATUSES.items():
        assert f"  {status:<5}{meaning}\n" in text


def test_all_say_the_same_of_the_number_of_threads(capsys):
    sentence = "Another number may change results by rounding."
    helps = {name: words_of(shown(capsys, name, "--help")) for name in EXAMPLES}
    with_threads = [name for name, text in helps.items() if "--threads" in text]
    assert {"prune", "compact", "lod", "tradeoff", "make-feedback"} <= {*with_threads}
    assert [name for name in with_threads if sentence not in helps[name]] == []
    for page in ("training.md", "reliability.md"):
        assert sentence in " ".join((PAGE.parent / page).read_text("utf-8").split())


@pytest.mark.parametrize("name", COMMAND_NAMES)
def test_the_help_of_every_option_says_its_default(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    options = re.split(r"(?m)^[│ ] (?=-)", shown(capsys, name, "--help").partition("\nexamples:\n")[0])[1:]
    said = {option.split()[0].rstrip(","): " ".join(option.replace("│", " ").split()) for option in options}
    assert said.pop("-h") and said or name == "view"
    for option, text in said.items():
        assert re.search(r"\(default: (?!None).*\)|\(required\)|[Bb]y default", text), f"{option}: {text}"


def test_the_documentation_has_the_same_exit_statuses():
    rows = re.findall(r"(?m)^\| (\d+) \| (.+?) \|$", PAGE.read_text("utf-8"))
    assert {int(status): meaning for status, meaning in rows} == STATUSES


def test_a_command_line_that_is_not_understood_has_status_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["prune", "room.ply", "--keeep", "10%"])
    said = capsys.readouterr()
    assert end.value.code == 2 and "--keeep" in said.err and said.out == ""
