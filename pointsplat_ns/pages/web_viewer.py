"""PlayCanvas' SuperSplat viewer, the page that shows a streamed SOG: found on this machine, or downloaded once."""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import io
import json
import logging
import os
import re
import stat
import tarfile
import urllib.request
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.files import one_line, replacing

logger = logging.getLogger("pointsplat_ns")


@dataclass(frozen=True)
class WebViewerPackage:
    """The npm package of the viewer (MIT)."""

    name: str = "@playcanvas/supersplat-viewer"
    version: str = "1.36.2"
    integrity: str = "L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w=="
    """SHA-512 of the tarball as npm's registry has it, in base64."""
    variable: str = "POINTSPLAT_WEB_VIEWER"
    """Environment variable: a tarball of the package."""
    members: Mapping[str, str] = field(
        default_factory=lambda: {
            "public/index.html": "index.html",
            "public/index.css": "index.css",
            "public/index.js": "index.js",
            "LICENSE": "LICENSE.supersplat-viewer.txt",
        }
    )
    """The files that are taken from the package, and the names that they are written under."""
    largest: int = 64_000_000
    """Largest tarball, before and after decompression, and largest file, bytes; the version above has 3 and 16 MB."""
    timeout: float = 15.0
    """Seconds without an answer after which a download fails."""

    @property
    def address(self) -> str:
        """The tarball in npm's registry."""
        return f"https://registry.npmjs.org/{self.name}/-/{self.tarball}"

    @property
    def tarball(self) -> str:
        """The file name of the tarball."""
        return f"{self.name.rpartition('/')[2]}-{self.version}.tgz"

    @property
    def remedy(self) -> str:
        """What to do without a network."""
        return f"set {self.variable} to its tarball (npm pack {self.name}@{self.version})"

    def is_it(self, data: bytes) -> bool:
        """Whether these are the bytes of the tarball."""
        return base64.b64encode(hashlib.sha512(data).digest()).decode("ascii") == self.integrity


KNOWN_FILES: Mapping[str, str] = {
    "index.html": "fdcc364d6b980db89dd8bc08d8376a8dedeb08656a544ab969b5384e609bc094",
    "index.css": "92e50eab13d86bb6bd32ee62e0b60a42d25cd2047e49cc67d53d49e20d71c1da",
    "index.js": "dc22b4a2c813747cb68f0bc43cc735eeb84ec458682e37358cc93f078d1d7fe7",
    "LICENSE.supersplat-viewer.txt": "44716a2a1040df078772702d677d46f7d97f40c2375bf8221d4b3b741143f823",
}
"""SHA-256 of the viewer's files of this version, as :meth:`WebViewer.digests` has them."""


