"""A package like the viewer's, made without a network, and its page as a browser would read it."""

import base64
import gzip
import hashlib
import io
import json
import tarfile
from collections.abc import Mapping
from html.parser import HTMLParser
from typing import Any

from pointsplat_ns.pages.web_viewer import WRITTEN_NAMES, WebViewerPackage

INDEX = b"""<!doctype html><html><head><title>Viewer</title>
<script type="application/json" id="sse-bootstrap">
    null
</script>
<script type="module">import { createViewer } from './index.js';</script></head><body></body></html>"""

MEMBERS = {
    "package/package.json": b"{}",
    "package/public/index.html": INDEX,
    "package/public/index.css": b"canvas {}",
    "package/public/index.js": b"export const createViewer = 0;",
    "package/LICENSE": b"MIT License",
}


def tarball(members: Mapping[str, bytes | None] = MEMBERS) -> bytes:
    """A gzipped tar archive; a member without bytes is a symbolic link to a file outside."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:") as archive:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            if data is None:
                member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
            member.size = len(data or b"")
            archive.addfile(member, io.BytesIO(data or b""))
    return gzip.compress(stream.getvalue(), mtime=0)


def package_of(data: bytes, **changes: Any) -> WebViewerPackage:
    """The description of a package with this tarball."""
    return WebViewerPackage(integrity=base64.b64encode(hashlib.sha512(data).digest()).decode(), **changes)


def small_viewer() -> dict[str, bytes]:
    """The files of a viewer of a few bytes, which shows nothing."""
    return {written: MEMBERS[f"package/{name}"] for name, written in WRITTEN_NAMES.items()}


class _Reader(HTMLParser):
    """The elements of a page, and the text in them, as a browser sees them."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.inside, self.tags = "", list[str]()
        self.texts: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.inside = dict(attrs).get("id") or tag
        self.tags.append(self.inside)

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        self.texts[self.inside] = self.texts.get(self.inside, "") + data


def read_page(page: bytes) -> tuple[list[str], str, dict[str, Any]]:
    """The names of a page's elements, its title, and the values that the viewer starts with."""
    reader = _Reader()
    reader.feed(page.decode("utf-8"))
    return reader.tags, reader.texts["title"], json.loads(reader.texts["sse-bootstrap"])
