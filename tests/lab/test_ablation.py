"""lab/judge/ablation.py: which variants there are, what is measured of them, and what the record says."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from lab.judge import ablation, camera_paths, scenes, variants
from lab.judge import ablation_record as record
from making import box_room
from pointsplat_ns.io import read_scene, write_ply
from pointsplat_ns.pruning.merging import MERGING, MergeSettings, merge

PATH = {
    "scene": "small",
    "about": "The walls of a room, from its middle.",
    "up": [0, 0, 1],
    "field_of_view": 60,
    "views": [{"eye": [0.2, 0.1, 0], "at": [2, 0, 0]}, {"eye": [0, 0, 0.3], "at": [0, 1.5, 0]}],
}
TWO = ("no_regrouping", "growth_0")


@pytest.fixture()
def small(tmp_path, monkeypatch) -> Path:
    """A room of 900 Gaussians with a path of two views."""
    monkeypatch.setattr(camera_paths, "FOLDER", tmp_path)
    (tmp_path / "small.json").write_text(json.dumps(PATH))
    write_ply(box_room(seed=3), tmp_path / "small.ply")
    return tmp_path / "small.ply"


def rows_of(path: Path) -> list[dict]:
    return json.loads(path.read_text())["rows"]


def test_some_variant_changes_each_field_of_merging_and_none_changes_nothing():
    changed = {field for found in variants.MERGING.values() for field in found}
    assert changed == {field.name for field in dataclasses.fields(MergeSettings)}
    assert len({*variants.names()}) == len(variants.names()) and variants.BASELINE not in variants.names()
    for table in variants.TABLES.values():
        for name, found in table.variants.items():
            assert dataclasses.replace(table.defaults, **found) != table.defaults, name


@dataclasses.dataclass(frozen=True)
class Others:
    """Settings of something else."""

    a: int = 1
    b: int = 2


def test_a_field_of_a_settings_object_is_replaced_for_default_arguments_until_the_end():
    shared = Others()

    def total(settings: Others = shared) -> int:
        return settings.a + settings.b

    with pytest.raises(ZeroDivisionError), variants.replaced(shared, {"b": 5}):
        assert total() == 6
        1 / 0  # noqa: B018
    assert total() == 3 and shared == Others()
    with pytest.raises(TypeError, match="no_such"), variants.replaced(shared, {"no_such": 5}):
        pass


def test_a_variant_of_another_table_is_in_force_while_merging_runs(monkeypatch):
    other = variants.Table("Others", Others(), {"a_2": {"a": 2}})
    monkeypatch.setitem(variants.TABLES, "others", other)
    with variants.applied("a_2") as settings:
        assert settings is MERGING and other.defaults.a == 2
    assert other.defaults.a == 1
    assert variants.default_values()["others.a"] == 1 and variants.changes_of("a_2") == {"a": 2}


def test_every_variant_has_the_psnr_of_what_merging_makes_with_its_settings(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    ablation.main((small,), keep=(0.2,), variants=TWO, views=2, width=64, json_path=results)
    rows = rows_of(results)
    assert [row["method"] for row in rows] == ["default", *TWO]
    scene = scenes.load(small, (64,), 2)
    for row, changes in zip(rows, ({}, {"regrouping_rounds": 0}, {"growth_exponent": 0.0}), strict=True):
        merged = merge(read_scene(small), 180, settings=dataclasses.replace(MERGING, **changes)).scene
        [(_, _, expected)] = scenes.losses(scene, [merged], None)
        assert row["covered_psnr"] == expected["covered_psnr"]
        assert (row["at"], row["keep"], row["gaussians"], row["changes"]) == (64, 0.2, 900, changes)
        assert row["cpu_seconds"] > 0
    assert len({row["covered_psnr"] for row in rows}) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert all(name in said for name in TWO) and "20 %, dB" in said


def test_resume_measures_what_is_not_there_or_was_measured_with_other_values(small, tmp_path, monkeypatch):
    results = tmp_path / "rows.json"
    options = {"keep": (0.2,), "views": 1, "width": 32, "json_path": results}
    ablation.main((small,), variants=TWO, **options)
    content = json.loads(results.read_text())
    for row in content["rows"]:
        row["cpu_seconds"] = -1.0  # a time that nothing takes
    results.write_text(json.dumps(content))

    def fresh(*names: str) -> list[str]:
        ablation.main((small,), variants=names, resume=True, **options)
        return [row["method"] for row in rows_of(results) if row["cpu_seconds"] > 0]

    assert fresh(*TWO) == []
    assert fresh(*TWO, "growth_1") == ["growth_1"]
    monkeypatch.setitem(variants.MERGING, "growth_0", {"growth_exponent": 0.1})
    assert fresh(*TWO) == ["growth_0", "growth_1"]
    monkeypatch.delitem(variants.MERGING, "growth_1")
    assert len(rows_of(results)) == 4 and fresh("growth_0") == ["growth_0", "growth_1"]
    changed = dataclasses.replace(variants.TABLES["merging"], defaults=dataclasses.replace(MERGING, neighbours=99))
    monkeypatch.setitem(variants.TABLES, "merging", changed)
    said = f"was written with merging.neighbours {MERGING.neighbours}, now 99; expected the same"
    with pytest.raises(SystemExit, match=re.escape(said)):
        fresh(*TWO)


def test_a_run_is_merged_without_poses_and_with_them(trained_walls, tmp_path, monkeypatch):
    [run] = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    given, results = [], tmp_path / "rows.json"

    def recorded(scene, k, progress, views, settings):
        given.append(views)
        return merge(scene, k, progress, views, settings=settings)

    ablation.warm_up()
    monkeypatch.setattr(ablation, "merge", recorded)
    ablation.main((run,), keep=(0.5,), variants=("no_regrouping",), views=2, json_path=results)
    assert [row["at"] for row in rows_of(results)] == ["photos"] * 2 + ["photos, poses given"] * 2
    assert given[:2] == [None, None] and all(len(views) > 2 for views in given[2:])


def row(scene: str, method: str, psnr: float, seconds: float, at: int | str = 960, keep: float = 0.1) -> dict:
    known = {"scene": scene, "digest": "0", "gaussians": 1000, "at": at, "keep": keep, "method": method}
    return known | {"changes": variants.changes_of(method), "covered_psnr": psnr, "cpu_seconds": seconds}


ROWS = [
    *(row("fox", "default", 20.0, 10.0, at) for at in ("photos", record.POSES)),
    *(row("rock", "default", psnr, 10.0, keep=keep) for psnr, keep in ((30.0, 0.1), (40.0, 0.5))),
    *(row("fox", "growth_0", psnr, 12.0, at) for psnr, at in ((20.5, "photos"), (19.9, record.POSES))),
    *(row("rock", "growth_0", psnr, 12.0, keep=keep) for psnr, keep in ((29.7, 0.1), (39.96, 0.5))),
    row("rock", "no_regrouping", 29.0, 5.0),
    row("lounge", "no_regrouping", 5.0, 5.0),  # has no row of the defaults
]


def write_rows(path: Path, rows: list[dict], views: int = 8) -> Path:
    path.write_text(json.dumps({"settings": record.settings_of(views, 960), "rows": rows}))
    return path


def lines_of(text: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in text.splitlines()]


def test_the_page_has_changes_over_scenes_and_poses_at_each_budget_the_largest_loss_first():
    lines = lines_of(record.page(ROWS, record.settings_of(8, 960)))
    assert ["fox", "1,000", "held-out photos, poses given", "tuning", "20.00", "-"] in lines
    assert ["rock", "1,000", "camera path", "judged", "30.00", "40.00"] in lines
    table = lines[lines.index(["variant", "change", "10 %", "50 %", "CPU", "scenes and poses"]) + 2 :]
    first, second = table[:2]
    move = f"`regrouping_rounds` {MERGING.regrouping_rounds} to 0"
    assert first == ["`no_regrouping`", move, "-1.00 (-1.00…-1.00)", "-", "0.50", "1"]
    assert second[2:6] == ["+0.03 (-0.30…+0.50)", "-0.04 (-0.04…-0.04)", "1.20", "1 to 3"]
    assert len(table) == 2


def test_the_page_names_defaults_that_are_others_than_when_it_was_measured():
    settings = record.settings_of(8, 960)
    assert "have changed" not in record.page(ROWS, settings)
    said = record.page(ROWS, {**settings, "merging.neighbours": 99})
    assert "Defaults that have changed since: `merging.neighbours`." in said
    del settings["merging.neighbours"]  # which was no setting then
    assert "have changed" not in record.page(ROWS, settings)


def test_the_record_of_several_files_is_written_and_gives_the_same_page_again(tmp_path, capsys):
    gone = {**row("fox", "default", 1.0, 1.0), "method": "a_variant_of_before", "changes": {"neighbours": 3}}
    other = {**row("rock", "growth_1", 1.0, 1.0), "changes": {"growth_exponent": 2.0}}
    photos = write_rows(tmp_path / "a.json", [*(each for each in ROWS if each["scene"] == "fox"), gone])
    splats = write_rows(tmp_path / "b.json", [*(each for each in ROWS if each["scene"] != "fox"), other])
    folder = tmp_path / "record"
    ablation.main(write=(photos, splats), record_folder=folder)
    files = [folder / "ablation.json", folder / "ablation.md"]
    assert capsys.readouterr().out.split() == list(map(str, files))
    assert {each["method"] for each in rows_of(files[0])} == {"default", *TWO}
    page = files[1].read_text()
    assert page == record.page(ROWS, record.settings_of(8, 960))
    ablation.main(write=(files[0],), record_folder=folder)
    assert files[1].read_text() == page


def test_the_record_that_is_committed_has_the_page_of_its_rows():
    files = [record.FOLDER / "ablation.json", record.FOLDER / "ablation.md"]
    if not any(path.exists() for path in files):
        pytest.skip("nothing is recorded yet")
    rows, settings = record.read(files[:1], "ablation.py")
    assert files[1].read_text("utf-8") == record.page(rows, settings)
