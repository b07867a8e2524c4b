"""lab/judge/bytes.py: files of equal sizes."""

import json

import pytest

from lab.judge import bytes as judge_of_bytes
from lab.judge import camera_paths
from making import box_room
from peers import peer
from pointsplat_ns.io import write_ply


def test_files_of_equal_sizes_are_compared_and_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(camera_paths, "FOLDER", tmp_path)
    write_ply(box_room(seed=3), tmp_path / "small.ply")
    path = {"scene": "small", "about": "Walls.", "up": [0, 0, 1], "field_of_view": 60}
    (tmp_path / "small.json").write_text(json.dumps({**path, "views": [{"eye": [0.2, 0.1, 0], "at": [2, 0, 0]}]}))
    found = tmp_path / "found.json"

    def measure(**options: object) -> list[dict]:
        judge_of_bytes.main(
            (tmp_path / "small.ply",), (0.008,), ("prune .spz", "splat-transform .spz"), peer(tmp_path, "3.7.0"),
            width=96, json_path=found, **options,
        )  # fmt: skip
        return json.loads(found.read_text())["rows"]

    rows = measure(picture=tmp_path / "found.png")
    assert (tmp_path / "found.png").read_bytes().startswith(b"\x89PNG")
    ours, peers = rows
    assert 7200 <= ours["bytes"] <= 8000 and 7700 <= peers["bytes"] <= 8000 and ours["count"] > peers["count"]
    ((scene, size, what, lead),) = judge_of_bytes.leads(rows)
    assert (scene, size, what) == ("small", 0.008, "prune above splat-transform")
    assert lead == pytest.approx(ours["covered_psnr"] - peers["covered_psnr"])
    assert f"{lead:+.1f}" in capsys.readouterr().out

    def unused(*arguments: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(judge_of_bytes, "run_measured", unused)
    assert measure(resume=True) == rows
