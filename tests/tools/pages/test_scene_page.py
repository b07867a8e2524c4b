"""The page of a scene and its pictures."""

import base64
import logging
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import pointsplat_ns as ps
from html_parts import hashed, names_nothing_outside, parts_of, policy_of
from making import ball, in_pictures, views_from_within
from pointsplat_ns.scene.formats.spz import read_spz
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.tools.pages import html
from pointsplat_ns.tools.pages.flight import FLIGHT_SCRIPTS, FlightFrame
from pointsplat_ns.tools.pages.image_encoding import read_png
from pointsplat_ns.view_sampling.content import in_units, thinned
from pointsplat_ns.view_sampling.poses import look_at
from room_views import room_views

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(1)>\"'&</title>"


def scenes_in(path: Path, folder: Path) -> list[Gaussians]:
    """The scenes of a page, in the units of their content."""
    scenes = []
    for scene in parts_of(path).data["flight"]["scenes"]:
        (folder / "scene.spz").write_bytes(base64.b64decode(scene["spz"], validate=True))
        scenes.append(read_spz(folder / "scene.spz"))
    return scenes


def test_page_names_nothing_outside_and_runs_only_its_own_scripts(written):
    names_nothing_outside(written)
    parts = parts_of(written)
    assert policy_of(parts) == {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": hashed(parts.inside["style"][0]),
        "script-src": hashed(parts.inside["script"][1]),
        "worker-src": "blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }


def test_scripts_of_one_page_declare_each_name_once():
    """Else the browser runs none of them."""
    folder = Path(html.__file__).with_name("templates")
    scripts = (*FLIGHT_SCRIPTS, "live.js", "drop.js", "scene.js")
    text = "\n".join((folder / name).read_text("utf-8") for name in scripts)
    names = re.findall(r"(?m)^(?:const|let|class|(?:async )?function) (\w+)", text)
    assert len(names) > 30 and len({*names}) == len(names)


def test_texts_of_strangers_are_shown_and_never_run(tmp_path):
    scene = ball(50)
    path = ps.write_page(
        [scene, scene], tmp_path / "page.html", [HOSTILE, HOSTILE], title=HOSTILE, notes=[HOSTILE]
    )
    parts = parts_of(path)
    text = path.read_text("utf-8")
    assert len(parts.inside["script"]) == 2 and all(
        "onerror" not in attributes for _, attributes in parts.elements
    )
    assert [scene["name"] for scene in parts.data["flight"]["scenes"]] == [HOSTILE] * 2
    assert HOSTILE not in text and "<script>alert" not in text


def test_too_large_a_page_leaves_the_larger_scene_out_and_says_so(written, rooms, tmp_path, caplog):
    both = written.stat().st_size / 1e6
    path = ps.write_page(
        rooms,
        tmp_path / "less.html",
        ["dense", "compact"],
        views=room_views(),
        limit_mb=both - 0.01,
    )
    sentence = (
        f"dense is left out: with it the page would have {both:.1f} MB, more than the "
        f"{both - 0.01:g} MB allowed"
    )
    assert f'<p class="note">{sentence}.</p>' in path.read_text("utf-8") and sentence in caplog.text
    assert [len(scene) for scene in scenes_in(path, tmp_path)] == [len(rooms[1])]
    ps.write_page(
        rooms, path, ["dense", "compact"], title="room", views=room_views(), limit_mb=both + 0.01
    )
    assert path.read_bytes() == written.read_bytes()


@pytest.mark.parametrize(
    "scenes, options, error, words",
    [
        ([], {}, ps.PointSplatError, "0 scenes for .*; expected one or two"),
        (
            [ball(9)] * 2,
            {"names": ["one"]},
            ps.PointSplatError,
            "1 names for 2 scenes; expected one for each",
        ),
        (
            [ball(9)],
            {"limit_mb": 0.01},
            ps.PointSplatError,
            r"the page would have 0\.\d MB, more than the 0.01 MB",
        ),
        ([ball(9)], {"limit_mb": math.nan}, ps.PointSplatError, "a page of at most nan MB"),
        (
            [ball(9).map(lambda v: v * math.nan)],
            {},
            ps.SceneError,
            "none of the 9 Gaussians can be drawn",
        ),
        (
            [ball(9).replace(opacities=torch.full((9, 1), -math.inf))],
            {},
            ps.DataError,
            "nothing .* is visible",
        ),
        ([ball(9), ball(9)[:0]], {}, ps.SceneError, "holds no Gaussians that can be drawn"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(scenes, options, error, words, tmp_path):
    with pytest.raises(error, match=words) as caught:
        ps.write_page(scenes, tmp_path / "page.html", **options)
    assert "\n" not in str(caught.value) and list(tmp_path.iterdir()) == []


def test_what_is_very_far_away_or_has_no_meaning_is_left_out_and_counted(tmp_path, caplog):
    scene = ball(200)
    means = scene.means.clone()
    means[3] = 1e6
    means[7] = math.nan
    means[9] = torch.tensor([0.0, -1e9, 0.0])
    with caplog.at_level(logging.WARNING):
        path = ps.write_page(scene.replace(means=means), tmp_path / "page.html", ["the ball"])
    assert "the ball: 3 distant or non-finite Gaussians are left out of the page" in caplog.text
    [shown] = scenes_in(path, tmp_path)
    assert len(shown) == 197 and shown.means.abs().max() < 2047


def test_flight_begins_with_the_whole_and_leads_to_given_views():
    scene = ball(300)
    K = torch.tensor([[60.0, 0.0, 32.0], [0.0, 60.0, 20.0], [0.0, 0.0, 1.0]]).repeat(2, 1, 1)
    viewmats = look_at(
        torch.tensor([[6.0, 0.0, 0.0], [2.0, 0.0, 0.0]]),
        torch.tensor([[12.0, 0.0, 0.0], [0.0] * 3]),
    )
    views = ps.Views(viewmats, K, 64, 40, torch.tensor([1.0, 0.5, 0.0]), "antialiased")
    stage = FlightFrame.of(scene, views)
    data = stage.data([])
    assert data["drag"] == "orbit" and len(data["views"]) == 3
    whole = in_units(scene, stage.centre, stage.size).means.double()
    assert in_pictures(stage.views[:1], whole).float().mean() > 0.98, "all but stray points"
    near = data["views"][1]
    assert torch.allclose(torch.tensor(near["ahead"]), torch.tensor([-1.0, 0.0, 0.0]))
    expected = (torch.tensor([2.0, 0.0, 0.0]) - stage.centre) * 10 / stage.size
    assert torch.allclose(torch.tensor(near["eye"]), expected.float(), atol=1e-4)
    assert near["fov"] == pytest.approx(2 * math.atan(32 / 60), rel=1e-6) and near["aspect"] == 1.6
    assert data["antialiased"] is True and data["background"] == [1.0, 0.5, 0.0]
    assert data["near"] == pytest.approx(0.01 * 10 / stage.size)


def test_rooms_are_looked_around_in_and_up_is_where_cameras_have_it():
    room = thinned(ps.example_room(), 1500)
    data = FlightFrame.of(room, views_from_within((0.0, 0.0, 1.3), 2, 48, 36)).data([])
    assert data["drag"] == "look" and len(data["views"]) == 2
    upside_down = look_at(
        torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.1]]), torch.tensor([0.0, 0.0, -1.0])
    )
    K = torch.tensor([[[30.0, 0.0, 24.0], [0.0, 30.0, 18.0], [0.0, 0.0, 1.0]]])
    turned = FlightFrame.of(room, ps.Views(upside_down, K, 48, 36, torch.zeros(3)))
    assert turned.up.direction.tolist() == [0.0, 0.0, -1.0]


@pytest.mark.parametrize("content", [None, b"GIF89a", "cut", "wide"])
def test_a_picture_that_cannot_be_used_is_none(tmp_path, content):
    path = tmp_path / "a.png"
    noise = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)
    assert np.array_equal(read_png(path, 64, 48), noise)
    if content == "wide":
        Image.fromarray(noise.transpose(1, 0, 2)).save(path)
    else:
        path.write_bytes(path.read_bytes()[:200] if content == "cut" else content or b"")
    if content is None:
        path.unlink()
    assert read_png(path, 64, 48) is None
