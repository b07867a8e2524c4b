"""lab/speed: the rasterizer, and whole commands by the number of Gaussians."""

import json
import types

import pytest

from lab.speed import commands, rasterizer
from peers import peer
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.tables.making import Reducer


def test_variants_are_timed_stage_by_stage_with_their_errors(tmp_path, capsys):
    results = tmp_path / "cases.json"
    options = {"gaussians": (300,), "sizes": ("32x24",), "variants": ("eager", "fast"), "repeats": 1, "json": results}
    rasterizer.main(rasterizer.Args(**options))
    [case] = json.loads(results.read_text())["cases"]
    assert {f"stage {name}" for name in rasterizer.STAGES} <= set(case["seconds"])
    assert all(case["seconds"][f"fast {name}"] > 0 for name in ("inference", "forward", "backward"))
    assert case["errors"]["eager max"] == 0 < case["errors"]["fast max"] and 20 < case["errors"]["fast PSNR"] < 80
    assert "in those of eager" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"variants": ("slow",)}, "no variant is called 'slow'"),
        ({"sizes": ("640",)}, "expected WIDTHxHEIGHT"),
        ({"gaussians": (0,)}, "nothing to draw"),
    ],
)
def test_what_cannot_be_timed_is_an_error(options, said):
    with pytest.raises(PointSplatError, match=said):
        rasterizer.main(rasterizer.Args(**options))


def test_each_command_is_measured_at_each_size(tmp_path, capsys):
    results = tmp_path / "rows.json"
    commands.main((2000,), ("prune",), (peer(tmp_path, "2.7.1"),), sh_degree=1, json=results)
    content = json.loads(results.read_text())
    assert [row["method"] for row in content["rows"]] == ["prune", "splat-transform 2.7.1"] * 2
    assert [(row["gaussians"], row["count"]) for row in content["rows"][::2]] == [(1000, 100), (2000, 200)]
    assert [row["file_bytes"] // row["gaussians"] for row in content["rows"]] == [104] * 4  # 26 floats
    assert [found["method"] for found in content["slopes"]] == ["prune", "splat-transform 2.7.1"]
    assert "slope of log time" in capsys.readouterr().out


def test_a_size_that_does_not_fit_is_left_out_with_the_reason(monkeypatch):
    copy = Reducer("copy", lambda source, count, target: ["cp", str(source), str(target)])
    monkeypatch.setattr(commands.shutil, "disk_usage", lambda folder: types.SimpleNamespace(total=10**9, free=10**6))
    first, large = commands.rows_of((10_000,), 3, [copy])
    assert first["failed"] == "" and first["count"] == commands.START
    assert large["failed"] == "about 0.00273 GB of disk needed, 0.001 GB free" and large["seconds"] is None
