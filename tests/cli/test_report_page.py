"""pointsplat report --html: an evaluation as a page."""

import html
import json
import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
from browser import chromium, complaints
from evaluations import evaluation
from html_parts import hashed, names_nothing_outside, parts_of, policy_of
from pointsplat_ns.cli import main

HOSTILE = "<script>document.title='run'</script>\"'&"


def write(folder: Path, content: dict) -> Path:
    (folder / "eval.json").write_text(json.dumps(content))
    return folder / "eval.json"


@pytest.fixture()
def page(tmp_path) -> Path:
    main(["report", str(write(tmp_path, evaluation())), "--html", str(tmp_path / "eval.html")])
    return tmp_path / "eval.html"


def marks_of(text: str) -> list[str]:
    return re.findall(r'role="img" aria-label="(.*?)"', text)


def test_page_draws_every_scene_variant_and_value(page, capsys):
    text = page.read_text("utf-8")
    assert len(marks_of(text)) == 3 * 5, "three charts of two scenes and three averages"
    assert "a, PSNR, dB: dense 30.00, pruned 20.00, refined 25.00" in marks_of(text)
    assert "b (never seen), LPIPS, less is better: dense 0.250, pruned 0.250, refined 0.250" in marks_of(text)
    assert [
        re.findall(f"<td>{value}</td>", text) != [] for value in ("30.00", "0.900", "0.250", "1,000", "0.24", "12.0")
    ]
    assert "keep 0.1, by paper, refiner tiny" in text and "held-out photos" in text
    places_of = [float(place) for place in re.findall(r'<svg x="([\d.]+)%"', text)][:3]
    assert places_of[1] < places_of[2] < places_of[0], "the pruned scene is the worst, the dense one the best"
    assert places_of[2] == pytest.approx((places_of[0] + places_of[1]) / 2, abs=0.01)


def test_page_loads_and_runs_nothing(page):
    names_nothing_outside(page)
    parts = parts_of(page)
    assert not parts.inside["script"]
    assert policy_of(parts)["script-src"] == "'none'" and policy_of(parts)["default-src"] == "'none'"
    assert policy_of(parts)["style-src"] == hashed(parts.inside["style"][0])


def test_page_shows_names_as_they_are(tmp_path):
    content = evaluation()
    content["results"]["scenes"][HOSTILE] = content["results"]["scenes"].pop("b")
    content["results"]["settings"]["by"] = content["results"]["lpips_note"] = HOSTILE
    ps.report(write(tmp_path, content), tmp_path / "eval.html")
    text = (tmp_path / "eval.html").read_text("utf-8")
    assert "<script" not in text and html.unescape(text).count(HOSTILE) >= 6


def test_page_without_lpips_has_no_chart_of_it_and_says_why(tmp_path):
    content = evaluation(lpips=None)
    content["results"]["lpips_note"] = "no weights here"
    ps.report(write(tmp_path, content), tmp_path / "eval.html")
    text = (tmp_path / "eval.html").read_text("utf-8")
    assert not [mark for mark in marks_of(text) if "LPIPS" in mark] and "no LPIPS: no weights here" in text
    assert text.count("<td>–</td>") == 5 * 3


def test_an_existing_page_is_kept_unless_told_otherwise(page, tmp_path, capsys):
    page.write_text("mine")
    with pytest.raises(SystemExit):
        main(["report", str(tmp_path / "eval.json"), "--html", str(page)])
    shown = capsys.readouterr()
    assert page.read_text() == "mine" and "--force" in shown.err and "refined" not in shown.out
    main(["report", str(tmp_path / "eval.json"), "--html", str(page), "--force"])
    assert "refined" in page.read_text("utf-8")


def test_a_page_of_another_suffix_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["report", str(write(tmp_path, evaluation())), "--html", str(tmp_path / "eval.pdf")])
    assert "expected a name that ends in .html" in capsys.readouterr().err


def test_page_is_drawn_by_a_browser(page):
    with chromium() as browser:
        browser.get(page.as_uri())
        boxes = browser.execute_script(
            "return [...document.querySelectorAll('.dots-row svg svg path')].map((e) => {"
            "const b = e.getBoundingClientRect(); return [b.x, b.width, b.height]})"
        )
        assert len(boxes) == 45 and all(width > 5 and height > 5 for _, width, height in boxes)
        assert boxes[1][0] < boxes[2][0] < boxes[0][0]
        assert complaints(browser) == []
