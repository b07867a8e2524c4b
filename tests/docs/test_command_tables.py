"""The tables of options in docs/command_line.md."""

import re

import pytest

from documented import ROOT
from lab.command_tables import MARKER, help_of, options_of, tables
from lab.common.printing import put_between
from pointsplat_ns.cli import COMMANDS, main

PAGE = ROOT / "docs" / "command_line.md"


def test_the_page_has_the_tables_that_the_program_writes():
    text = PAGE.read_text("utf-8")
    assert put_between(text, tables(), PAGE, MARKER) == text, (
        f"run python -m lab.command_tables {PAGE.relative_to(ROOT)}"
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_help_as_a_narrow_terminal_shows_it_is_found(
    command, monkeypatch, capsys
):
    monkeypatch.setenv("COLUMNS", "60")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    entries = [
        line for line in capsys.readouterr().out.splitlines() if re.match(r"\W{1,2}(?= ?-).-", line)
    ]
    expected = {name for line in entries for name in re.findall(r"(?<!\S)--[a-z][\w-]*", line)}
    expected -= {"--help", *(name for name in expected if name.startswith("--no-"))}
    options = options_of(help_of(command))
    found = {name for option in options for name in option.names if name.startswith("--")}
    assert len(expected) > 0
    assert found == expected


def test_jobs_is_for_a_folder_only_where_a_folder_is_taken():
    for command in COMMANDS:
        options = options_of(help_of(command))
        for option in options:
            if option.names == ("--jobs",):
                takes_folder = "folder of scenes" in options[0].help
                assert ("for a folder" in option.help.lower()) == takes_folder, command
