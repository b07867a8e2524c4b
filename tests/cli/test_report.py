"""Reports, in JSON and as a page."""

import json
import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
from browser import chromium, complaints
from evaluations import WRONG, evaluation, places
from pointsplat_ns.cli import main
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.pointsplat.report import report


def test_report_shows_every_scene_and_variant(tmp_path, capsys):
    path = tmp_path / "eval.json"
    path.write_text(json.dumps(evaluation()))
    main(["report", str(path)])
    shown = capsys.readouterr().out
    rows = [line.replace("│", " ").split() for line in shown.splitlines() if "dense" in line]
    assert [row[:2] for row in rows[:2]] == [["a", "yes"], ["b", "never"]]
    assert "compared with held-out photos" in " ".join(shown.split())  # a title may be wrapped
    assert shown.count("refined") == 5 and "25.00" in shown and "1,000" in shown and "0.250" in shown


def test_results_that_are_malformed_anywhere_are_shown_or_one_error(tmp_path, capsys):
    path, refused, shown = tmp_path / "eval.json", 0, 0
    whole = evaluation()
    whole["results"]["against_dense_renders"] = {"reference": "dense renders", "average": whole["results"]["average"]}
    for place in places(whole):
        for wrong in WRONG:
            broken = json.loads(json.dumps(whole))
            node = broken
            for key in place[:-1]:
                node = node[key]
            node[place[-1]] = wrong
            path.write_text(json.dumps(broken))
            try:
                report(path)
                shown += 1
            except DataError:
                refused += 1
    assert refused > 300 and shown > 0


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


def test_page_without_lpips_has_no_chart_of_it_and_says_why(tmp_path):
    content = evaluation(lpips=None)
    content["results"]["lpips_note"] = "no weights here"
    ps.report(write(tmp_path, content), tmp_path / "eval.html")
    text = (tmp_path / "eval.html").read_text("utf-8")
    assert not [mark for mark in marks_of(text) if "LPIPS" in mark] and "no LPIPS: no weights here" in text
    assert text.count("<td>–</td>") == 5 * 3


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
