"""The page of a tradeoff: a file that needs no other, opened from disk in headless Chromium and
used."""

import html
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from browser import complaints
from html_parts import names_nothing_outside, parts_of
from pointsplat_ns.tools.pages.image_encoding import picture_uri
from pointsplat_ns.tools.tradeoff.measure_table import write_page
from pointsplat_ns.tools.tradeoff.points import Tradeoff
from trades import POINTS

pytestmark = pytest.mark.usefixtures("quick")

HOSTILE = (
    "<script>document.title='run'</script><img src=x onerror=\"document.title='run'\">\"'&</title>"
)


def written(output: Path, points=POINTS, photos: bool = True, **changed) -> Path:
    """The page of a made-up tradeoff of two views; each picture has another grey."""
    keys = [point.key for point in points] + ["photo"] * photos
    greys = [
        [np.full((24, 32, 3), 90 * view + 9 * n, np.uint8) for n in range(len(keys))]
        for view in range(2)
    ]
    pictures = [dict(zip(keys, map(picture_uri, grey), strict=True)) for grey in greys]
    points = points if photos else [replace(point, against_photos=None) for point in points]
    known = {
        "recommended": "third",
        "why": "the fastest",
        "notes": ("busy",),
        "judged_in": "2 views of 32 x 24 pixels",
    }
    texts = {"scene": "room", "machine": "a machine", "views_origin": "sampled", **known, **changed}
    write_page(Tradeoff(width=32, height=24, points=tuple(points), **texts), pictures, output)
    return output


@pytest.mark.parametrize("photos", [True, False])
def test_it_names_nothing_outside_and_has_every_figure(photos, tmp_path):
    path = written(tmp_path / "page.html", photos=photos)
    names_nothing_outside(path)
    parts = parts_of(path)
    assert [a["data-key"] for tag, a in parts.elements if tag == "tr" and "data-key" in a] == [
        p.key for p in POINTS
    ]
    assert [p["key"] for p in parts.data["points"]] == [p.key for p in POINTS] and parts.data[
        "shown"
    ] == "third"
    text = path.read_text("utf-8")
    assert (
        "<td>36.00</td>" in text
        and "<td>identical</td>" in text
        and ("<td>29.60</td>" in text) == photos
    )
    assert "make third" in text and "hardly any difference" in text
    dense = written(tmp_path / "dense.html", recommended="dense")
    assert parts_of(dense).data["shown"] == "half", "beside the dense scene stands what loses least"


def test_texts_of_strangers_are_shown_and_never_run(tmp_path):
    points = [
        replace(point, label=HOSTILE, command=HOSTILE, by=HOSTILE, repair=HOSTILE)
        for point in POINTS
    ]
    texts = dict.fromkeys(("scene", "machine", "views_origin", "why", "judged_in"), HOSTILE)
    path = written(tmp_path / "page.html", points, notes=(HOSTILE,), **texts)
    parts = parts_of(path)
    text = path.read_text("utf-8")
    assert len(parts.inside["script"]) == 2 and all(
        "onerror" not in attributes for _, attributes in parts.elements
    )
    assert parts.data["points"][1]["command"] == HOSTILE, "scripts read the text as it is"
    assert HOSTILE not in text and "<script>document" not in text
    assert (
        text.count(html.escape(HOSTILE).replace("&quot;", "&#34;").replace("&#x27;", "&#39;")) >= 8
    )


def shown(browser) -> dict[str, str]:
    """What is seen of the point that is shown."""
    ids = ("shown-name", "shown-figures", "shown-command", "wipe-left", "wipe-right")
    script = (
        "return Object.fromEntries(arguments[0].map((id) => [id, "
        "document.getElementById(id).textContent]))"
    )
    return browser.execute_script(script, ids)


@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("text", ["", HOSTILE])
def test_points_of_the_chart_and_the_table_are_looked_at(text, browser, tmp_path):
    points = [replace(point, label=text + point.label, by=text + point.by) for point in POINTS]
    path = written(tmp_path / "page.html", points, scene=text + "room")
    pictures = parts_of(path).data["pictures"]
    browser.get(path.as_uri())
    click = "document.querySelector(arguments[0]).dispatchEvent(new Event('click'))"
    sources = (
        "return ['over', 'under'].map((place) => document.getElementById(`wipe-${place}`).src)"
    )
    assert (
        shown(browser)["shown-name"] == text + "the third"
        and shown(browser)["wipe-right"] == "photo, held out"
    )
    browser.execute_script(click, "circle[data-key='tenth']")
    assert (
        "28.0 dB against photos, 30.0 dB against the dense scene, 5 times as fast"
        in shown(browser)["shown-figures"]
    )
    assert shown(browser)["shown-command"].strip() == "make tenth"
    browser.execute_script(click, "tr[data-key='half'] button")
    assert shown(browser)["wipe-left"] == text + "the half"
    browser.execute_script("document.querySelectorAll('#views input')[1].click()")
    assert browser.execute_script(sources) == [pictures[1]["half"], pictures[1]["photo"]]
    browser.execute_script("document.querySelector('[name=reference][value=renders]').click()")
    assert browser.execute_script(sources) == [pictures[1]["half"], pictures[1]["dense"]]
    circles = """return [...document.querySelectorAll("circle")].map((c) =>
      [c.dataset.key, c.cx.baseVal.value, c.cy.baseVal.value])"""
    for cost in ("frame_ms", "megabytes", "gaussians"):
        browser.execute_script(f"document.querySelector('[name=cost][value={cost}]').click()")
        found = {key: (x, y) for key, x, y in browser.execute_script(circles)}
        assert {*found} == {point.key for point in POINTS[1:]}, "the dense scene is as itself"
        assert (
            found["tenth"][0] < found["third"][0] < found["half"][0]
            and found["tenth"][1] > found["half"][1]
        )
    drawn = (
        "return [...document.images].every((image) => image.complete && image.naturalWidth === 32)"
    )
    assert browser.execute_script(drawn) and complaints(browser) == [] and browser.title != "run"


@pytest.mark.xdist_group("browser")
def test_it_fits_a_phone_and_its_table_a_laptop(browser, tmp_path):
    browser.get(written(tmp_path / "page.html").as_uri())
    found = {}
    boxes = "[document.documentElement, document.querySelector('.scroll')]"
    for width in (390, 1280):
        size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 1000}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        found[width] = browser.execute_script(
            f"return {boxes}.map((box) => [box.scrollWidth, box.clientWidth])"
        )
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert found[390][0][0] == 390 and found[1280][1][0] == found[1280][1][1], (
        "no column is cut off"
    )


@pytest.mark.xdist_group("browser")
def test_a_single_point_is_a_page_too(browser, tmp_path):
    browser.get(written(tmp_path / "page.html", POINTS[:1], recommended="dense").as_uri())
    assert shown(browser)["shown-name"] == "the dense" and complaints(browser) == []
    assert browser.execute_script("return groups") == []
