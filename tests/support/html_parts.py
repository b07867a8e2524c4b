"""The parts of a self-contained HTML file, for tests that look at them."""

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path


class Parts(HTMLParser):
    """The elements of a page with their attributes, and the text of its scripts and styles."""

    def __init__(self, text: str):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.inside: dict[str, list[str]] = {"script": [], "style": []}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.cdata_elem:  # within a script or a style
            self.inside[self.cdata_elem].append(data)

    @property
    def data(self) -> dict:
        return json.loads(self.inside["script"][0])


def parts_of(path: Path) -> Parts:
    return Parts(path.read_text("utf-8"))


def policy_of(parts: Parts) -> dict[str, str]:
    """The content security policy of a page, by rule."""
    [policy] = [
        a["content"] for _, a in parts.elements if a.get("http-equiv") == "Content-Security-Policy"
    ]
    return dict(rule.split(" ", 1) for rule in str(policy).split("; "))


def hashed(text: str) -> str:
    """The source in a policy that allows one inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def names_nothing_outside(path: Path) -> None:
    """Fail if a page names a URL, or has an element or attribute that could load something."""
    parts = parts_of(path)
    names = {name for _, attributes in parts.elements for name in attributes}
    assert not names & {
        "src",
        "href",
        "srcset",
        "xlink:href",
        "action",
        "data",
        "style",
        "background",
        "poster",
    }
    assert not {tag for tag, _ in parts.elements} & {
        "link",
        "iframe",
        "object",
        "embed",
        "base",
        "form",
    }
    text = re.sub(r"base64,[\w+/=]*", "", path.read_text("utf-8"))
    assert not re.search(r"://|url\(|@import", text)