@dataclass(frozen=True)
class WebViewer:
    """The files of the viewer, by the names that they are written under."""

    files: Mapping[str, bytes]

    def page(self, title: str, bootstrap: dict[str, Any]) -> dict[str, bytes]:
        """The files with a title, and with the values that the page starts with: see ``sse-bootstrap`` in the viewer's
        own page. Neither can add an element to the page.

        Raises:
            PointSplatError: if the page has no place for them.
            ValueError: if a number is NaN or infinite.
        """
        # Elements end at "</" and comments begin at "<!--", whatever surrounds them.
        values = json.dumps(bootstrap, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        return {**self.files, "index.html": self._filled(html.escape(title), values)[0]}

    def _filled(self, title: str, values: str) -> tuple[bytes, str]:
        """The page with another title and other values, as HTML, and the values that it had."""
        text, before = self.files["index.html"].decode("utf-8", "replace"), ""
        for element, content in (("title", title), ('script type="application/json" id="sse-bootstrap"', values)):
            name = element.partition(" ")[0]
            found = list(re.finditer(f"<{element}>([^<]*)</{name}>", text))
            if len(found) != 1:
                raise PointSplatError(f"the viewer's index.html has {len(found)} elements <{element}>; expected one")
            before = found[0][1]
            text = f"{text[: found[0].start()]}<{element}>{content}</{name}>{text[found[0].end() :]}"
        return text.encode("utf-8", "replace"), before

    def digests(self) -> dict[str, str]:
        """SHA-256 of each file, in 64 hexadecimal digits; of the page without its title and values. Raises
        PointSplatError as :meth:`page`."""
        files = {**self.files, "index.html": self._filled("", "")[0]}
        return {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}

    def bootstrap(self) -> Any:
        """The values that the page starts with. Raises PointSplatError as :meth:`page`, and ValueError if they are no
        JSON."""
        return json.loads(self._filled("", "")[1])


def web_viewer(package: WebViewerPackage | None = None) -> WebViewer:
    """The viewer: what the environment variable names, else the copy in the cache, else a download, which is cached.

    Raises:
        PointSplatError: if the variable names something else, or the download fails; the text says what to do.
    """
    package = package or WebViewerPackage()
    named, folder = os.environ.get(package.variable), cache_folder()
    if named:
        place = Path(named).expanduser()
        try:
            return _of_tarball(_read(place, package), package)
        except (OSError, ValueError) as error:
            wanted = f"expected a tarball of {package.name}"
            raise PointSplatError(f"{place}, which {package.variable} names: {one_line(error)}; {wanted}") from error
    cached, data = folder and folder / package.tarball, b""
    if cached is not None:
        with suppress(OSError, ValueError):
            data = _read(cached, package)
    if not package.is_it(data):
        data = _downloaded(package)
        if cached is not None:
            with suppress(SceneError), replacing(cached, len(data)) as part:  # without room, the next call loads again
                part.write_bytes(data)
    return _of_tarball(data, package)


def cache_folder() -> Path | None:
    """The folder for downloads, which is the user's alone: that of the environment variable POINTSPLAT_CACHE, by
    default pointsplat_ns in the user's cache folder. None if there is none."""
    named = os.environ.get("POINTSPLAT_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    folder = Path(named) if named else Path(home) / "pointsplat_ns"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
    except (OSError, RuntimeError):  # the second: a home that is not known
        return None
    shared = about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    ours = not hasattr(os, "getuid") or about.st_uid == os.getuid()
    return folder if ours and not shared and os.access(folder, os.W_OK) else None


def known_digests() -> Mapping[str, str]:
    """The digests of the viewer that pages are made of: the one that the environment variable names, else
    :data:`KNOWN_FILES`. Raises PointSplatError as :func:`web_viewer`."""
    return web_viewer().digests() if os.environ.get(WebViewerPackage().variable) else KNOWN_FILES


def _downloaded(package: WebViewerPackage) -> bytes:
    """The package's tarball from the registry."""
    logger.info("downloading %s %s, once", package.name, package.version)
    try:
        with urllib.request.urlopen(package.address, timeout=package.timeout) as answer:
            data = answer.read(package.largest + 1)
    except (OSError, HTTPException) as error:  # no route, no name, a proxy that refuses, a time limit
        raise PointSplatError(
            f"{package.address}: cannot be downloaded ({one_line(error)}); {package.remedy}"
        ) from error
    if not package.is_it(data):
        found = f"{len(data):,} bytes with another SHA-512 than version {package.version}"
        raise PointSplatError(f"{package.address}: {found}, so nothing was kept; {package.remedy}")
    return data


def _of_tarball(data: bytes, package: WebViewerPackage) -> WebViewer:
    """The viewer from the bytes of a tarball, of which nothing is unpacked to the disk. Raises ValueError if it is
    none, is too large, or lacks a file."""
    try:
        with gzip.open(io.BytesIO(data)) as stream:
            plain = stream.read(package.largest + 1)
        if len(plain) > package.largest:
            raise ValueError(f"unpacks to more than {package.largest:,} bytes")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as archive:
            found = {member.name: member for member in archive if member.isreg()}
            missing = [name for name in package.members if f"package/{name}" not in found]
            if missing:
                raise ValueError(f"has no file package/{missing[0]}")
            files = {}
            for name, written in package.members.items():
                content = archive.extractfile(found[f"package/{name}"])
                assert content is not None
                files[written] = content.read()
    except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
        raise ValueError(f"no tarball, or a damaged one ({one_line(error)})") from error
    return WebViewer(files)


def _read(path: Path, package: WebViewerPackage) -> bytes:
    """The bytes of a file. Raises OSError if it cannot be read, and ValueError if it is not regular or too large."""
    if not path.is_file() and path.exists():
        raise ValueError("not a regular file")
    if path.stat().st_size > package.largest:
        raise ValueError(f"larger than {package.largest:,} bytes")
    return path.read_bytes()
