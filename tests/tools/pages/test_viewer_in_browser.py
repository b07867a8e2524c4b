"""``pointsplat view`` as its user has it: a command that is started, a page in headless Chromium,
Ctrl-C."""

import base64
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch

import pointsplat_ns as ps
from browser import SECONDS, before_pages_load, complaints, phone_and_colours, waited
from flying import picture, shrink
from making import REPOSITORY
from pointsplat_ns.view_sampling.upright import Up

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.by import By  # noqa: E402

pytestmark = [
    pytest.mark.usefixtures("quick"),
    pytest.mark.xdist_group("browser"),
]  # one process starts Chromium for all tests of this file

START = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # it is ignored in the background of a shell
from pointsplat_ns.cli import main
main(sys.argv[1:])
"""


@pytest.fixture(scope="module")
def program(browser, tmp_path_factory) -> Iterator[subprocess.Popen[str]]:
    """The command, looking at two scenes; a page must not run the name of the first."""
    folder = tmp_path_factory.mktemp("scenes")
    room = ps.example_room()[::20]
    ps.save(room, folder / "{1+1}<b>.ply")
    ps.save(room, folder / "other.spz")
    words = ["view", *map(str, sorted(folder.iterdir())[::-1]), "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    started = subprocess.Popen(
        [sys.executable, "-c", START, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=folder,
    )
    yield started
    started.kill()
    started.wait()


@pytest.fixture(scope="module")
def page(browser, program):
    """The page, opened at the address that the command printed."""
    assert program.stdout is not None
    line = program.stdout.readline()
    found = re.match(r"(http://127\.0\.0\.1:\d+): open it in a browser", line)
    assert found, line
    browser.get(found[1])
    waited(lambda: still(browser), "a picture")
    return browser


def text_of(browser) -> str:
    return browser.execute_script("return document.body?.innerText ?? ''")


def still(browser) -> bool:
    """Whether the full picture of what the page looks at is shown."""
    return browser.execute_script("return typeof flight !== 'undefined' && flight.still")


def keep(browser, index: int, percent: int) -> None:
    """Move the slider of a scene."""
    script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input'))"
    browser.execute_script(
        script, browser.find_elements(By.CSS_SELECTOR, "[data-kept]")[index], percent
    )


def test_a_browser_without_webgl_or_its_floats_says_so(page):
    address = page.current_url
    for owner, function in (
        ("HTMLCanvasElement", "getContext"),
        ("WebGL2RenderingContext", "getExtension"),
    ):
        with before_pages_load(page, f"{owner}.prototype.{function} = () => null;"):
            page.get(address)
            waited(lambda: "This browser offers no WebGL 2" in text_of(page), "what is missing")
    page.get(address)
    waited(lambda: still(page), "a picture")


def test_budget_changes_the_count_at_once_and_is_merged(page):
    keep(page, 0, 20)
    waited(lambda: "629 of 3,143 Gaussians" in text_of(page), "the count")
    waited(lambda: "629 of 3,143 Gaussians, merged" in text_of(page), "the merged scene")
    assert re.search(r"pointsplat prune .* --keep 20%", text_of(page))
    assert "\n3,143 Gaussians" in text_of(page), "the other scene is as it was"
    keep(page, 0, 100)


def test_ctrl_c_ends_it_without_a_traceback_and_the_page_says_so(page, program):
    program.send_signal(signal.SIGINT)
    _, errors = program.communicate(timeout=SECONDS)
    assert program.returncode == 130 and errors == "interrupted\n"
    keep(page, 0, 50)
    waited(lambda: "Has pointsplat view ended?" in text_of(page), "what happened")


def test_scene_is_chosen_or_dropped_and_shown(browser, tmp_path):
    ps.save(ps.example_room()[::20], tmp_path / "a room.spz")
    (tmp_path / "no scene.ply").write_text("nothing")
    drop = """
      const transfer = new DataTransfer(), bytes = Uint8Array.from(atob(arguments[0]), (sign) => sign.charCodeAt(0));
      transfer.items.add(new File([bytes], "dropped.spz"));
      document.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));"""
    with ps.open_viewer(port=0) as viewer:
        browser.get(viewer.url)
        complaints(browser)  # that the program of the tests above has ended
        assert phone_and_colours(browser)[0] == 360
        browser.find_element(By.ID, "file").send_keys(str(tmp_path / "no scene.ply"))
        waited(lambda: "no scene.ply: " in text_of(browser), "why it is refused")
        browser.find_element(By.ID, "file").send_keys(str(tmp_path / "a room.spz"))
        waited(lambda: "a room.spz" in text_of(browser) and still(browser), "a picture")
        assert picture(browser).std() > 0.05
        browser.execute_script(
            drop, base64.b64encode((tmp_path / "a room.spz").read_bytes()).decode()
        )
        waited(lambda: "dropped.spz" in text_of(browser) and still(browser), "the dropped scene")
        said = [line for line in complaints(browser) if "422" not in line]
        assert said == []


def test_button_and_key_turn_through_all_axes_and_name_the_one_that_is_up(browser):
    guess = Up(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), sure=False)
    for up, first in ((None, "up: +z, a guess"), ("z", "up: +z")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("pointsplat_ns.view_sampling.sampler.upright", lambda *_: guess)
            with ps.open_viewer(ps.example_room()[::20], port=0, up=up) as viewer:
                browser.get(viewer.url)
                waited(lambda: still(browser), "a picture")
                shrink(browser)
                named = browser.find_element(By.CSS_SELECTOR, "[data-flight='up']")
                assert named.text == first
    shown = [picture(browser)]
    for axis in ("-x", "-y", "-z", "+x", "+y"):
        if axis == "-y":
            browser.find_element(By.TAG_NAME, "canvas").send_keys("t")
        else:
            browser.find_element(By.CSS_SELECTOR, "[data-flight='turn']").click()
        option = browser.find_element(By.CSS_SELECTOR, "[data-flight='option']").text
        assert named.text == f"up: {axis}" and option == f"--up={axis.removeprefix('+')}"
        level, up = browser.execute_script("return [flight.camera.right, flight.camera.up]")
        assert abs(sum(a * b for a, b in zip(level, up, strict=True))) < 1e-6, (
            "the horizon is level"
        )
        browser.execute_script("flight.goTo(1); flight.goTo(0)")
        assert browser.execute_script("return flight.camera.up") == up, "views stay turned"
        shown.append(picture(browser))
        assert ps.psnr(*shown[-2:]) < 25, "dB: it is another picture"
    browser.execute_script("flight.turnUp(); flight.reset()")
    assert named.text == "up: +z" and ps.psnr(picture(browser), shown[0]) > 50
