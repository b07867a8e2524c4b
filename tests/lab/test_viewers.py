"""Files in the programs that open them, and the tables of the guide that say so."""

import json
import threading
import urllib.error
import urllib.request
from functools import partial
from http.server import ThreadingHTTPServer

import pytest
import torch

from documented import ROOT
from lab.common.printing import put_between
from lab.viewers import packages
from lab.viewers.browser import Handler, viewers
from lab.viewers.files import FOREIGN, KIND, Files
from lab.viewers.packages import Missing, modules
from lab.viewers.programs import PROGRAM, PROGRAMS, opened, read
from lab.viewers.subject import CAMERAS, SAME, compare, render_from, subject
from lab.viewers.tables import MARKER, tables

PAGE = ROOT / "docs" / "formats.md"
RECORD = json.loads((ROOT / "docs" / "record" / "viewers.json").read_text("utf-8"))

IN_BROWSERS = (
    ("SuperSplat viewer", "stream"),
    ("PlayCanvas", "spz4"),
    ("PlayCanvas", "glb"),
    ("three.js", "spz3"),
    ("Spark", "rad"),
    ("CesiumJS", "tiles"),
)
"""A file in each program; ``python -m lab.viewers`` opens all."""

pytestmark = [
    pytest.mark.usefixtures("quick"),
    pytest.mark.xdist_group("browser"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory, quick) -> Files:
    return Files(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="module")
def browser_of(files):
    """The pages of all viewers in a browser."""
    pytest.importorskip("selenium", reason="selenium is not installed")
    try:
        with viewers(files.folder) as opener:
            yield opener
    except Missing as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def node():
    """The packages of Node, installed."""
    try:
        modules()
    except Missing as reason:
        pytest.skip(str(reason))


@pytest.mark.parametrize("program, kind", IN_BROWSERS)
def test_a_viewer_shows_our_file_upright_and_the_same(program, kind, files, browser_of):
    row = opened(PROGRAM[program], KIND[kind], files, browser_of)
    assert row["same"], row


@pytest.mark.parametrize("kind", ["spz4", "spz3", "spz2", "sog"])
def test_splat_transform_reads_our_file_as_it_is(kind, files, node):
    row = opened(PROGRAM["splat-transform"], KIND[kind], files, None)
    assert row["same"] and row["psnr"] > 50, row  # both round to the same bits


@pytest.mark.parametrize(
    "foreign",
    [each for each in FOREIGN if each.key in ("compressed", "spz4", "folder", "glb")],
    ids=lambda each: each.key,
)
def test_a_file_of_splat_transform_is_read_as_it_reads_it(foreign, files, node):
    row = read(foreign, files, None)
    assert row["same"] and row["psnr"] > 50, row


def test_the_spz_that_spark_writes_is_read(files, browser_of):
    (foreign,) = (each for each in FOREIGN if each.page)
    row = read(foreign, files, browser_of)
    assert row["same"], row


def test_a_turn_is_found_and_lost_colours_are_not_the_same():
    scene = subject()
    camera = CAMERAS["y"]
    x, y, z = scene.means.T
    bare = scene.replace(features_rest=scene.features_rest[:, :8])
    found = compare(render_from(scene, camera), scene, camera)
    assert found.axes == ("x", "y", "z") and found.psnr > 90
    assert compare(render_from(bare, camera), scene, camera).psnr < SAME
    upside_down = scene.replace(
        means=torch.stack([x, -y, -z], dim=1),
        quats=scene.quats[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1.0, -1.0, 1.0]),
        features_rest=torch.zeros_like(scene.features_rest),
    )
    grey = scene.replace(features_rest=torch.zeros_like(scene.features_rest))
    found = compare(render_from(upside_down, camera), grey, camera)
    assert found.axes == ("x", "-y", "-z") and found.psnr > 60


def test_the_guide_has_the_tables_of_the_record():
    text = PAGE.read_text("utf-8")
    assert put_between(text, tables(RECORD), PAGE, MARKER) == text, (
        "run python -m lab.viewers --write docs/record/viewers.json docs/formats.md"
    )


def test_the_record_has_every_file_in_the_versions_that_are_pinned():
    expected = {
        (program.name, key, program.version) for program in PROGRAMS for key in program.opens
    }
    assert {(row["program"], row["file"], row["version"]) for row in RECORD["ours"]} == expected
    expected = {(each.program, each.key, PROGRAM[each.program].version) for each in FOREIGN}
    assert {(row["program"], row["file"], row["version"]) for row in RECORD["theirs"]} == expected
    assert all(row["same"] for row in (*RECORD["ours"], *RECORD["theirs"]))


def test_packages_that_cannot_be_installed_are_missing_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(packages, "FOLDER", tmp_path)
    (tmp_path / "package-lock.json").write_text("{}")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert packages._installed.__wrapped__() == (None, "Node with npm is not on the path")
    for name in ("node", "npm"):
        (tmp_path / name).write_text("#!/bin/sh\necho no such host >&2\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    assert packages._installed.__wrapped__() == (None, "npm ci failed: no such host")


def test_parts_of_files_are_served_and_nothing_beside_them(tmp_path):
    (tmp_path / "served").mkdir()
    (tmp_path / "served" / "a.bin").write_bytes(bytes(range(10)))
    (tmp_path / "secret").write_text("not served")
    handler = partial(Handler, {"files": tmp_path / "served"})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/files/"
        part = urllib.request.Request(f"{address}a.bin", headers={"Range": "bytes=3-5"})
        with urllib.request.urlopen(part, timeout=30) as answer:
            assert answer.status == 206 and answer.read() == bytes([3, 4, 5])
            assert answer.headers["Content-Range"] == "bytes 3-5/10"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{address}%2e%2e/secret", timeout=30)
        server.shutdown()
