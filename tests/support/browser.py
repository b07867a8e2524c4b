"""A headless Chromium that opens pages from disk."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from lab.viewers import packages

SECONDS = 90
"""How long a test waits for what shall come; it takes a few on an idle machine."""


@contextmanager
def chromium() -> Iterator:
    """A browser of its own, closed at the end. The test is skipped where Chromium or its driver is
    missing."""
    pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    try:
        packages.chromium()
    except packages.Missing as reason:
        pytest.skip(f"no page can be opened: {reason}")
    arguments = [
        "--headless=new",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1200,900",
    ]
    arguments += ["--enable-unsafe-swiftshader"]  # WebGL without a GPU
    arguments += (
        ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    )  # Chromium has none for root
    with packages.browser(arguments) as browser:
        yield browser


@contextmanager
def before_pages_load(browser, script: str) -> Iterator[None]:
    """Run a script in every page before its own."""
    added = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": script})
    try:
        yield
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


def complaints(browser) -> list[str]:
    """What the browser has logged since the last call: errors of scripts, and what the policy of a
    page forbade. What a graphics driver says of its speed is left out."""
    messages = (entry["message"] for entry in browser.get_log("browser"))
    return [
        message for message in messages if "GL Driver Message (OpenGL, Performance" not in message
    ]


def phone_and_colours(browser) -> tuple[int, list[str]]:
    """How wide the open page is on a phone 360 pixels wide, and its background for readers of light
    and of dark."""
    size = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        width = browser.execute_script("return document.documentElement.scrollWidth")
        colors = []
        for scheme in ("light", "dark"):
            feature = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", feature)
            colors.append(
                browser.execute_script("return getComputedStyle(document.body).backgroundColor")
            )
        return width, colors
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def waited(found: Callable[[], object], what: str):
    """What a function gives once it is true."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if value := found():
            return value
        time.sleep(0.1)
    pytest.fail(f"{what}: not within {SECONDS} seconds")
