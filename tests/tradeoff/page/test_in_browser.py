"""The page of a trade, opened from disk in headless Chromium and used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from browser import chromium, complaints, phone_and_colours
from flying import message, picture, shrink
from pointsplat_ns.tradeoff.front import fastest_above, fastest_within, next_best, pareto_front

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
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


def choose(browser, name: str, value: str) -> None:
    browser.execute_script("arguments[0].click()", one(browser, f"input[name='{name}'][value='{value}']"))


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


def press(browser, key: str) -> None:
    """Press a key wherever the focus is."""
    ActionChains(browser).send_keys(key).perform()


def test_slider_goes_along_the_front(opened, sweep):
    front = pareto_front(sweep[0].points, "frame_ms", "photos", "psnr")
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


def test_another_view_shows_the_same_point(opened):
    before = shown(opened)
    choose(opened, "view", "1")
    after = shown(opened)
    assert after["name"] == before["name"] and after["panel-photo"] == pictures_of(opened, 1)["photo"]
    assert all(after[name] != before[name] for name in before if name != "name")


def test_axes_and_references_can_be_changed(opened, sweep):
    ends = set()
    for cost in ("frame_ms", "gaussians", "bytes"):
        choose(opened, "cost", cost)
        ends.add(one(opened, ".axes .title").text)
    assert ends == {"milliseconds a frame", "Gaussians", "size of the file, MB"}
    choose(opened, "metric", "ssim")
    assert opened.find_elements(By.CSS_SELECTOR, ".axes .title")[1].text == "SSIM"
    assert not opened.find_elements(By.CSS_SELECTOR, ".axes .infinite, .axes .threshold")
    choose(opened, "metric", "psnr")
    choose(opened, "reference", "renders")
    assert opened.find_elements(By.CSS_SELECTOR, ".axes .infinite"), "the dense scene is identical to itself"
    assert len(opened.find_elements(By.CSS_SELECTOR, "#chart .point")) == len(sweep[0].points)
    one(opened, "#stop").send_keys(Keys.END)
    assert shown(opened)["name"] == "dense" and not one(opened, "#error").is_displayed()
    assert one(opened, "#no-error").is_displayed() and shown(opened)["wipe-under"] == pictures_of(opened, 0)["dense"]


def test_chart_is_used_with_the_keyboard(opened, sweep):
    order = [p.key for p in sorted(sweep[0].points, key=lambda p: p.frame_ms)]
    opened.execute_script("arguments[0].focus()", one(opened, "#chart [tabindex='0']"))
    press(opened, Keys.HOME)
    for key in order:
        focused = opened.switch_to.active_element
        assert focused.get_attribute("data-key") == key and focused.get_attribute("aria-selected") == "true"
        assert not one(opened, ".tip").get_property("hidden")
        press(opened, Keys.ARROW_RIGHT)
    front = {p.key for p in pareto_front(sweep[0].points, "frame_ms", "photos", "psnr")}
    [beaten] = [p for p in sweep[0].points if p.key not in front]
    opened.execute_script(
        "arguments[0].dispatchEvent(new Event('click'))", one(opened, f"[data-key='{beaten.key}'].point")
    )
    assert shown(opened)["name"] == f"{beaten.label} (not on the front)"


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


@pytest.mark.parametrize("db", [15, 25, 90])
def test_recommended_by_renders_is_the_one_that_python_finds(opened, sweep, db):
    choose(opened, "reference", "renders")
    write(opened, "#above", str(db))
    expected, (dense, *others) = fastest_above(sweep[0].points, db), sweep[0].points
    expected = max(others, key=lambda point: point.against_dense.psnr) if expected is dense else expected
    assert one(opened, "#recommended-command code").get_attribute("textContent") == expected.command != ""
    assert not one(opened, "#within").is_displayed()


def test_command_is_copied(opened, sweep):
    write(opened, "#within", "14")
    command = fastest_within(sweep[0].points, 14).command
    opened.execute_cdp_cmd("Browser.grantPermissions", {"permissions": ["clipboardReadWrite"]})
    button = one(opened, "#recommended-command button")
    button.click()
    read = "const done = arguments[0]; navigator.clipboard.readText().then(done, (error) => done(String(error)))"
    assert command and opened.execute_async_script(read) == command
    assert button.text == "Copied"


def test_wipe_uncovers_what_is_below(opened):
    wipe = one(opened, "#wipe-range")
    wipe.send_keys(Keys.HOME)
    clip = "return getComputedStyle(document.getElementById('wipe-over')).clipPath"
    assert opened.execute_script(clip) == "inset(0px 100% 0px 0px)"
    wipe.send_keys(Keys.END)
    assert opened.execute_script(clip) in ("inset(0px)", "inset(0px 0% 0px 0px)")


def test_table_is_sorted_and_leads_to_the_pictures(opened, sweep):
    def keys() -> list[str]:
        return [row.get_attribute("data-key") for row in opened.find_elements(By.CSS_SELECTOR, "#points tbody tr")]

    points = sweep[0].points
    [head] = [h for h in opened.find_elements(By.CSS_SELECTOR, "#points thead th") if h.text == "PSNR dB, renders"]
    head.find_element(By.TAG_NAME, "button").click()
    ascending = [p.key for p in sorted(points, key=lambda p: p.against_dense.psnr)]
    assert keys() == ascending and head.get_attribute("aria-sort") == "ascending"
    head.find_element(By.TAG_NAME, "button").click()
    assert keys() == ascending[::-1] and head.get_attribute("aria-sort") == "descending"
    one(opened, f"#points [data-key='{points[2].key}'] button").click()
    assert shown(opened)["name"].startswith(points[2].label)


def test_page_fits_a_phone_and_follows_the_colours_of_the_reader(opened):
    assert phone_and_colours(opened) == (360, ["rgb(247, 247, 245)", "rgb(18, 21, 24)"])


def test_controls_have_names(opened):
    script = """return [...document.querySelectorAll("button, input, pre, [role='option'], [role='region'], svg[role]")]
      .filter((e) => !(e.getAttribute("aria-label") || e.getAttribute("aria-labelledby")))
      .filter((e) => !(e.labels?.length || e.innerText))
      .filter((e) => !e.closest("[hidden]")).map((e) => e.outerHTML)"""
    assert opened.execute_script(script) == []


def test_page_without_photos_or_with_strange_names_works(browser, make_page, sweep):
    points = [replace(p, against_photos=None, label=HOSTILE + p.key, by=HOSTILE) for p in sweep[0].points]
    browser.get(make_page(points=tuple(points), scene=HOSTILE).as_uri())
    assert browser.title == f"{HOSTILE}: speed against accuracy"
    assert shown(browser)["name"].startswith(HOSTILE) and one(browser, "#above").is_displayed()
    one(browser, "#stop").send_keys(Keys.END)
    assert shown(browser)["name"] == HOSTILE + "dense"
    assert complaints(browser) == [] and browser.title != "run"


def test_page_of_the_dense_scene_alone_works(browser, make_page, sweep):
    browser.get(make_page(points=sweep[0].points[:1]).as_uri())
    choose(browser, "reference", "renders")
    assert shown(browser)["name"] == "dense" and len(browser.find_elements(By.CSS_SELECTOR, "#chart .point")) == 1
    assert complaints(browser) == []


def test_pointer_shows_what_a_point_is(opened, sweep):
    [mark] = opened.find_elements(By.CSS_SELECTOR, f".point[data-key='{sweep[0].points[2].key}']")
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", mark)
    ActionChains(opened).move_to_element(mark.find_element(By.CSS_SELECTOR, ".shape")).move_by_offset(1, 1).perform()
    assert one(opened, ".tip strong").text == sweep[0].points[2].label
    mark.find_element(By.CSS_SELECTOR, ".shape").click()
    assert shown(opened)["name"] == sweep[0].points[2].label
    assert one(opened, ".tip").is_displayed()


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
