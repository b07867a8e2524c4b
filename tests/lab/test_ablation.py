"""lab/judge/ablation.py: which variants there are, what is measured of them, and what the record says."""

import dataclasses
import json

from lab.judge import ablation, scenes
from pointsplat_ns.io import read_scene
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.merging import MERGING, merge

TWO = ("no_regrouping", "growth_0")


def test_each_field_of_merging_is_changed_by_some_variant():
    changed = {field for found in ablation.VARIANTS.values() for field in found}
    known = vars(MERGING) | vars(LOOKING)
    assert vars(MERGING).keys() <= changed <= known.keys()
    for name, found in ablation.VARIANTS.items():
        assert any(known[field] != value for field, value in found.items()), name


def test_a_variant_has_the_psnr_of_what_merging_makes_with_its_settings(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    ablation.main((small,), keep=(0.2,), variants=TWO, views=2, width=64, json_path=results)
    rows = json.loads(results.read_text())["rows"]
    assert [row["method"] for row in rows] == ["default", *TWO]
    scene = scenes.load(small, (64,), 2)
    for row, changes in zip(rows, ({}, {"regrouping_rounds": 0}, {"growth_exponent": 0.0}), strict=True):
        merged = merge(read_scene(small), 180, settings=dataclasses.replace(MERGING, **changes)).scene
        [(_, _, expected)] = scenes.losses(scene, [merged], None)
        assert row["covered_psnr"] == expected["covered_psnr"]
        assert (row["at"], row["keep"], row["gaussians"], row["changes"]) == (64, 0.2, 900, changes)
        assert row["cpu_seconds"] > 0
    assert len({row["covered_psnr"] for row in rows}) == 3
    said = capsys.readouterr().out
    assert all(name in said for name in TWO) and "| 20 % |" in said
