"""The licences that the documentation names are those of what is installed."""

import re
from importlib import metadata

import pytest

from lab.licences import licence_of, licences
from making import REPOSITORY

WORDS = {"GPL": "GPL", "LGPL or MPL": "MPL", "non-commercial": "non-commercial", "proprietary": "proprietary"}
"""What the page says of each kind of licence."""


def told() -> dict[str, tuple[str, str]]:
    """What comes with what, and its licence, by package, as docs/limits.md has it."""
    rows = re.findall(r"^\| (.+) \| (.+) \| (.+) \|$", (REPOSITORY / "docs" / "limits.md").read_text(), re.MULTILINE)
    return {package: (extra, text) for names, extra, text in rows for package in names.split(", ")}


def test_limits_names_each_licence_that_asks_for_more_than_to_be_named():
    named, found = told(), {each.package: each for each in licences()}
    assert {"plyfile", "pymeshlab", "nuscenes-devkit"} <= named.keys() and len(found) > 20
    asking = {name: each for name, each in found.items() if each.kind != "permissive"}
    assert asking.keys() <= named.keys(), "docs/limits.md misses some: see python -m lab.licences"
    for name, each in asking.items():
        extra, text = named[name]
        assert extra.startswith(each.extra or "always") and WORDS.get(each.kind, each.kind) in text, name
    gone = {name for name in named.keys() & found.keys() if found[name].kind == "permissive"}
    assert not gone - {"Package"}, "these ask for no more than to be named"


def package(**fields: str) -> metadata.Distribution:
    """An installed package with this metadata, and the file that ``file`` names."""
    file = fields.pop("file", "")
    text = "".join(f"{name.replace('_', '-')}: {value}\n" for name, value in {"Name": "x", **fields}.items())

    class Installed(metadata.Distribution):
        def read_text(self, filename):
            return {"METADATA": text, "RECORD": f"{file},,\n"}.get(filename)

        def locate_file(self, path):
            return REPOSITORY / path

    return Installed()


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"License_Expression": "Apache-2.0 OR GPL-2.0-or-later"}, "permissive"),
        ({"License_Expression": "Apache-2.0 AND GPL-2.0-or-later"}, "GPL"),
        ({"License_Expression": "MIT OR AFL-2.1"}, "permissive"),
        ({"License": "GNU Affero General Public License v3"}, "GPL"),
        ({"Classifier": "License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)"}, "LGPL or MPL"),
        ({"License": "LGPL-2.1"}, "LGPL or MPL"),
        ({"License": "MIT", "Classifier": "License :: Free for non-commercial use"}, "non-commercial"),
        ({"License": "MPL-2.0 AND MIT"}, "LGPL or MPL"),
        ({"License": "UNKNOWN"}, "unnamed"),
        ({}, "unnamed"),
        ({"License": "BSD", "file": "x.libs/libx265-abc.so.9"}, "GPL"),
    ],
)
def test_licences_are_told_apart_by_their_names(fields, kind):
    assert licence_of(package(**fields))[0] == kind
