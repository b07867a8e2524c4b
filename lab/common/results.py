"""Results as JSON: whole files, and rows that are written after each scene and can be taken up
again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pointsplat_ns.system.files import json_text, replacing

Row = dict[str, Any]


def grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Rows by a key, in the order that the keys come in."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def write_json(path: Path | None, content: Any) -> None:
    """Write a JSON file whole or not at all, with null for numbers that are not finite; no path, no
    file."""
    if path is not None:
        with replacing(path) as part:
            part.write_text(json_text(content) + "\n", "utf-8")


def write_page(rows: Path, page: Callable[[list[Row]], str]) -> None:
    """Write the page of the rows in a file of :class:`Results`, under its name and beside it."""
    with replacing(rows.with_suffix(".md")) as part:
        part.write_text(page(json.loads(rows.read_text("utf-8"))["rows"]), "utf-8")


class Results:
    """The rows of all scenes, in a file that is written anew after each.

    Args:
        path: the JSON file; None for none.
        settings: what rows depend on beside what they name themselves.
        resume: take up the rows that the file has.

    Raises:
        SystemExit: if the file to take up cannot be read or was written with other settings.
    """

    def __init__(self, path: Path | None, settings: dict[str, Any], resume: bool):
        self.path = path
        self.settings = json.loads(json.dumps(settings))
        self.rows: list[Row] = []
        if resume and path is None:
            raise SystemExit("--resume without --json; expected the file to take up")
        if resume and path is not None and path.exists():
            try:
                content = json.loads(path.read_text("utf-8"))
                self.rows = content["rows"]
                known = content["settings"]
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise SystemExit(
                    f"{path}: cannot be taken up ({error!r}); give another --json"
                ) from error
            other = [name for name in self.settings if self.settings[name] != known.get(name)]
            if other:
                found = ", ".join(
                    f"{name} {known.get(name)}, now {self.settings[name]}" for name in other
                )
                raise SystemExit(
                    f"{path}: was written with {found}; expected the same, or another --json"
                )

    def of(self, name: str) -> list[Row]:
        """The rows of a scene that are there."""
        return [row for row in self.rows if row["scene"] == name]

    def put(self, name: str, rows: list[Row]) -> None:
        """Put rows of a scene in the place of those there are, and write."""
        self.rows = [row for row in self.rows if row["scene"] != name] + rows
        write_json(self.path, {"settings": self.settings, "rows": self.rows})
