"""What is refused, and that one line says so."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pointsplat_ns.cli import main
from pointsplat_ns.errors import PointSplatError


def fails(
    call: Callable[[], object], *fragments: object, error: type[PointSplatError] = PointSplatError
) -> str:
    """The one line of the error that a call raises, in which all fragments are."""
    with pytest.raises(error) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text and len(text) < 900, text
    assert all(str(fragment) in text for fragment in fragments), text
    return text


def run(*words: object) -> None:
    """Run a command of ``pointsplat`` in this process."""
    main([*map(str, words)])


def refusal(capsys, folder: Path, *words: object) -> str:
    """The line on standard error with which a command ends; it prints nothing else, and writes
    nothing to a folder."""
    before = sorted(folder.rglob("*"))
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        run(*words)
    said = capsys.readouterr()
    [error] = said.err.splitlines()
    assert (end.value.code, said.out) == (1, "") and error.startswith("error: "), said
    assert sorted(folder.rglob("*")) == before, "it wrote something"
    return error
