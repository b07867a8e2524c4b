"""Lists the installed dependencies whose licences ask for more than to be named, for docs/limits.md.

    python -m lab.licences        # in a fresh environment with pointsplat-ns[nerfstudio]

Read from the metadata of what is installed, or where that has none from its licence file: nothing is run, and no
network is needed. What packages bundle stands in no metadata; of that, the GPL's codecs are found by the names of their
files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from lab.common.printing import start

KINDS = {
    "non-commercial": r"\bnc\b|non-?commercial",
    "GPL": r"(?<!l)gpl|(?<!lesser )general public licen[cs]e",
    "LGPL or MPL": r"lgpl|mozilla|\bmpl|lesser general",
    "proprietary": r"proprietary|restricted",
    "permissive": r"mit\b|bsd|apache|isc\b|python software|psf|zlib|unlicense|0bsd|copyright \(c\)",
}
"""What a licence is by its name, of which the first that fits holds."""

CODECS = ("x264", "x265", "xvidcore", "postproc")
"""Libraries under the GPL that wheels bundle with FFmpeg."""


@dataclass(frozen=True, order=True)
class Licence:
    """The licence of an installed package."""

    kind: str
    """One of :data:`KINDS`; "unnamed" if its metadata has none."""
    package: str
    extra: str
    """The extra of pointsplat-ns that brings it; empty if it always comes along."""
    text: str
    """As its metadata has it."""


def licences() -> list[Licence]:
    """The licences of all that pointsplat-ns requires and that is installed here. NVIDIA's libraries are one."""
    found: dict[str, Licence] = {}
    for extra in ("", "nerfstudio"):
        for name in required("pointsplat-ns", {"", extra}):
            shown = "nvidia-*" if name.startswith("nvidia-") or name == "cuda-toolkit" else name
            kind, text = licence_of(metadata.distribution(name))
            if shown not in found or found[shown].kind == "unnamed":
                found[shown] = Licence(kind, shown, extra, text)
    return sorted(found.values())


def required(name: str, extras: set[str], seen: set[tuple[str, frozenset[str]]] | None = None) -> Iterator[str]:
    """Names of the installed packages that a package requires with some of its extras, directly or not."""
    seen = set() if seen is None else seen
    for text in metadata.distribution(name).requires or []:
        needed = Requirement(text)
        other, its = canonicalize_name(needed.name), frozenset({"", *needed.extras})
        if (other, its) in seen or not (
            needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in extras)
        ):
            continue
        seen.add((other, its))
        try:
            metadata.distribution(other)
        except metadata.PackageNotFoundError:  # for another system, or installed without what it requires
            continue
        yield other
        yield from required(other, {*its}, seen)


def licence_of(package: metadata.Distribution) -> tuple[str, str]:
    """Kind of the licence of an installed package, and its name there."""
    about = package.metadata
    lines = (about.get("License") or "").strip().splitlines()[:1]
    names = [name.rpartition(" :: ")[2] for name in about.get_all("Classifier", []) if name.startswith("License ::")]
    named = [text for text in (about.get("License-Expression") or "", *lines, *names) if text not in ("", "UNKNOWN")]
    bundled = {codec for codec in CODECS for file in package.files or () if f"lib{codec}" in file.name}
    if bundled:
        return "GPL", f"{named[0]}; bundles {' and '.join(sorted(bundled))}, GPL-2.0-or-later"
    if not named:
        files = [file for file in package.files or () if re.match(r"licen[cs]e|copying", file.name, re.IGNORECASE)]
        named = [line.strip() for file in files[:1] for line in (file.read_text() or "").splitlines() if line.strip()][
            :1
        ]
    if not named:
        return "unnamed", ""
    # A choice between two licences is as free as the freer one.
    parts = [part for text in named for part in re.split(r" AND |;", text)]
    order = [*KINDS, "unnamed"]
    choices = [[kind for kind in map(_kind, part.split(" OR ")) if kind != "unnamed"] for part in parts]
    freest = [max(kinds, key=order.index) for kinds in choices if kinds]
    return min(freest, key=order.index, default="unnamed"), named[0]


def _kind(text: str) -> str:
    return next((kind for kind, words in KINDS.items() if re.search(words, text, re.IGNORECASE)), "unnamed")


def main() -> None:
    """Print the packages that this one requires whose licence asks for more than to be named, as rows of a table."""
    for found in licences():
        if found.kind != "permissive":
            print(f"| {found.package} | {found.extra or 'always'} | {found.kind} | {found.text} |")


if __name__ == "__main__":
    start(main)
