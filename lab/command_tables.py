"""Tables of the options of every command, from the texts of ``--help``.

python -m lab.command_tables docs/command_line.md    # writes them between the two markers
"""

from __future__ import annotations

import io
import os
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from lab.common.printing import markdown, put_between, start
from pointsplat_ns.cli import COMMANDS, main
from pointsplat_ns.system.files import replacing

MARKER = "options"
"""Name of the markers around the tables in the page."""

SHARED = 3
"""Number of commands from which on an option of theirs is in the table of common options."""

WIDTH = 2000
"""Columns of the terminal that help is printed for: texts fit into one line."""


@dataclass(frozen=True)
class Option:
    """An option or a positional argument, as its help describes it."""

    names: tuple[str, ...]
    """The long name, then short ones; empty for a positional argument."""
    value: str
    """The form of its value; empty for a switch."""
    default: str
    """The default value, or "required"; empty if it is None or off."""
    help: str

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a row: option, default, help."""
        names = ", ".join(map(_code, self.names))
        shown = " ".join(filter(None, (names, _code(self.value))))
        default = self.default if self.default == "required" else _code(self.default)
        return shown, default, self.help.replace("|", r"\|").replace("*", r"\*")


def _code(text: str) -> str:
    return f"`{text}`".replace("|", r"\|") if text else ""


@contextmanager
def _wide_terminal() -> Iterator[None]:
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(WIDTH)
    try:
        yield
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before


def help_of(command: str) -> str:
    """The text that ``pointsplat COMMAND --help`` prints, without colours."""
    printed = io.BytesIO()
    stream = io.TextIOWrapper(printed, encoding="utf-8")  # help has boxes in Unicode alone
    with _wide_terminal(), redirect_stdout(stream), suppress(SystemExit):
        main([command, "--help"])
    stream.flush()
    return re.sub(r"\x1b\[[\d;]*m", "", printed.getvalue().decode("utf-8"))


def options_of(text: str) -> list[Option]:
    """The arguments of a command, from the boxes of its help, without ``--help`` itself."""
    entries: list[list[str]] = []
    for line in re.findall(r"^│ (.*?) *│$", text, flags=re.MULTILINE):
        if line.startswith(" "):  # goes on with the help of the entry above
            entries[-1].append(line.strip())
        else:
            entries.append(re.split(r" {2,}", line, maxsplit=1))
    found = (_option(first, " ".join(rest)) for first, *rest in entries)
    return [option for option in found if "--help" not in option.names]


def _option(heading: str, text: str) -> Option:
    """An option, from the names and values of its help, and the text beside them."""
    end = re.search(r" ?\((?:default: (.*)|(required))\)$", text)
    default = ""
    if end is not None:
        text = text[: end.start()]
        default = end[2] or end[1] or ""
    if default in ("None", "False", "none", "''"):
        default = ""
    heading = heading.replace("{None}|", "").replace("{None,", "{").replace("|STR", "")
    if heading.startswith("-"):
        forms = [form.split(" ", 1) for form in heading.split(", ")]
        names = [form[0] for form in forms if not form[0].startswith("--no-")]
        value = forms[-1][1] if len(forms[-1]) > 1 else ""
    else:
        names = []
        value = heading
    value = re.sub(r"^\[?\[(.+?) \[\1 \.\.\.\]\]\]?$", r"\1 ...", value)
    text = text[:1].upper() + text[1:]
    return Option(
        names=tuple(sorted(names, key=len, reverse=True)),
        value=value,
        default=default,
        help=text if text.endswith(".") else f"{text}.",
    )


def tables() -> str:
    """A table of each command, and before them one of the options that several have alike."""
    found = {command: options_of(help_of(command)) for command in COMMANDS}
    commands: defaultdict[Option, list[str]] = defaultdict(list)
    for command, options in found.items():
        for option in options:
            if option.names:
                commands[option].append(command)
    common = {option: named for option, named in commands.items() if len(named) >= SHARED}
    heads = ("Option", "Default", "Meaning")
    rows = [
        (*replace(option, help=f"{option.help} ({', '.join(named)})").cells,)
        for option, named in common.items()
    ]
    parts = [
        "### Common options",
        "In brackets: the commands that take the option.",
        markdown(heads, rows),
    ]
    for command, options in found.items():
        own = [option.cells for option in options if option not in common]
        also = [_code(option.names[0]) for option in options if option in common]
        parts.append(f"### pointsplat {command}")
        if own:
            parts.append(markdown(heads, own))
        if also:
            parts.append(f"Also, as above: {', '.join(also)}.")
    return "\n\n".join(parts)


def command_tables(page: tyro.conf.Positional[Path]) -> None:
    """Write the tables of all options into a page, between its markers.

    Args:
        page: a Markdown file.
    """
    text = put_between(page.read_text("utf-8"), tables(), page, MARKER)
    with replacing(page) as part:
        part.write_text(text, "utf-8")


if __name__ == "__main__":
    start(command_tables)
