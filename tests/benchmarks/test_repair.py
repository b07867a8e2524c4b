"""The benchmarks of repairing and of sampled views, end to end on a painted wall."""

from __future__ import annotations

import csv
from pathlib import Path

from pointsplat_ns.compression.repair import STEPS


def wall_of(trained_walls: Path) -> Path:
    (scene,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    return scene


def test_every_repair_is_a_row_and_a_point_of_the_picture(trained_walls, tmp_path, run_benchmark, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 4)
    options = ("--keep", "50%", "--seconds", "0.1", "--fine-tune-steps", "1", "--views", "1")
    said = run_benchmark("repair", wall_of(trained_walls), *options, "--output", tmp_path / "repair.csv")
    with (tmp_path / "repair.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows] == ["merge", "fine-tune", *2 * ["Adam", "repair"]]
    assert [row["steps"] for row in rows[:4]] == ["0", "1", "4", "4"] and int(rows[5]["steps"]) >= 1
    assert all(float(row[name]) > 5 for row in rows for name in ("psnr_a", "psnr_b", "photo_psnr"))
    assert said.count("photos") == 6
    assert (tmp_path / "repair.png").read_bytes().startswith(b"\x89PNG")


def test_merging_without_poses_is_held_against_merging_with_them(trained_walls, run_benchmark):
    said = run_benchmark("sampled_views", wall_of(trained_walls), "--views", "1", "--keep", "0.5")
    assert "| wall-a | 50% |" in said and "without poses, against renders: mean" in said
