"""The page of a trade, opened from disk in headless Chromium and used."""

from collections.abc import Iterator
from dataclasses import replace

import pytest

from browser import chromium, complaints
from flying import message, picture, shrink
from pointsplat_ns.tradeoff.recommend import fastest_within, next_best

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

pytestmark = pytest.mark.xdist_group("browser")  # one process starts Chromium for all tests of this file

HOSTILE = "<script>document.title='run'</script><img src=x onerror=\"document.title='run'\">"


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def path(make_page):
    return make_page()


@pytest.fixture()
def opened(browser, path) -> Iterator:
    """The page, just opened. Nothing may be complained of while a test uses it."""
    browser.get(path.as_uri())
    yield browser
    assert complaints(browser) == []


def one(browser, selector: str):
    return browser.find_element(By.CSS_SELECTOR, selector)


def shown(browser) -> dict[str, str]:
    """What is seen of the point that is shown."""
    pictures = ("wipe-over", "wipe-under", "error", "panel-point", "panel-dense", "panel-photo")
    script = "return Object.fromEntries(arguments[0].map((id) => [id, document.getElementById(id).src]))"
    return {"name": one(browser, "#stop-name").text, **browser.execute_script(script, pictures)}


def pictures_of(browser, view: int) -> dict[str, str]:
    return browser.execute_script("return data.pictures[arguments[0]]", view)


def write(browser, selector: str, text: str) -> None:
    field = one(browser, selector)
    field.send_keys(Keys.CONTROL, "a")
    field.send_keys(text)


def front_of(points, cost: str, quality) -> list:
    """The points that no other point beats in both cost and quality, cheapest first; of equal ones the first."""
    front = []
    for point in sorted(points, key=lambda p: (getattr(p, cost), -quality(p))):
        if not front or quality(point) > quality(front[-1]):
            front.append(point)
    return front


def test_the_answer_to_a_search_comes_first_then_before_and_after_then_the_curve(browser, make_page, sweep):
    found = sweep[0].point("0.1_coverage")
    path = make_page(recommended=found.key, target="at least 20 dB", why="10 %, coverage: 21 dB")
    browser.get(path.as_uri())
    order = [section.get_attribute("aria-labelledby") for section in browser.find_elements(By.CSS_SELECTOR, "section")]
    assert order[:3] == ["recommended-title", "look-title", "front-title"]
    assert "The cheapest scene with at least 20 dB" in one(browser, "#recommended").text
    assert one(browser, "#recommended-name").text == found.label == shown(browser)["name"]
    assert one(browser, "#recommended-command code").get_attribute("textContent") == found.command
    pictures = pictures_of(browser, 0)
    assert shown(browser)["wipe-over"] == pictures[found.key] and shown(browser)["wipe-under"] == pictures["dense"]
    assert browser.find_elements(By.CSS_SELECTOR, "#within, #above") == [] == complaints(browser)


def test_a_page_that_recommends_the_dense_scene_compares_it_with_the_next_best(browser, make_page, sweep):
    browser.get(make_page(within=1e-6).as_uri())
    expected = next_best(sweep[0].points)
    assert "dense: nothing faster is good enough" in one(browser, "#recommended-name").text
    assert shown(browser)["wipe-over"] == pictures_of(browser, 0)[expected.key]


@pytest.mark.parametrize("cost", ["frame_ms", "gaussians", "bytes"])
@pytest.mark.parametrize(("reference", "metric"), [("renders", "psnr"), ("photos", "ssim"), ("photos", "lpips")])
def test_the_front_is_what_nothing_beats(browser, make_page, sweep, cost, reference, metric):
    """Two points cost the same, and one is in every way as another."""
    points = [replace(p, against_photos=replace(p.against_photos, lpips=1 / p.gaussians)) for p in sweep[0].points]
    points[2] = replace(points[2], frame_ms=points[1].frame_ms, gaussians=points[1].gaussians, bytes=points[1].bytes)
    points.append(replace(points[3], label="again"))

    def quality(point) -> float:
        value = getattr(point.against_dense if reference == "renders" else point.against_photos, metric)
        return -value if metric == "lpips" else value

    browser.get(make_page(points=tuple(points)).as_uri())
    script = "Object.assign(state, {cost: arguments[0], reference: arguments[1], metric: arguments[2]}); return front()"
    assert browser.execute_script(script, cost, reference, metric) == [p.key for p in front_of(points, cost, quality)]


def test_slider_goes_along_the_front(opened, sweep):
    front = front_of(sweep[0].points, "frame_ms", lambda point: point.against_photos.psnr)
    slider = one(opened, "#stop")
    slider.send_keys(Keys.HOME)
    for place, point in enumerate(front):
        found, pictures = shown(opened), pictures_of(opened, 0)
        assert found["name"] == point.label == slider.get_attribute("aria-valuetext")
        assert found["wipe-over"] == found["panel-point"] == pictures[point.key]
        assert found["wipe-under"] == found["panel-photo"] == pictures["photo"]
        assert found["panel-dense"] == pictures["dense"] and found["error"] == pictures[f"photos:{point.key}"]
        assert one(opened, "#shown-command code").get_attribute("textContent") == point.command
        assert one(opened, "#chart [aria-selected='true']").get_attribute("data-key") == point.key
        assert slider.get_attribute("value") == str(place)
        slider.send_keys(Keys.ARROW_RIGHT)
    assert len(front) > 2 and slider.get_attribute("value") == str(len(front) - 1)


def test_every_picture_that_is_shown_can_be_drawn(opened):
    script = "return [...document.images].filter((i) => i.src && i.naturalWidth === 0).map((i) => i.id)"
    assert opened.execute_script(script) == []
    assert opened.execute_script("return document.getElementById('wipe-over').naturalWidth") == 64


@pytest.mark.parametrize("db", [0, 0.5, 5, 14])
def test_recommended_within_some_db_is_the_one_that_python_finds(opened, sweep, db):
    write(opened, "#within", str(db))
    expected, dense = fastest_within(sweep[0].points, db), sweep[0].points[0]
    name = one(opened, "#recommended-name").text
    assert expected.label in name
    expected = next_best(sweep[0].points) if expected is dense else expected
    assert expected.label in name
    assert one(opened, "#recommended-command code").get_attribute("textContent") == expected.command != ""
    one(opened, "#recommended-show").click()
    assert shown(opened)["name"].startswith(expected.label)


def test_page_without_photos_or_with_strange_names_works(browser, make_page, sweep):
    points = [replace(p, against_photos=None, label=HOSTILE + p.key, by=HOSTILE) for p in sweep[0].points]
    browser.get(make_page(points=tuple(points), scene=HOSTILE).as_uri())
    assert browser.title == f"{HOSTILE}: speed against accuracy"
    assert shown(browser)["name"].startswith(HOSTILE) and one(browser, "#above").is_displayed()
    one(browser, "#stop").send_keys(Keys.END)
    assert shown(browser)["name"] == HOSTILE + "dense"
    assert complaints(browser) == [] and browser.title != "run"


def test_the_recommended_scene_is_flown_through_beside_all_else(browser, make_page):
    browser.get(make_page(recommended="0.1_coverage").as_uri())
    shrink(browser)
    first = picture(browser)
    assert message(browser) == "" and first.std() > 0.05
    one(browser, "#flight [aria-label='View 2']").click()
    assert (picture(browser) - first).abs().mean() > 0.02
    one(browser, "#stop").send_keys(Keys.END)
    assert shown(browser)["name"] == "dense"
    assert complaints(browser) == []
