"""The page of a trade as a file: what is in it, what is not, how large it is."""

import base64
import html
import io
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pointsplat_ns as ps
from html_parts import names_nothing_outside, parts_of, policy_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.tradeoff import page
from pointsplat_ns.tradeoff.page import write_sweep_page
from pointsplat_ns.tradeoff.points import picture_path
from sweeps import room_views

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(1)>\"'&</title>"


@pytest.fixture(scope="module")
def written(make_page) -> Path:
    return make_page()


def test_texts_of_strangers_are_shown_and_never_run(make_page, sweep):
    measured, _ = sweep
    points = [replace(p, label=HOSTILE, command=HOSTILE, by=HOSTILE, repair=HOSTILE) for p in measured.points]
    path = make_page(scene=HOSTILE, machine=HOSTILE, views_origin=HOSTILE, notes=(HOSTILE,), points=tuple(points))
    parts = parts_of(path)
    assert len(parts.inside["script"]) == 2 and all("onerror" not in attributes for _, attributes in parts.elements)
    assert parts.data["points"][1]["command"] == HOSTILE, "scripts read the text as it is"
    text = path.read_text("utf-8")
    assert HOSTILE not in text and "<script>alert" not in text
    assert text.count(str(html.escape(HOSTILE).replace("&quot;", "&#34;").replace("&#x27;", "&#39;"))) >= 5


def test_page_has_every_point_and_view(written, sweep):
    measured, folder = sweep
    parts, keys = parts_of(written), [p.key for p in measured.points]
    assert [a["data-key"] for tag, a in parts.elements if tag == "tr" and "data-key" in a] == keys
    assert [p["key"] for p in parts.data["points"]] == keys
    assert len(parts.data["pictures"]) == 2
    expected = {"photo", *keys, *(f"renders:{k}" for k in keys if k != "dense"), *(f"photos:{k}" for k in keys)}
    for view, shown in enumerate(parts.data["pictures"]):
        assert set(shown) == expected
        for key in ("photo", *keys):
            original = np.asarray(Image.open(picture_path(folder, view, key)), dtype=float)
            packed = np.asarray(decoded(shown[key]), dtype=float)
            assert packed.shape == (48, 64, 3) and np.abs(packed - original).mean() < 8, (
                "the noise of photos is not kept"
            )


def decoded(uri: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(uri.partition("base64,")[2], validate=True)))


def test_page_takes_no_more_bytes_than_it_may(sweep, tmp_path):
    measured, folder = sweep
    whole = write_sweep_page(measured, folder, tmp_path / "whole.html").stat().st_size
    less = write_sweep_page(measured, folder, tmp_path / "less.html", max_bytes=whole - 5_000)
    assert less.stat().st_size <= whole - 5_000 and parts_of(less).data["pictures"][1]["photo"].startswith("data:")


def test_the_recommended_scene_is_in_the_page_to_fly_through(make_page, sweep, written):
    assert parts_of(written).data["flight"] is None and "data-flight" not in written.read_text("utf-8")
    path = make_page(recommended="0.1_coverage")
    parts = parts_of(path)
    [scene] = parts.data["flight"]["scenes"]
    assert scene["name"] == "10 %, coverage" and len(scene["spz"]) > 50_000 and len(parts.data["flight"]["views"]) == 2
    assert "Fly through: 10 %, coverage" in path.read_text("utf-8")
    names_nothing_outside(path)
    assert policy_of(parts)["worker-src"] == "blob:" and "worker-src" not in policy_of(parts_of(written))
    assert path.stat().st_size < 10_000_000
    other = make_page(recommended=sweep[0].points[1].key)
    assert parts_of(other).data["flight"] is None, "it was not kept"


def test_the_dense_scene_is_beside_the_recommended_one_if_both_fit(sweep, tmp_path, monkeypatch):
    measured, folder = sweep
    shutil.copytree(folder / "scenes", tmp_path / "scenes")
    room = ps.example_room()
    frame, dense = FlightFrame.of(room, room_views()), measured.points[0]

    def names(recommended: str) -> list[str]:
        return [scene["name"] for scene in page.flight_beside(frame, tmp_path, "dense", recommended)["scenes"]]

    page.keep_scene(frame, room[::5], dense, tmp_path)
    assert names("0.1_coverage") == ["dense", "10 %, coverage"] and names("dense") == ["dense"]
    monkeypatch.setattr(page, "FLIGHT_BYTES", (tmp_path / "scenes" / "dense.json").stat().st_size)
    assert names("0.1_coverage") == ["10 %, coverage"] and names("dense") == ["dense"]
    (tmp_path / "scenes" / "dense.json").write_text('{"scenes": 1}')
    assert page.flight_beside(frame, tmp_path, "dense", "dense") is None


@pytest.mark.parametrize("most, kept", [(15_000, False), (60_000, False), (120_000, True)])
def test_scenes_that_take_too_much_of_a_page_are_not_kept(sweep, tmp_path, monkeypatch, most, kept):
    room = thinned(ps.example_room(), 3000)  # its PLY has 330 kB, and its SPZ in base64 80 kB
    monkeypatch.setattr(page, "FLIGHT_BYTES", most)
    page.keep_scene(FlightFrame.of(room, room_views()), room, sweep[0].points[0], tmp_path)
    assert (tmp_path / "scenes" / "dense.json").exists() == kept


def test_a_missing_picture_is_one_line_with_its_path(sweep, tmp_path):
    measured, folder = sweep
    broken = tmp_path / "broken"
    shutil.copytree(folder, broken)
    missing = picture_path(broken, 1, measured.points[2].key)
    missing.unlink()
    with pytest.raises(DataError, match=re.escape(f"{missing}: cannot be read (No such file or directory)")):
        write_sweep_page(measured, broken, tmp_path / "page.html")
    with pytest.raises(DataError, match="no such file; expected pictures of at least one view"):
        write_sweep_page(measured, tmp_path / "nowhere", tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()
