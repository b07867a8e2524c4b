"""Scenes in a page, opened from disk in headless Chromium, drawn and flown through.

Pictures are compared with those of the package's own rasterizer.
"""

import base64
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from browser import complaints, phone_and_colours, waited
from flying import camera, message, picture, settle, shrink, view_on
from making import ball, cloud
from pointsplat_ns.scene.formats.spz import read_spz
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.tools.pages.flight import FlightFrame
from pointsplat_ns.view_sampling.content import in_units
from pointsplat_ns.view_sampling.poses import look_at
from room_views import room_views

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

pytestmark = [
    pytest.mark.usefixtures("quick"),
    pytest.mark.xdist_group("flight"),
]  # one process starts Chromium for all tests of this file


@pytest.fixture()
def opened(browser, written) -> Iterator:
    """The page of both rooms, just opened and small. Nothing may be complained of while a test uses
    it."""
    browser.get(written.as_uri())
    shrink(browser)
    yield browser
    assert complaints(browser) == []


def ring_of_views(**changes) -> ps.Views:
    """Three views from around the origin, one of them from near it."""
    eyes = torch.tensor([[3.5, 0.0, 0.5], [-2.0, 2.0, 1.0], [0.3, -0.4, 0.1]])
    K = torch.tensor([[45.0, 0.0, 32.0], [0.0, 45.0, 20.0], [0.0, 0.0, 1.0]])
    viewmats = look_at(eyes, torch.tensor([[0.2, 0.1, 0.0]]).expand(3, 3))
    return replace(ps.Views(viewmats, K.repeat(3, 1, 1), 64, 40, torch.zeros(3)), **changes)


SCENES = {
    "SH degree 0": (lambda: ball(400, 0), ring_of_views(rasterize_mode="antialiased")),
    "SH degree 3": (lambda: strong_sh(cloud(400, sh_degree=3)), ring_of_views()),
    "antialiased by the scene, over grey": (
        lambda: ball(2000, 3, log_size=-4.5).replace(antialiased=True),
        ring_of_views(background=torch.tensor([0.2, 0.5, 0.7])),
    ),
    "far from the origin and small": (lambda: moved(ball(400, 1), 300.0, 1e-3), None),
    "needles": (lambda: needles(cloud(400)), ring_of_views()),
}


def strong_sh(scene: Gaussians) -> Gaussians:
    return scene.replace(features_rest=3 * scene.features_rest)


def needles(scene: Gaussians) -> Gaussians:
    return scene.replace(scales=scene.scales + torch.tensor([2.0, -2.0, -5.0]))


def moved(scene: Gaussians, by: float, scale: float) -> Gaussians:
    return scene.replace(
        means=scale * scene.means + by * scale, scales=scene.scales + np.log(scale)
    )


@pytest.mark.parametrize("name", SCENES)
def test_pictures_are_those_of_the_rasterizer(browser, tmp_path, name):
    make, views = SCENES[name]
    scene = make()
    browser.get(ps.write_page(scene, tmp_path / "scene.html", views=views).as_uri())
    shrink(browser)
    stage = FlightFrame.of(scene, views)
    (tmp_path / "scene.spz").write_bytes(base64.b64decode(stage.packed(scene, "scene")["spz"]))
    as_written = read_spz(tmp_path / "scene.spz")
    as_given = in_units(scene, stage.centre, stage.size)
    for index in range(2):
        browser.execute_script("flight.goTo(arguments[0])", index)
        shown = picture(browser)
        view = view_on(stage, index, shown)
        assert shown.std() > 0.02, "there is something in the picture"
        # Rounding to 8 bits alone leaves 58.9 dB; sums of 16-bit floats take some of that.
        assert ps.psnr(shown, ps.render(as_written, view)) > 52, index
        assert ps.psnr(shown, ps.render(as_given, view)) > 38, index
    assert complaints(browser) == []


