"""The site, its notebook and its troubleshooting."""

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import pointsplat_ns as ps
from documented import BLOCKS, ROOT
from making import ball
from pointsplat_ns.cli import main

pytestmark = pytest.mark.xdist_group("site")  # one process builds it for all tests of this file

NEEDED = ("mkdocs", "material", "mkdocstrings", "mkdocstrings_handlers")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` does: any warning is an error."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        pytest.skip(f"needs {', '.join(missing)}: pip install -e .[docs]")
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_is_in_the_reference_with_its_example(site):
    page = (site / "reference" / "api.html").read_text("utf-8")
    for name in ps.__all__:
        assert f'id="{ps._HOME[name]}.{name}"' in page
    assert page.count("Examples:</span>") >= len(ps.__all__)
    assert ":func:" not in page and ":class:" not in page


def test_nothing_is_fetched_from_elsewhere_and_links_lead_to_pages(site):
    assert 'href="../benchmarks.html"' in (site / "project" / "contributing.html").read_text(
        "utf-8"
    )
    assert 'href="project/refiner.html"' in (site / "refining.html").read_text("utf-8")
    for page in site.rglob("*.html"):
        text = page.read_text("utf-8")
        assert not re.findall(
            r'<(?:script|img|link rel="stylesheet"|iframe)[^>]+(?:src|href)="(?:https?:)?//', text
        )


def test_pictures_are_small():
    for picture in (ROOT / "docs").rglob("*.[jp][pn]g"):
        assert picture.stat().st_size < 200_000, picture


PAGE = "troubleshooting.md"

MESSAGES = [
    line
    for block in BLOCKS
    if block.page.name == PAGE and block.language == "text"
    for line in block.text.splitlines()
]


def room() -> ps.Gaussians:
    return ball(4, opacity=1.0, bright=1.0)


def write(name: str, change: Callable[[bytes], bytes]) -> Callable[[], object]:
    """A function that writes a file with the bytes of the room changed."""
    return lambda: Path(name).write_bytes(change(Path("room.ply").read_bytes()))


def odd(data: bytes) -> bytes:
    """One position that is no number."""
    head, end, rows = data.partition(b"end_header\n")
    return head + end + b"\0\0\xc0\x7f" + rows[4:]


TRIGGERS: dict[str, tuple[Callable[[], object], str]] = {
    "no such file; expected a scene": (lambda: Path("room.ply").unlink(), "info room.ply"),
    "truncated": (write("room.ply", lambda data: data[:-7]), "info room.ply"),
    "exists already": (lambda: Path("room_pruned.ply").touch(), "prune room.ply"),
    "cannot write a RAD": (room, "convert room.ply room.rad"),
    "a folder without config.yml": (lambda: Path("rooms").mkdir(), "lod rooms"),
    "2D Gaussians": (
        write("flat.ply", lambda data: data.replace(b"scale_2\n", b"unknown\n")),
        "info flat.ply",
    ),
    "dropped 1 of 4": (write("room.ply", odd), "convert room.ply other.ply"),
    "not a Splatfacto run": (room, "convert room.ply other.ply --original-frame"),
    "keep is 'half'": (room, "prune room.ply --keep half"),
    "did you mean": (
        lambda: ps.save(ps.example_room(), "room.ply", overwrite=True),
        "prune room.ply --keep 10",
    ),
    "opacity weight": (room, "prune room.ply --opacity-weight 0.5"),
    "no method": (room, "prune room.ply --by magic"),
    "refiner weights": (room, "compact room.ply --refiner nothing.safetensors"),
}
"""By a part of each message: what is done to the folder of the test, and the command that then
gives the message."""


def test_every_message_has_a_command_that_gives_it():
    assert [next(part for part in TRIGGERS if part in message) for message in MESSAGES] == [
        *TRIGGERS
    ]


@pytest.mark.parametrize("part", TRIGGERS)
def test_a_message_is_given_in_these_words(part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ps.save(room(), "room.ply")
    prepare, command = TRIGGERS[part]
    prepare()
    try:
        main(command.split())
    except SystemExit as end:
        assert end.code == 1
    [message] = [message for message in MESSAGES if part in message]
    said = re.sub(r"^error: ", "", capsys.readouterr().err, flags=re.MULTILINE)
    assert any(line.startswith(message) for line in said.splitlines()), said
