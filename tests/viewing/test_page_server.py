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
from pointsplat_ns.compression.level_stream import Chunks, write_stream
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.pages.stream_page import stream_page
from pointsplat_ns.pages.web_viewer import web_viewer
from pointsplat_ns.viewing.page_server import PageServer
from pointsplat_ns.viewing.viewer import Viewer
from serving import answer
from web_viewers import read_page, small_viewer

pytestmark = pytest.mark.xdist_group("browser")


@pytest.fixture()
def folder(tmp_path) -> Path:
    """A stream with a page, and files that have nothing to do with it."""
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
        assert ("default-src 'self'" in headers.get("Content-Security-Policy", "")) is (name == "")


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
    (folder / "index.js").write_bytes(large)  # as the files are when they are asked for
    assert answer(server, "GET", "/index.js")[1] == large
    os.unlink(folder / "index.css")
    assert answer(server, "GET", "/index.css")[0] == 404 and answer(server, "GET", "/index.js")[0] == 200


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
