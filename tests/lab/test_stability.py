"""lab/numerics/stability.py: its errors, its limits, and what it writes."""

import json

import pytest
import torch

from lab.numerics import cases, measures, report, stability


@pytest.mark.parametrize("name", ["usual", "antialiased"])
def test_the_classic_formulas_are_those_of_the_reference(name):
    case = cases.usual() if name == "usual" else cases.needles(10.0)
    truth = measures.picture(case, "reference", torch.float64)
    found, _ = measures.errors(measures.picture(case, "classic", torch.float64), truth)
    assert truth.pixels[..., 3].max() > 0.5
    assert max(found.values()) < 1e-10  # float64, another order


def test_a_sweep_is_written_drawn_and_tabled(monkeypatch, tmp_path, capsys):
    few = [sweep for sweep in cases.SWEEPS if sweep.name in ("needles", "precision")]
    few = [cases.replace(sweep, values=sweep.values[1:3]) for sweep in few]
    for module in (stability, report):
        monkeypatch.setattr(module, "SWEEPS", tuple(few))
    stability.main(tmp_path, ("needles", "precision"), compiled=False)
    said = capsys.readouterr().out
    rows = json.loads((tmp_path / "stability.json").read_text())["errors"]
    assert len(rows) > 50
    assert {row["part"] for row in rows} == {"rasterizer", "scores", "merge", "refiner"}
    for picture in (tmp_path / "rasterizer.png", tmp_path / "others.png"):
        assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size < 200_000
    assert said.count("| length / width of needles") == 2 and "gsplat's formulas: gradient" in said
    half = [row for row in rows if row["value"] == torch.finfo(torch.float16).eps and row["what"] == "eager"]
    assert all(1e-4 < row["error"] < 0.1 for row in half) and len(half) == 2
