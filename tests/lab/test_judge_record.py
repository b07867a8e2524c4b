"""lab/judge/record.py: which rows count, what tables say of them, and what is written."""

import json
import re
from pathlib import Path

from lab.judge import record

A, B = "splat-transform 3.7.0 -d", "splat-transform 2.7.1"


def row(scene: str, method: str, covered: float | None, at: int | str = 960, keep: float = 0.1, **more: object) -> dict:
    known = {"scene": scene, "digest": "0", "keep": keep, "method": method, "gaussians": 1000, "failed": "", "at": at}
    known |= {"count": 100, "seconds": 1.23456, "cpu_seconds": 2.0, "peak_bytes": 1_234_567_890, "views": 8}
    known |= {"covered_psnr": covered, "dense_psnr": covered, "dense_ssim": 0.9, "dense_lpips": 0.123456}
    return known | {"photo_psnr": None, "photo_ssim": None, "photo_lpips": None} | more


def scene(name: str, prune: float, compact: float, a: float, b: float, **more: object) -> list[dict]:
    figures = {"prune": prune, "compact": compact, A: a, B: b}
    return [row(name, method, psnr, **more) for method, psnr in figures.items()]


def write(path: Path, rows: list[dict], views: int = 8) -> Path:
    path.write_text(json.dumps({"settings": {"views": views, "lpips": True}, "rows": rows, "means": []}))
    return path


def lines_of(text: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in text.splitlines()]


def test_a_scene_counts_at_a_budget_once_all_ways_are_there():
    whole = scene("rock", 30.0, 31.0, 28.0, 29.0)
    half = scene("lounge", 30.0, 31.0, 28.0, 29.0)[:3]  # one mode of splat-transform is enough
    no_compact = [entry for entry in scene("diorama", 1.0, 2.0, 3.0, 4.0) if entry["method"] != "compact"]
    failed = scene("bouquet", 1.0, 2.0, 3.0, 4.0)
    failed[0] |= {"failed": "out of memory", "covered_psnr": None}
    assert record.complete([*whole, *half, *no_compact, *failed]) == [*whole, *half]


def test_the_best_mode_is_chosen_by_each_measure_and_costs_are_of_the_best_psnr():
    rows = [row("rock", A, 28.0, dense_lpips=0.1, cpu_seconds=5.0), row("rock", B, 29.0, dense_lpips=0.2)]
    [best] = record.best_peers([*rows, row("rock", "prune", 40.0)])
    assert (best["method"], best["covered_psnr"], best["dense_lpips"]) == ("splat-transform", 29.0, 0.1)
    assert best["cpu_seconds"] == 2.0 and best["photo_psnr"] is None


def test_the_readme_has_means_of_three_ways_and_the_worst_lead_over_all_widths():
    rows = scene("rock", 30.0, 31.0, 28.0, 29.0) + scene("pc_playbot", 20.0, 24.0, 18.0, 16.0)
    rows += scene("rock", 30.0, 29.0, 31.5, 29.0, at=1920) + scene("rock", 40.0, 41.0, 38.0, 39.0, keep=0.5)
    rows += scene("lounge", 25.0, 26.0, 22.0, 23.0, at="photos")
    assert lines_of(record.readme_table(rows)) == [
        ["kept", "50 %", "10 %"],
        ["---|---|---"],
        ["960 pixels wide (1 to 2 scenes)", "39.0 / 40.0 / 41.0", "23.5 / 25.0 / 27.5"],
        ["1920 pixels wide (1 scene)", "-", "31.5 / 30.0 / 29.0"],
        ["poses of held-out photos (1 scene)", "-", "23.0 / 25.0 / 26.0"],
        ["worst lead of `prune`", "+1.0 (rock, 960)", "-1.5 (rock, 1920)"],
        ["worst gain by `compact`", "+1.0 (rock, 960)", "-1.0 (rock, 1920)"],
    ]


def test_the_page_has_means_leads_costs_and_failures():
    rows = scene("rock", 30.0, 31.0, 28.0, 29.0) + scene("pc_playbot", 20.0, 24.0, 18.0, 16.0)
    rows += scene("fox", 25.0, 26.0, 22.0, 23.0, at="photos", photo_psnr=21.0)
    rows.append(row("rock", A, 0.0, keep=0.03, failed="out of memory") | {"covered_psnr": None})
    text = record.page(rows, {"views": 8, "lpips": True})
    lines = lines_of(text)
    assert ["fox", "1,000", "held-out photos", "tuning"] in lines
    means = ["23.50 (18.00 pc_playbot)", "25.00 (20.00 pc_playbot)", "27.50 (24.00 pc_playbot)"]
    assert ["10 %", *means] in lines
    assert ["10 %", "+1.50 (+1.00 rock)", "+2.50 (+1.00 rock)"] in lines
    assert ["10 %", "+0.00 (+0.00 fox)", "+0.00 (+0.00 fox)"] in lines  # against photos
    assert ["splats", "10 %", " / ".join(["2 (2)"] * 3), " / ".join(["1.23 (1.23)"] * 3)] in lines
    assert ["- rock, 3 %: splat-transform 3.7.0 -d"] in lines
    assert text.count("LPIPS against") == 1 and "PSNR against the photos" in text


def test_rows_are_split_and_rounded_and_give_the_same_tables_again(tmp_path, capsys):
    splats = write(tmp_path / "a.json", scene("rock", 30.12345, 31.0, 28.0, 29.0))
    photos = write(tmp_path / "b.json", scene("lounge", 25.0, 26.0, 22.0, 23.0, at="photos"))
    folder, readme = tmp_path / "record", tmp_path / "README.md"
    readme.write_text("before\n<!-- judge -->\nold\n<!-- /judge -->\nafter\n")
    record.main((splats, photos), folder, readme)
    assert capsys.readouterr().out.split() == [str(folder / "judge.md"), str(readme)]
    [first, *_] = json.loads((folder / "judge.json").read_text())["rows"]
    assert (first["covered_psnr"], first["seconds"], first["peak_bytes"]) == (30.123, 1.2, 1_235_000_000)
    assert {entry["at"] for entry in json.loads((folder / "judge_photos.json").read_text())["rows"]} == {"photos"}
    said = readme.read_text()
    assert re.fullmatch(r"before\n<!-- judge -->\n\n\|.*\|\n\n<!-- /judge -->\nafter\n", said, flags=re.DOTALL)
    page = (folder / "judge.md").read_text()
    record.main((folder / "judge.json", folder / "judge_photos.json"), folder, readme)
    assert (folder / "judge.md").read_text() == page and readme.read_text() == said


def test_the_record_that_is_committed_is_small_and_its_tables_are_up_to_date():
    folder = record.ROOT / "docs" / "record"
    files = [folder / "judge.json", folder / "judge_photos.json"]
    assert all(path.stat().st_size < 200_000 for path in files)
    rows, settings = record.read(files)
    assert (folder / "judge.md").read_text("utf-8") == record.page(rows, settings)
    readme = record.ROOT / "README.md"
    text = readme.read_text("utf-8")
    assert record.put_between(text, record.readme_table(rows), readme) == text
