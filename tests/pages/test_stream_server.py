"""The page beside a stream is served with the files that it needs, and nothing else; the viewer itself shows it."""

import io
import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import pointsplat_ns as ps
from browser import chromium, complaints, waited
from making import normal_scene
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io.files import open_inside
from pointsplat_ns.levels.stream import Chunks, write_stream
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.pages.stream_page import stream_page
from pointsplat_ns.pages.stream_server import PageServer
from pointsplat_ns.pages.viewer import Viewer
from pointsplat_ns.pages.web_viewer import KNOWN_FILES, WebViewerPackage, cache_folder, web_viewer
from serving import answer
from web_viewers import read_page, small_viewer, tarball

pytestmark = pytest.mark.xdist_group("browser")


@pytest.fixture()
def folder(tmp_path, monkeypatch) -> Path:
    """A stream with a page of a small viewer, and files that have nothing to do with it."""
    monkeypatch.setattr("pointsplat_ns.pages.web_viewer.KNOWN_FILES", small_viewer().digests())
    levels, parents = [normal_scene(60, seed=1), normal_scene(20, seed=2)], [torch.arange(60) % 20]
    page = stream_page(small_viewer(), levels[0], None, up_named("-y"), "a")
    write_stream(tmp_path / "a stream", levels, parents, page=page)
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "a stream" / "mine.txt").write_text("secret")
    (tmp_path / "a stream" / "0_0" / "mine.json").write_text("secret")
    return tmp_path / "a stream"


@pytest.fixture()
def server(folder) -> Iterator[PageServer]:
    with ps.open_viewer(folder, port=0) as opened:
        assert isinstance(opened, PageServer)
        yield opened


def test_all_files_of_the_stream_and_its_page_are_served_as_what_they_are(server, folder):
    kinds = {
        "": "text/html; charset=utf-8", "index.css": "text/css; charset=utf-8",
        "index.js": "text/javascript; charset=utf-8", "lod-meta.json": "application/json",
        "LICENSE.supersplat-viewer.txt": "text/plain; charset=utf-8", "1_0/meta.json": "application/json",
    }  # fmt: skip
    kinds |= {path.relative_to(folder).as_posix(): "image/webp" for path in folder.rglob("*.webp")}
    assert len(kinds) > 12
    for name, kind in kinds.items():
        status, body, headers = answer(server, "GET", f"/{name}")
        assert (status, headers["Content-Type"]) == (200, kind)
        assert body == (folder / (name or "index.html")).read_bytes()
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Content-Security-Policy"].startswith("default-src 'self'" if name == "" else "sandbox;")


@pytest.mark.parametrize(
    "path",
    ["/mine.txt", "/0_0/mine.json", "/0_0", "/0_0/", "/../secret.txt", "/%2e%2e/secret.txt", "/0_0/../../secret.txt",
     "//secret.txt", "/index.html/../lod-meta.json", "/etc/passwd"],
)  # fmt: skip
def test_nothing_else_is_served(path, server):
    status, body, _ = answer(server, "GET", path)
    assert status == 404 and body == b""


def test_the_same_requests_are_refused_as_by_the_viewer(server):
    assert answer(server, "POST", "/", b"x", Origin=server.url)[0] == 405
    assert answer(server, "GET", "/", Host="rebound.example")[0] == 403
    assert answer(server, "GET", "/lod-meta.json", Origin="http://evil.example")[0] == 403


def test_large_files_come_whole_and_missing_ones_are_missing(server, folder):
    large = np.random.default_rng(0).bytes((5 << 20) + 3)
    first, second = sorted((folder / "0_0").glob("*.webp"))[:2]
    first.write_bytes(large)  # as the files are when they are asked for
    assert answer(server, "GET", f"/0_0/{first.name}")[1] == large
    os.unlink(second)
    assert answer(server, "GET", f"/0_0/{second.name}")[0] == 404


@pytest.mark.parametrize("target", ["/dev/zero", "/proc/self/environ", "../secret.txt", "..", "gone.webp", "pipe"])
@pytest.mark.parametrize("before", [True, False])
def test_links_out_of_the_folder_and_what_has_no_end_are_not_served(target, before, folder):
    """Whether they are there when the server begins, or are put there later."""
    os.mkfifo(folder / "0_0" / "pipe")
    part = sorted((folder / "0_0").glob("*.webp"))[0]
    if before:
        part.unlink()
        part.symlink_to(Path("..") / target if target.startswith("..") else target)
    with ps.open_viewer(folder, port=0) as opened:
        if not before:
            part.unlink()
            part.symlink_to(Path("..") / target if target.startswith("..") else target)
        assert answer(opened, "GET", f"/0_0/{part.name}")[:2] == (404, b"")


def test_links_within_the_folder_are_served_and_linked_folders_elsewhere_are_not(folder, tmp_path):
    part = sorted((folder / "0_0").glob("*.webp"))[0]
    part.rename(folder / "0_0" / "kept.bin")
    part.symlink_to("kept.bin")
    elsewhere = tmp_path / "elsewhere"
    (folder / "1_0").rename(elsewhere)
    (folder / "1_0").symlink_to(elsewhere)
    with ps.open_viewer(folder, port=0) as opened:
        assert answer(opened, "GET", f"/0_0/{part.name}")[:2] == (200, part.read_bytes())
        assert answer(opened, "GET", "/1_0/meta.json")[0] == 404