def test_the_room_is_that_of_the_rasterizer_in_its_own_units(opened, rooms):
    stage = FlightFrame.of(rooms[0], room_views())
    own = room_views()[0]
    assert len(stage.views) == 3, "all of it, and then the two views that were given"
    opened.execute_script("flight.goTo(1)")
    for wipe, room in ((1, rooms[0]), (0, rooms[1])):
        opened.execute_script("flight.setWipe(arguments[0])", wipe)
        shown = picture(opened)
        view = replace(view_on(stage, 1, shown), viewmat=own.viewmat, near_plane=own.near_plane)
        assert (
            abs(view.width / view.height - 1.6) < 0.02
            and ps.psnr(shown, ps.render(room, view)) > 40
        )


def test_keys_go_turn_and_lead_back(opened):
    canvas = opened.find_element(By.TAG_NAME, "canvas")
    start = camera(opened)
    opened.execute_script("flight.setDrag('look')")
    for key, axis, sign in (("w", "ahead", 1), ("a", "right", -1), ("e", "down", -1)):
        canvas.send_keys("r")
        hold(opened, key)
        moved = np.subtract(camera(opened)["eye"], start["eye"])
        assert (
            sign * moved @ start[axis] == pytest.approx(np.linalg.norm(moved), rel=1e-6)
            and np.abs(moved).max() > 0
        )
    canvas.send_keys("r")
    hold(opened, Keys.ARROW_RIGHT)
    after = camera(opened)
    assert after["eye"] == start["eye"] and np.dot(after["ahead"], start["right"]) > 0
    canvas.send_keys("2")
    assert camera(opened) != start
    canvas.send_keys("r")
    assert camera(opened) == start
    canvas.send_keys("[")
    assert opened.execute_script("return flight.wipe") == pytest.approx(0.45)
    settle(opened)
    assert phone_and_colours(opened)[0] == 360, "pixels: nothing is wider than the phone"


def hold(browser, key: str) -> None:
    """Press a key until it has an effect."""
    before = camera(browser)
    ActionChains(browser).key_down(key).perform()
    waited(lambda: camera(browser) != before, key)
    ActionChains(browser).key_up(key).perform()


@pytest.mark.parametrize("drag", ["look", "orbit"])
def test_drags_move_what_is_seen_with_the_pointer(opened, drag):
    opened.execute_script("flight.setDrag(arguments[0])", drag)
    start = camera(opened)
    canvas = opened.find_element(By.TAG_NAME, "canvas")
    reach = opened.execute_script("return flight.camera.reach")
    pointer = ActionChains(opened).move_to_element_with_offset(canvas, 40, 20).click_and_hold()
    pointer.move_by_offset(20, 0).release().perform()
    after = camera(opened)
    turn = np.dot(after["ahead"], start["right"])
    if drag == "look":
        assert turn < 0 and after["eye"] == start["eye"], "the camera turns to the left"
    else:
        middles = [
            np.add(state["eye"], np.multiply(reach, state["ahead"])) for state in (start, after)
        ]
        assert turn > 0 and np.allclose(*middles), (
            "the camera goes to the left, about what is ahead"
        )
    level = [
        abs(np.dot(state["right"], opened.execute_script("return flight.camera.up")))
        for state in (start, after)
    ]
    assert level[1] == pytest.approx(level[0], abs=1e-6), "the horizon stays level"
    settle(opened)


@pytest.mark.parametrize("damage", ["cut", "garbled", "another", "no base64"])
def test_a_damaged_scene_is_one_sentence(browser, written, tmp_path, damage):
    text = written.read_text("utf-8")
    [first, *_] = re.findall(r'"spz":"([^"]*)"', text)
    packed = base64.b64decode(first)
    changed = {
        "cut": base64.b64encode(packed[: len(packed) // 2]).decode(),
        "garbled": base64.b64encode(packed[:2000] + b"garbled!" * 10 + packed[2080:]).decode(),
        "another": base64.b64encode(Path(__file__).read_bytes()).decode(),
        "no base64": "@" * 100,
    }[damage]
    (tmp_path / "damaged.html").write_text(text.replace(first, changed), encoding="utf-8")
    browser.get((tmp_path / "damaged.html").as_uri())
    browser.execute_async_script("flight.ready.then(arguments[0])")
    assert message(browser).startswith("The scene in this page is damaged: ")
    assert complaints(browser) == []
