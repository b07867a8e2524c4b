"""All cells of a folder, in one file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lab.common.results import Row, write_json
from lab.tables.ways import PROTOCOL, PUBLISHED_METRICS, published
from pointsplat_ns.errors import SceneError

FILES = ("tables.json", "tables.md", "figure4.png")
"""Files in a folder of tables; the first has all cells."""

FORMAT = {"format": "pointsplat-tables", "version": 1}


@dataclass
class Tables:
    """All cells of a folder."""

    scenes: dict[str, Row] = field(default_factory=dict)
    """Facts on scenes, by name."""
    cells: dict[str, Row] = field(default_factory=dict)
    """Measurements, by key such as fox/merge/10%."""
    missing: dict[str, str] = field(default_factory=dict)
    """Reasons for missing cells, by key."""

    @classmethod
    def of(cls, content: dict[str, Any]) -> Tables:
        """The tables in a file's content. Errors are those of Python if it is none."""
        if content["format"] != FORMAT["format"]:
            raise ValueError(f"of format {content['format']}")
        scenes = {about["name"]: dict(about) for about in content["scenes"]}
        cells = {cell["point"]["key"]: cell for cell in content["cells"]}
        if unknown := {key.split("/")[0] for key in cells} - scenes.keys():
            raise ValueError(f"cells of unknown scenes {', '.join(sorted(unknown))}")
        return cls(scenes, cells)

    @classmethod
    def read(cls, folder: Path, force: bool = False) -> Tables:
        """The tables of a folder; none if it has none. Raises SceneError if its file cannot be
        read, or there are files of others; with ``force`` there are none yet."""
        path = folder / FILES[0]
        if force:
            return cls()
        if not path.exists():
            if others := [name for name in FILES if (folder / name).exists()]:
                raise SceneError(
                    f"{folder / others[0]}: exists already; name another folder, or start over "
                    "with --force"
                )
            return cls()
        try:
            return cls.of(json.loads(path.read_text("utf-8")))
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise SceneError(
                f"{path}: not the cells of tables ({error!r:.80}); name another folder, or start "
                "over with --force"
            ) from error

    def enter(self, name: str, about: Row, group: str | None) -> None:
        """Enter a scene, or find it: a SceneError if existing cells are of another file, other
        views or another machine. Its group stays, if none is given."""
        known = self.scenes.get(name, {})
        for fact, value in about["of"].items() if known else ():
            if (before := known.get("of", {}).get(fact)) != value:
                raise SceneError(
                    f"{name}: its cells are of another {fact.replace('_', ' ')} ({before}, now "
                    f"{value}); name another folder, or start over with --force"
                )
        group = group or known.get("group") or about["dataset"] or "scenes"
        self.scenes[name] = {**known, **about, "group": group}

    def groups(self) -> dict[str, list[str]]:
        """Names of the scenes with cells by group; the paper's datasets first, the others by
        name."""
        measured = {key.split("/")[0] for key in self.cells}
        found: dict[str, list[str]] = {}
        for name in sorted(measured, key=lambda name: self.scenes[name]["group"]):
            found.setdefault(self.scenes[name]["group"], []).append(name)

        def order(group: str) -> int:
            known = [*PROTOCOL.datasets, self.dataset(found[group])]
            return known.index(self.dataset(found[group]))

        return {group: sorted(found[group]) for group in sorted(found, key=order)}

    def dataset(self, names: Sequence[str]) -> str:
        """The dataset of the paper that has all these scenes; empty if there is none."""
        datasets = {self.scenes[name]["dataset"] for name in names}
        return datasets.pop() if len(datasets) == 1 and datasets <= {*PROTOCOL.datasets} else ""

    def comparable(self, names: Sequence[str]) -> str:
        """The dataset whose published figures compare with these scenes': all are of it, and were
        measured by the paper's protocol; empty if there is none."""
        known = [self.scenes[name].get("differs", "measured by an older version") for name in names]
        return "" if any(known) else self.dataset(names)

    def save(self, folder: Path) -> None:
        """Write all figures as JSON."""
        groups = self.groups()
        paper = {}
        for group, names in groups.items():
            if dataset := self.comparable(names):
                cells = {
                    (c["way"], c["point"]["share"])
                    for k, c in self.cells.items()
                    if k.split("/")[0] in names
                }
                paper[group] = {
                    f"table {number}, {way}, {100 * share:g}%": dict(
                        zip(PUBLISHED_METRICS, figures, strict=True)
                    )
                    for number in (1, 3, 4)
                    for way, share in sorted(cells)
                    if (figures := published(number, dataset, way, share))
                }
        scenes = [self.scenes[name] for names in groups.values() for name in names]
        content = {"groups": groups, "scenes": scenes, "cells": list(self.cells.values())}
        folder.mkdir(parents=True, exist_ok=True)
        write_json(
            folder / FILES[0], FORMAT | content | {"paper": paper, "not_measured": self.missing}
        )