def test_a_link_that_is_put_there_after_the_look_at_its_path_is_not_followed(folder, monkeypatch):
    part = sorted((folder / "0_0").glob("*.webp"))[0]
    (folder / "1_0").rename(folder / "swapped")
    (folder / "1_0").symlink_to(folder.parent)
    looked = {str(folder): str(folder), str(part): str(folder / "1_0" / "secret.txt")}  # as it was a moment ago
    monkeypatch.setattr(os.path, "realpath", lambda path: looked[str(path)])
    with pytest.raises(OSError):
        open_inside(folder, part)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("index.js", b"export", b"alert(1); export"),
        ("index.css", b"canvas", b"@import url(//evil.example);"),
        ("index.html", b"<body>", b"<body><script>alert(1)</script>"),
        ("index.html", b"<title>a</title>", b"<title></TITLE><script>alert(1)</script></title>"),
        ("index.html", b'"step"', b'"<img src=x onerror=alert(1)>"'),
        ("index.html", b"./lod-meta.json", b"//evil.example/lod-meta.json"),
        ("index.html", b'"annotations":[]', b'"annotations":[{"text":"x"}]'),
    ],
)
def test_scripts_of_a_stranger_are_not_served(name, old, new, folder, caplog):
    """Pages of this address could else read what our own viewer shows there later."""
    before = (folder / name).read_bytes()
    assert old in before
    (folder / name).write_bytes(before.replace(old, new))
    with ps.open_viewer(folder, port=0) as opened:
        assert isinstance(opened, Viewer)  # which draws the scene itself
        assert answer(opened, "GET", f"/{name}")[0] == 404 and b"flight" in answer(opened, "GET", "/")[1]
    assert "its page is not the one that this version writes" in caplog.text


def test_a_page_that_is_a_link_is_not_served(folder):
    (folder / "index.js").rename(folder.parent / "index.js")
    (folder / "index.js").symlink_to(folder.parent / "index.js")
    with ps.open_viewer(folder, port=0) as opened:
        assert isinstance(opened, Viewer)


def test_the_page_of_a_viewer_that_the_environment_names_is_served(folder, tmp_path, monkeypatch):
    (tmp_path / "viewer.tgz").write_bytes(tarball())
    monkeypatch.setattr("pointsplat_ns.pages.web_viewer.KNOWN_FILES", {})
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(tmp_path / "viewer.tgz"))
    with ps.open_viewer(folder, port=0) as opened:
        assert isinstance(opened, PageServer)


def test_the_known_files_are_those_of_the_package():
    package = WebViewerPackage()
    cached = cache_folder() and cache_folder() / package.tarball
    if not cached or not cached.is_file():
        pytest.skip("the viewer is not at hand")
    assert package.is_it(cached.read_bytes()) and web_viewer().digests() == KNOWN_FILES


@pytest.mark.parametrize(("scenes", "options"), [(["lod-meta.json"], {}), (["", ""], {"up": "z"})])
def test_what_else_is_asked_for_is_drawn_by_our_own_viewer(scenes, options, folder):
    with ps.open_viewer(*(folder / name for name in scenes), port=0, **options) as opened:
        assert isinstance(opened, Viewer) and b"flight" in answer(opened, "GET", "/")[1]


def test_a_damaged_stream_is_one_line(folder):
    (folder / "lod-meta.json").write_text("{}")
    with pytest.raises(ps.SceneError, match="lod-meta.json"):
        ps.open_viewer(folder, port=0)
    (folder / "index.html").unlink()
    with pytest.raises(ps.SceneError, match="has no page; expected a folder that"):
        PageServer(folder, "127.0.0.1", 0)


def test_the_real_viewer_shows_the_scene_upright(tmp_path, monkeypatch):
    """In Chromium, where the package is at hand: a room whose z axis is up, beside our own picture of the stream."""

    def no_network(package):
        raise PointSplatError(package.remedy)

    monkeypatch.setattr("pointsplat_ns.pages.web_viewer._downloaded", no_network)
    try:
        web_viewer()
    except PointSplatError as error:
        pytest.skip(f"the viewer is not at hand: {error}")
    with chromium() as browser:
        folder = tmp_path / "room"
        ps.lod(ps.example_room()[::4], ["100%", "10%"], up="z", folder=folder, stream=Chunks(), html=True)
        with ps.open_viewer(folder, port=0) as viewer:
            browser.get(f"{viewer.url}/?webgl&noui")
            waited(lambda: browser.execute_script("return typeof scrubTo !== 'undefined'"), "the first picture")
            settings = read_page((folder / "index.html").read_bytes())[2]["settings"]
            psnrs = []

            def whole() -> bool:  # the finest level comes a little later
                shown = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
                expected = ours(folder, settings, *shown.size)
                seen = torch.from_numpy(np.asarray(shown) / 255.0)
                psnrs[:] = [float(ps.psnr(seen, expected.flip(turn))) for turn in ([], [0], [0, 1])]
                return psnrs[0] > 27

            waited(whole, "a picture like our own")
            assert psnrs[0] > max(psnrs[1:]) + 6, "dB: it stands neither on its head nor is it mirrored"
            greetings = ("SuperSplat Viewer v", "Renderer: webgl2")
            assert [line for line in complaints(browser) if not any(words in line for words in greetings)] == []


def ours(folder: Path, settings: dict, width: int, height: int) -> torch.Tensor:
    """Our picture of a stream (height, width, 3), from where its page opens. The page turns files about z."""
    camera, world = settings["cameras"][0]["initial"], torch.tensor([-1.0, -1.0, 1.0])
    eye, target = (torch.tensor([camera[name]]) * world for name in ("position", "target"))
    focal = 0.5 * max(width, height) / math.tan(math.radians(camera["fov"]) / 2)
    K = torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]])
    background = torch.tensor(settings["background"]["color"])
    views = ps.Views(look_at(eye, target, torch.tensor([0.0, -1.0, 0.0])), K, width, height, background)
    return ps.render(ps.load(folder), views[0]).double()
