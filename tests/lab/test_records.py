"""Records of the lab against its programs."""

import json
from pathlib import Path

import pytest
import torch

from lab.common.printing import put_between
from lab.judge import ablation, large, record, repairs, tables_record
from lab.judge.record import FOLDER as RECORD
from lab.numerics import cases, report, stability
from lab.speed import beside, rasterizer
from making import box_room
from peers import peer
from pointsplat_ns.scene.ply import write_ply

JUDGED = RECORD / "judge.json", RECORD / "judge_photos.json"


def repairs_page(path: Path) -> str:
    content = json.loads(path.read_text("utf-8"))
    settings = content["settings"]
    return repairs.page(content["rows"], path.name, settings["views"], settings["width"])


RESULTS = ("results.json", "results_320.json")

PAGES = {
    "results.md": lambda: tables_record.page(
        [tables_record.read(RECORD / name) for name in RESULTS], RESULTS, RECORD
    ),
    "speed.md": lambda: beside.page(json.loads((RECORD / "speed.json").read_text("utf-8"))["rows"]),
    "ablation.md": lambda: ablation.page(*record.read([RECORD / "ablation.json"], "ablation.py")),
    "large.md": lambda: large.page(json.loads((RECORD / "large.json").read_text("utf-8"))["rows"]),
    "repairs.md": lambda: repairs_page(RECORD / "repairs.json"),
    "judge.md": lambda: record.page(*record.read(JUDGED)),
}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_of_the_record_is_what_its_program_writes_from_the_rows(name):
    assert PAGES[name]() == (RECORD / name).read_text("utf-8")


def test_the_table_of_the_readme_is_that_of_the_record_which_is_small():
    assert all(path.stat().st_size < 200_000 for path in JUDGED)
    rows, _ = record.read(JUDGED)
    readme = record.ROOT / "README.md"
    text = readme.read_text("utf-8")
    assert put_between(text, record.readme_table(rows), readme, record.README_TABLE) == text


def test_both_programs_are_timed_at_each_budget_and_what_is_there_is_kept(
    monkeypatch, tmp_path, capsys
):
    program = peer(tmp_path, "3.7.0")
    write_ply(box_room(0, 300), tmp_path / "room.ply")
    arguments = dict(
        keep=(0.5,), splat_transform=program, json_path=tmp_path / "speed.json", resume=True
    )
    beside.main((tmp_path / "room.ply",), **arguments)
    rows = json.loads((tmp_path / "speed.json").read_text("utf-8"))["rows"]
    assert [(row["keep"], row["method"] == beside.OURS) for row in rows] == [
        (0.5, True),
        (0.5, False),
    ]
    assert all(
        row["cpu_seconds"] > 0 and row["peak_bytes"] > 1e6 and row["gaussians"] == 300
        for row in rows
    )
    first = rows[0]["cpu_seconds"], rows[1]["cpu_seconds"]
    assert f"{first[0]:.1f}/{first[1]:.1f}={first[0] / first[1]:.2f}" in capsys.readouterr().out
    monkeypatch.setattr(beside, "rows_of", lambda *_: pytest.fail("measured again"))
    beside.main((tmp_path / "room.ply",), **arguments)


def test_a_sweep_is_written_drawn_and_tabled(monkeypatch, tmp_path, capsys):
    few = [sweep for sweep in cases.SWEEPS if sweep.name in ("needles", "precision")]
    few = [
        cases.replace(sweep, values=sweep.values[1 : 2 + (sweep.name == "precision")])
        for sweep in few
    ]
    for module in (stability, report):
        monkeypatch.setattr(module, "SWEEPS", tuple(few))
    stability.main(tmp_path, ("needles", "precision"), compiled=False)
    said = capsys.readouterr().out
    rows = json.loads((tmp_path / "stability.json").read_text())["errors"]
    assert len(rows) > 30
    assert {row["part"] for row in rows} == {"rasterizer", "scores", "merge", "refiner"}
    for picture in (tmp_path / "rasterizer.png", tmp_path / "others.png"):
        assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size < 200_000
    assert said.count("| length / width of needles") == 2 and "ours: gradient" in said
    half = [
        row
        for row in rows
        if row["value"] == torch.finfo(torch.float16).eps and row["what"] == "eager"
    ]
    assert all(1e-4 < row["error"] < 0.1 for row in half) and len(half) == 2


def test_variants_are_timed_with_their_errors(tmp_path, capsys):
    results = tmp_path / "cases.json"
    rasterizer.main((300,), ("32x24",), ("eager", "fast"), repeats=1, json=results)
    [case] = json.loads(results.read_text())["cases"]
    assert all(case["seconds"][f"fast {name}"] > 0 for name in ("inference", "forward", "backward"))
    assert case["seconds"]["blending backward"] > case["seconds"]["exponential"] > 0
    assert (
        case["errors"]["eager max"] == 0 < case["errors"]["fast max"]
        and 20 < case["errors"]["fast PSNR"] < 80
    )
    assert 32 * 24 * 300 > case["pairs"] > case["visible"] > 0 and 300 >= case["visible"]
    assert "fast / eager" in capsys.readouterr().out
