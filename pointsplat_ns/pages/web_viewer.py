"""PlayCanvas' SuperSplat viewer (npm, MIT), the page that shows a streamed SOG: a download, or a tarball at hand."""

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
import tarfile
import urllib.request
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io.files import one_line

logger = logging.getLogger("pointsplat_ns")

VARIABLE = "POINTSPLAT_WEB_VIEWER"
"""Environment variable: a tarball of the package, of any version."""

WRITTEN_NAMES = {
    "public/index.html": "index.html",
    "public/index.css": "index.css",
    "public/index.js": "index.js",
    "LICENSE": "LICENSE.supersplat-viewer.txt",
}
"""Files of the package, and the names that they are written under."""


@dataclass(frozen=True)
class WebViewerPackage:
    """The npm package of the viewer."""

    name: str = "@playcanvas/supersplat-viewer"
    version: str = "1.36.2"
    integrity: str = "L7w0BlagAonRHQg5qhaDyBB8zrRtiU9QgglNU3kUgsqHpokCAtuf9j4P0kxsUaQn61FZ1qJGkRKsOCbrLCDR0w=="
    """SHA-512 of the tarball as npm's registry has it, in base64."""
    largest: int = 64_000_000
    """Largest tarball, before and after decompression, bytes; the version above has 3 and 16 MB."""


def web_viewer(package: WebViewerPackage | None = None) -> dict[str, bytes]:
    """The viewer's files, by the names that they are written under: of the tarball that the environment variable names,
    else of a download.

    Raises:
        PointSplatError: if the variable names something else, or the download fails; the text says what to do.
    """
    package = package or WebViewerPackage()
    named = os.environ.get(VARIABLE)
    if not named:
        return _files_of(_downloaded(package), package)
    place = Path(named).expanduser()
    try:
        if not place.is_file() and place.exists():
            raise ValueError("not a regular file")
        if place.stat().st_size > package.largest:
            raise ValueError(f"larger than {package.largest:,} bytes")
        return _files_of(place.read_bytes(), package)
    except (OSError, ValueError) as error:
        wanted = f"expected a tarball of {package.name}"
        raise PointSplatError(f"{place}, which {VARIABLE} names: {one_line(error)}; {wanted}") from error


def filled(files: Mapping[str, bytes], title: str, bootstrap: dict[str, Any]) -> dict[str, bytes]:
    """The viewer's files with a title, and with the values that the page starts with: see ``sse-bootstrap`` in the
    viewer's own page. Neither can add an element to the page.

    Raises:
        PointSplatError: if the page has no place for them.
        ValueError: if a number is NaN or infinite.
    """
    # Elements end at "</" and comments begin at "<!--", whatever surrounds them.
    values = json.dumps(bootstrap, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    text = files["index.html"].decode("utf-8", "replace")
    for element, content in (
        ("title", html.escape(title)),
        ('script type="application/json" id="sse-bootstrap"', values),
    ):
        found = list(re.finditer(f"(?<=<{element}>)[^<]*(?=</{element.partition(' ')[0]}>)", text))
        if len(found) != 1:
            raise PointSplatError(f"the viewer's index.html has {len(found)} elements <{element}>; expected one")
        text = text[: found[0].start()] + content + text[found[0].end() :]
    return {**files, "index.html": text.encode("utf-8", "replace")}


def _downloaded(package: WebViewerPackage) -> bytes:
    """The package's tarball from the registry."""
    tarball = f"{package.name.rpartition('/')[2]}-{package.version}.tgz"
    address = f"https://registry.npmjs.org/{package.name}/-/{tarball}"
    remedy = f"set {VARIABLE} to its tarball (npm pack {package.name}@{package.version})"
    logger.info("downloading %s %s", package.name, package.version)
    try:
        with urllib.request.urlopen(address, timeout=15.0) as answer:  # s without an answer
            data = answer.read(package.largest + 1)
    except (OSError, HTTPException) as error:  # no route, no name, a proxy that refuses, a time limit
        raise PointSplatError(f"{address}: cannot be downloaded ({one_line(error)}); {remedy}") from error
    if base64.b64encode(hashlib.sha512(data).digest()).decode("ascii") != package.integrity:
        found = f"{len(data):,} bytes with another SHA-512 than version {package.version}"
        raise PointSplatError(f"{address}: {found}; {remedy}")
    return data


def _files_of(data: bytes, package: WebViewerPackage) -> dict[str, bytes]:
    """The viewer's files from the bytes of a tarball, of which nothing is unpacked to the disk. Raises ValueError if it
    is none, is too large, or lacks a file."""
    try:
        with gzip.open(io.BytesIO(data)) as stream:
            plain = stream.read(package.largest + 1)
        if len(plain) > package.largest:
            raise ValueError(f"unpacks to more than {package.largest:,} bytes")
        with tarfile.open(fileobj=io.BytesIO(plain), mode="r:") as archive:
            found = {member.name: member for member in archive if member.isreg()}
            files = {}
            for name, written in WRITTEN_NAMES.items():
                if f"package/{name}" not in found:
                    raise ValueError(f"has no file package/{name}")
                content = archive.extractfile(found[f"package/{name}"])
                assert content is not None
                files[written] = content.read()
    except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
        raise ValueError(f"no tarball, or a damaged one ({one_line(error)})") from error
    return files
