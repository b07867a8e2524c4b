"""What mkdocs does beyond copying docs/: pages that lie elsewhere in the repository, and docstrings
as they are here.

A link of a page is right where it stands in the repository, so that it works on any forge as well;
links to pages that move are turned here.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]

ELSEWHERE = {
    "CONTRIBUTING.md": "project/contributing.md",
    "CHANGELOG.md": "project/changelog.md",
    "pointsplat_ns/refinement/pretrained/CARD.md": "project/refiner.md",
    "pointsplat_ns/refinement/pretrained/FEEDBACK.md": "project/feedback.md",
    "pointsplat_ns/refinement/pretrained/SELECTION.md": "project/selection.md",
}
"""Pages outside docs/, by path in the repository, and where the site has them."""

STANDS_FOR = {"README.md": "README.md"}
"""Pages outside docs/ that the site has another page for."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie elsewhere."""
    for source, place in ELSEWHERE.items():
        files.append(File.generated(config, place, content=(ROOT / source).read_text("utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links from where a page is in the repository to where it is on the site."""
    here = page.file.src_uri
    source = {place: source for source, place in ELSEWHERE.items()}.get(here, f"docs/{here}")

    def turned(match: re.Match[str]) -> str:
        target = match[1]
        anchor = match[2] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        place = (
            path[len("docs/") :]
            if path.startswith("docs/")
            else {**ELSEWHERE, **STANDS_FOR}.get(path)
        )
        if place is None:
            return match[0]
        return f"]({posixpath.relpath(place, posixpath.dirname(here) or '.')}{anchor})"

    return re.sub(r"\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)", turned, markdown)


class Docstrings(griffe.Extension):
    """Reads docstrings as they are written here: ``Example:`` is code, and roles of Sphinx are
    names."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring is not None:
            text = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)
            obj.docstring.value = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", text)
