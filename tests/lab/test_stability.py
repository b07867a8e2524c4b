"""lab/numerics/stability.py: its errors, its limits, and what it writes."""

from __future__ import annotations

import json
import math

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


@pytest.mark.parametrize(
    ("make", "value", "fails"),
    [
        ("in_other_units", 1e30, True),
        ("from_the_origin", 1e7, True),
        ("needles", 1e5, True),
        ("from_the_camera", 1e6, True),
        ("as_large_as", 1e6, False),
    ],
)
def test_the_rasterizer_holds_where_the_classic_formulas_may_not(make, value, fails):
    case = getattr(cases, make)(value).rounded(torch.float32)
    truth = measures.picture(case, "reference", torch.float64)
    ours, _ = measures.errors(measures.picture(case, "eager", torch.float32), truth)
    classic, _ = measures.errors(measures.picture(case, "classic", torch.float32), truth)
    assert max(ours.values()) < 1e-4
    assert (max(classic.values()) > 0.1) == fails


def rows_of(errors, doubt=()):
    values = [10.0**i for i in range(len(errors))]
    doubts = [*doubt, *[0.0] * (len(errors) - len(doubt))]
    made = zip(values, errors, doubts, strict=True)
    return [measures.Row("", "a", "image", "s", value, error, doubt=known) for value, error, known in made]


@pytest.mark.parametrize(
    ("errors", "usual", "wanted"),
    [
        ([1e-6, 1e-6, 1e-5], 1.0, "all"),
        ([1e-6, 1e-3, 0.1, 1e-6], 1.0, "to 10"),
        ([math.inf, 1e-3, 1e-6, 0.1], 100.0, "from 10 to 100"),
        ([0.1, 1e-6, 1e-6], 1.0, "nowhere"),
    ],
)
def test_limits_end_at_the_first_error_on_either_side(errors, usual, wanted):
    sweep = cases.Sweep("s", "", tuple(10.0**i for i in range(len(errors))), cases.in_other_units, usual)
    assert report.limits(rows_of(errors), sweep) == (wanted, False)


def test_nothing_is_judged_where_the_reference_is_in_doubt():
    sweep = cases.Sweep("s", "", (1.0, 10.0, 100.0), cases.in_other_units)
    rows = rows_of([1e-6, 1e-6, 1e-6], doubt=(0, 0, 1e-2))
    assert report.limits(rows, sweep) == ("to 10", True)


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


def test_an_unknown_sweep_is_refused(tmp_path):
    with pytest.raises(SystemExit, match="no sweep depth; expected scale, origin"):
        stability.main(tmp_path, ("depth",))
