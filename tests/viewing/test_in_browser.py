"""``pointsplat view`` as its user has it: a command that is started, a page in headless Chromium, Ctrl-C."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from PIL import Image

import pointsplat_ns as ps
from browser import chromium, complaints
from making import REPOSITORY

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

pytestmark = pytest.mark.xdist_group("browser")  # one process starts Chromium for all tests of this file

START = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # it is ignored in the background of a shell
from pointsplat_ns.cli import main
main(sys.argv[1:])
"""

SECONDS = 90
"""How long a test waits for what shall come; it takes a few on an idle machine."""


def waited(found: Callable[[], object], what: str):
    """What a function gives once it is true."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if value := found():
            return value
        time.sleep(0.1)
    pytest.fail(f"{what}: not within {SECONDS} seconds")


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def program(browser, tmp_path_factory) -> Iterator[subprocess.Popen[str]]:
    """The command, looking at a scene whose name a page must not run, and at one that is darker."""
    folder = tmp_path_factory.mktemp("scenes")
    room = ps.example_room()[::20]
    ps.save(room, folder / "{1+1}<b>.ply")
    ps.save(room.replace(features_dc=room.features_dc - 1.5), folder / "dark.spz")
    words = ["view", *map(str, sorted(folder.iterdir())[::-1]), "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    started = subprocess.Popen(
        [sys.executable, "-c", START, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment, cwd=folder,
    )  # fmt: skip
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
    waited(lambda: "ms a frame" in text_of(browser), "a picture")
    return browser


def text_of(browser) -> str:
    return browser.find_element(By.TAG_NAME, "body").text


def picture(browser) -> np.ndarray:
    """What is seen left of the panel."""
    shot = np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"))
    return shot[:, :800].astype(float)


def set_slider(browser, label: str, value: int) -> None:
    """Write into the field beside a slider."""
    field = browser.find_element(By.XPATH, f"(//label[text()='{label}']/following::input[not(@type='hidden')])[1]")
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(str(value), Keys.ENTER)


def whole(browser) -> bool:
    return bool(re.search(r"^960 x \d+, \d+ ms a frame$", text_of(browser), re.MULTILINE))


def test_picture_of_the_scene_arrives_and_becomes_whole(page):
    waited(lambda: whole(page), "the whole picture")
    waited(lambda: picture(page).std() > 10, "a picture")
    assert len(np.unique(picture(page).astype(int).reshape(-1, 3), axis=0)) > 1000
    names = text_of(page)
    assert "{1+1}<b>.ply" in names and "dark.spz" in names
    assert names.count("of 3,143 Gaussians, all") == 2


def test_wipe_moves_from_one_scene_to_the_other(page):
    def brightness(first: int, last: int) -> float:
        return picture(page)[:, first:last].mean()

    waited(lambda: whole(page), "the whole picture, whose line is at column 600")
    left, right = brightness(40, 560), brightness(640, 800)
    set_slider(page, "Wipe, %", 100)
    waited(lambda: brightness(640, 800) > 2 * right, "the first scene, which is brighter by far, on the right")
    set_slider(page, "Wipe, %", 0)
    waited(lambda: brightness(40, 560) < 0.5 * left, "the second scene on the left")
    set_slider(page, "Wipe, %", 50)


def test_budget_changes_the_count_at_once_and_is_merged(page):
    set_slider(page, "Kept, %", 20)
    waited(lambda: "629 of 3,143 Gaussians" in text_of(page), "the count")
    waited(lambda: "629 of 3,143 Gaussians, merged" in text_of(page), "the merged scene")
    assert re.search(r"pointsplat prune .* --keep 20%", text_of(page))
    assert "of 3,143 Gaussians, all" in text_of(page), "the other scene is as it was"


def test_next_view_is_another_one(page):
    waited(lambda: whole(page), "the whole picture")
    before = picture(page)
    page.find_element(By.XPATH, "//button[.='Next view']").click()
    waited(lambda: np.abs(picture(page) - before).mean() > 5, "another view")


def test_page_asked_nobody_else(page):
    spoken = complaints(page)
    assert any("googletagmanager" in line and "blocked" in line for line in spoken)
    assert not [line for line in spoken if "Uncaught" in line or "ERR_NAME_NOT_RESOLVED" in line]


def test_ctrl_c_ends_it_without_a_traceback(page, program):
    program.send_signal(signal.SIGINT)
    output, errors = program.communicate(timeout=SECONDS)
    assert program.returncode == 0 and output.rstrip().endswith("ended")
    assert errors == ""
