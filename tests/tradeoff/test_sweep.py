"""Sweeps: what is kept of them whatever happens, and that their figures come out the same again."""

import csv
import json
import math

import pytest

import pointsplat_ns as ps
from pointsplat_ns.compression.repair import Repaired
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff import measuring, sweep
from pointsplat_ns.tradeoff.journal import check_journal_folder
from pointsplat_ns.tradeoff.outputs import SWEEP_FILES
from pointsplat_ns.tradeoff.points import picture_path
from pointsplat_ns.tradeoff.settings import Setting
from pointsplat_ns.tradeoff.sweep import SweepOptions


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_sweep_leaves_tables_plots_pictures_and_a_page(new_sweep, tmp_path, plain_page, monkeypatch):
    result = new_sweep(tmp_path, points=2).run()
    assert [point.key for point in result.points] == ["dense", "10pct_sh1"]
    assert names(tmp_path) == sorted([*SWEEP_FILES.every, FOLDER_FILES.sweep_points, "pictures", "scenes"])
    with (tmp_path / SWEEP_FILES.table).open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["key"] for row in rows] == [point.key for point in result.points]
    assert float(rows[1]["against_dense_psnr"]) == result.points[1].against_dense.psnr
    content = json.loads((tmp_path / "tradeoff.json").read_text())
    assert content["points"][0]["against_dense"]["psnr"] is None, "infinite"
    assert content["recommended"] == result.recommended
    assert [(tmp_path / name).read_text() for name in SWEEP_FILES.plots.values()] == [*SWEEP_FILES.plots]
    for shown in result.points:
        assert all(picture_path(tmp_path, view, shown.key).is_file() for view in range(3))
    assert names(tmp_path / "scenes") == ["10pct_sh1.json", "dense.json"]
    assert (tmp_path / SWEEP_FILES.page).read_text().split() == [point.key for point in result.points]


@pytest.mark.parametrize("after", [1, 2])
def test_an_interruption_leaves_what_was_measured_and_the_next_call_goes_on(new_sweep, tmp_path, monkeypatch, after):
    made, make = [], measuring.make

    def interrupted(dense, setting, *args):
        if len(made) == after:
            raise KeyboardInterrupt
        made.append(setting)
        return make(dense, setting, *args)

    monkeypatch.setattr(measuring, "make", interrupted)
    with pytest.raises(KeyboardInterrupt):
        new_sweep(tmp_path, points=4, repairs=("none",)).run()
    content = json.loads((tmp_path / "tradeoff.json").read_text())
    assert len(content["points"]) == 1 + after
    assert any("interrupted" in note for note in content["notes"])
    made.clear()
    monkeypatch.setattr(measuring, "make", lambda *args: (made.append(args[1]), make(*args))[1])
    resumed = new_sweep(tmp_path, points=4, repairs=("none",)).run()
    assert len(resumed.points) == 4 and len(made) == 3 - after, "nothing is measured twice"
    whole = new_sweep(tmp_path / "whole", points=4, repairs=("none",)).run()
    assert [(p.key, p.against_dense) for p in resumed.points] == [(p.key, p.against_dense) for p in whole.points]
    assert not any("interrupted" in note for note in resumed.notes)


def test_ctrl_c_during_a_repair_is_no_shorter_repair(new_sweep, tmp_path, monkeypatch):
    from pointsplat_ns.compression import compact

    monkeypatch.setattr(compact, "repair", lambda scene, *_, **others: Repaired(scene, 1, 0.1, interrupted=True))
    running = new_sweep(tmp_path)
    running.measure_dense()
    with pytest.raises(KeyboardInterrupt):
        running.measure(Setting(40, 1, "quick"))
    assert running.journal.points == {}


def test_a_point_whose_pictures_are_gone_is_measured_again(new_sweep, tmp_path):
    running = new_sweep(tmp_path, points=2)
    [_, first] = running.run().points
    picture_path(tmp_path, 1, first.key).unlink()
    [_, again] = new_sweep(tmp_path, points=2).run().points
    assert picture_path(tmp_path, 1, first.key).is_file()
    assert again.against_dense == first.against_dense


def test_held_out_photos_are_what_scenes_are_judged_by(new_sweep, tmp_path, room, room_views):
    photos = list(ps.render(ps.load(room), room_views))
    photos = [(photo + 0.05).clamp(0, 1) for photo in photos]
    result = new_sweep(tmp_path, lambda count: (room_views[:count], photos[:count]), points=2, views=2).run()
    assert result.views_origin == "held-out photos of the dataset"
    assert all(point.against_photos is not None for point in result.points)
    assert result.points[0].against_photos.psnr < 40 and result.points[0].against_dense.psnr == math.inf
    assert len(list((tmp_path / "pictures").glob("*_photo.png"))) == 2
    assert "held-out photos" in result.why


def test_where_photos_cannot_be_had_it_says_why_and_goes_on_without(new_sweep, tmp_path):
    def gone(count):
        raise DataError("photo_3.jpg: no such file")

    result = new_sweep(tmp_path, gone, points=2).run()
    assert result.points[1].against_photos is None and result.views_origin == "given views"
    assert "there are no held-out photos: photo_3.jpg: no such file" in result.notes


def test_points_of_another_scene_are_refused_before_anything_is_measured(new_sweep, tmp_path, room, room_views):
    new_sweep(tmp_path, points=2).run()
    dense = ps.load(room)
    other = measuring.Subject(dense, room, "room", "another sum", lambda: ViewSource(dense, given=room_views))
    with pytest.raises(SceneError, match="its points are of another sweep"):
        sweep.Sweep(other, tmp_path, SweepOptions(), lambda what, share: None)


def test_results_without_points_are_not_overwritten(tmp_path):
    (tmp_path / SWEEP_FILES.table).write_text("precious")
    with pytest.raises(SceneError, match="exists already, without points.json"):
        check_journal_folder(
            tmp_path, FOLDER_FILES.sweep_points, SWEEP_FILES.every, False, [tmp_path / SWEEP_FILES.table]
        )
    check_journal_folder(tmp_path, FOLDER_FILES.sweep_points, SWEEP_FILES.every, True, [tmp_path / SWEEP_FILES.table])
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    "options, said",
    [
        ({"points": 1}, "1 points; expected at least 2"),
        ({"within": 0.0}, "a loss of 0 dB"),
        ({"within": math.nan}, "a loss of nan dB"),
        ({"views": 0}, "0 views"),
        ({"methods": ()}, "no method is named"),
        ({"methods": ("magic",)}, "no method is called 'magic'"),
        ({"repairs": ("magic",)}, "repairs are magic"),
    ],
)
def test_options_that_mean_nothing_are_refused(options, said):
    with pytest.raises(PointSplatError, match=said):
        SweepOptions(**options)
