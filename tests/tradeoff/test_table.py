"""Sweeps: the table, what is kept of it whatever happens, and that its commands make the same scenes."""

import csv
import json
import math
import shlex
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import same_bits
from pointsplat_ns.cli import main
from pointsplat_ns.compression import repair
from pointsplat_ns.compression.optimiser import Example
from pointsplat_ns.compression.repair import Repaired
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.tradeoff import measuring
from pointsplat_ns.tradeoff.making import Subject, make, settings_of
from pointsplat_ns.tradeoff.points import DENSE, REPAIRS, RESULTS, Setting, Tradeoff, picture_path, write_points
from trades import point

TENTH = [Setting(40, 1)]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_sweep_leaves_a_table_pictures_scenes_and_a_page(new_sweep, tmp_path):
    result = new_sweep(tmp_path).run(TENTH)
    assert [point.key for point in result.points] == ["dense", "10pct_sh1"]
    assert names(tmp_path) == ["pictures", "scenes", "tradeoff.csv", "tradeoff.html", "tradeoff.json"]
    with (tmp_path / RESULTS["table"]).open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["key"] for row in rows] == [point.key for point in result.points]
    assert float(rows[1]["against_dense_psnr"]) == result.points[1].against_dense.psnr
    assert rows[1]["against_photos_psnr"] == "" and float(rows[0]["speed_median"]) == 1
    content = json.loads((tmp_path / RESULTS["json"]).read_text())
    assert content["points"][0]["against_dense"]["psnr"] is None, "infinite"
    assert content["recommended"] == result.recommended
    for shown in result.points:
        assert all(picture_path(tmp_path, view, shown.key).is_file() for view in range(3))
    assert names(tmp_path / "scenes") == ["10pct_sh1.json", "dense.json"]
    assert (tmp_path / RESULTS["page"]).read_text().split() == [point.key for point in result.points]


def test_the_table_has_each_combination_once(room):
    options = ("50%", 200, "10%"), ("merge", "opacity"), ("all", "0", "3"), ("none", "quick")
    settings = settings_of(ps.load(room), *options)
    wanted = {
        Setting(count, degree, repair, by)
        for count in (200, 40)
        for degree in (0, 1)
        for repair in ("none", "quick")
        for by in ("merge", "opacity")
    }
    assert set(settings) == wanted and len(settings) == len(wanted)


@pytest.mark.parametrize("after", [0, 2])
def test_an_interrupted_sweep_keeps_what_it_measured_and_goes_on(new_sweep, tmp_path, monkeypatch, after):
    made, table = [], [Setting(count, 1) for count in (200, 120, 40)]

    def interrupted(dense, setting, *args):
        if len(made) == after:
            raise KeyboardInterrupt
        made.append(setting)
        return make(dense, setting, *args)

    monkeypatch.setattr(measuring, "make", interrupted)
    with pytest.raises(KeyboardInterrupt):
        new_sweep(tmp_path).run(table)
    content = json.loads((tmp_path / RESULTS["json"]).read_text())
    assert len(content["points"]) == 1 + after and any("interrupted" in note for note in content["notes"])
    made.clear()
    monkeypatch.setattr(measuring, "make", lambda *args: (made.append(args[1]), make(*args))[1])
    resumed = new_sweep(tmp_path).run(table)
    assert len(resumed.points) == 4 and len(made) == 3 - after, "nothing is measured twice"
    whole = new_sweep(tmp_path / "whole").run(table)
    assert [(p.key, p.against_dense) for p in resumed.points] == [(p.key, p.against_dense) for p in whole.points]
    assert not any("interrupted" in note for note in resumed.notes)


def test_the_bar_names_the_point_and_moves_with_every_view(new_sweep, tmp_path):
    heard: dict[str, list[float]] = {}
    new_sweep(tmp_path, progress=lambda what, share: heard.setdefault(what, [0.0]).append(share)).run(TENTH)
    for number in (1, 2):
        assert heard[f"point {number} of 2: comparing"] == [0, 1], "no photos, and no LPIPS"
        assert heard[f"point {number} of 2: timing frames"] == [
            0,
            *(pytest.approx(frame / 9) for frame in range(1, 10)),
        ]
    assert any(what.startswith("point 2 of 2: by merge") for what in heard)


def test_ctrl_c_during_a_repair_is_no_shorter_repair(new_sweep, tmp_path, monkeypatch):
    from pointsplat_ns.compression import compact

    monkeypatch.setattr(compact, "repair", lambda scene, *_, **others: Repaired(scene, 1, 0.1, interrupted=True))
    with pytest.raises(KeyboardInterrupt):
        new_sweep(tmp_path).run([Setting(40, 1, "quick")])
    assert len(json.loads((tmp_path / RESULTS["json"]).read_text())["points"]) == 1


def test_a_point_whose_pictures_are_gone_is_measured_again(new_sweep, tmp_path):
    [_, first] = new_sweep(tmp_path).run(TENTH).points
    picture_path(tmp_path, 1, first.key).unlink()
    [_, again] = new_sweep(tmp_path).run(TENTH).points
    assert picture_path(tmp_path, 1, first.key).is_file() and again.against_dense == first.against_dense


def test_held_out_photos_are_what_scenes_are_judged_by(new_sweep, tmp_path, room, room_views):
    photos = [Example(view, (ps.render(ps.load(room), view) + 0.05).clamp(0, 1)) for view in room_views]
    result = new_sweep(tmp_path, lambda: photos, views=2).run(TENTH)
    assert result.views_origin == "held-out photos of the dataset" and "held-out photos" in result.why
    assert result.points[0].against_photos.psnr < 40 and result.points[0].against_dense.psnr == math.inf
    assert result.points[1].against_photos is not None
    assert len(list((tmp_path / "pictures").glob("*_photo.png"))) == 2


def test_photos_that_cannot_be_had_are_named_and_left_out(new_sweep, tmp_path):
    def gone():
        raise DataError("photo_3.jpg: no such file")

    result = new_sweep(tmp_path, gone).run(TENTH)
    assert result.points[1].against_photos is None and result.views_origin == "given views"
    assert "there are no held-out photos: photo_3.jpg: no such file" in result.notes


@pytest.fixture(scope="module")
def content(tmp_path_factory, room, room_views) -> dict:
    """The JSON of a sweep of the room."""
    folder, points = tmp_path_factory.mktemp("json"), (point(Setting(400, 1, by=DENSE), math.inf, of=400),)
    write_points(Tradeoff("room", "m", "v", 48, 36, (*points, point(Setting(40, 1), 31.25, photos=27.5))), {}, folder)
    return json.loads((folder / RESULTS["json"]).read_text())


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda content: content["points"][1].update(gaussians="many"), "gaussians is 'many'"),
        (lambda content: content["points"][1].update(gaussians=-1), "gaussians is -1"),
        (lambda content: content["points"][1].update(frame_ms=math.nan), "frame_ms is nan"),
        (lambda content: content["points"][1]["against_photos"].update(ssim="good"), "ssim is 'good'"),
        (lambda content: content["points"][1].update(repair="magic"), ""),
        (lambda content: content["points"][1].update(by="magic"), "no method is called 'magic'"),
        (lambda content: content["points"][1].pop("key"), "key"),
        (lambda content: content.pop("points"), "lacks 'points'"),
        (lambda content: content["points"].append(None), "not iterable"),
        (lambda content: content.update(version=3), "of version 3, this program's are of 6"),
        *((text, "") for text in ("", "[]", "null", "[" * 100_000, "\x00\xff")),
    ],
)
def test_a_json_of_something_else_is_refused_in_one_line(new_sweep, tmp_path, content, change, said):
    content = json.loads(json.dumps(content))
    if not isinstance(change, str):
        change(content)
    (tmp_path / RESULTS["json"]).write_text(change if isinstance(change, str) else json.dumps(content))
    with pytest.raises(SceneError, match=f"tradeoff.json: not the points of a sweep .*{said}.*--force") as refused:
        new_sweep(tmp_path)
    assert len(str(refused.value).splitlines()) == 1


def test_points_of_another_scene_are_refused_and_keys_are_not_taken_from_files(new_sweep, tmp_path):
    new_sweep(tmp_path).run(TENTH)
    with pytest.raises(SceneError, match="its points are of another sweep .scene: 'sum', now 'another'"):
        new_sweep(tmp_path, sha256="another")
    path = tmp_path / RESULTS["json"]
    path.write_text(path.read_text().replace('"key": "10pct_sh1"', '"key": "../../away"'))
    assert {point.key for point in new_sweep(tmp_path).points.values()} == {"dense", "10pct_sh1"}


def test_results_without_points_are_not_overwritten(tmp_path):
    (tmp_path / RESULTS["table"]).write_text("precious")
    with pytest.raises(SceneError, match="exists already, without tradeoff.json"):
        ps.measure_tradeoff(tmp_path / "gone.ply", tmp_path)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"keep": ("much",)}, "keep is 'much'"),
        ({"keep": ()}, "no budget or no method"),
        ({"by": ()}, "no budget or no method"),
        ({"by": ("magic",)}, "no method is called 'magic'"),
        ({"sh": ("4",)}, "sh: 4; expected some of all, 0"),
        ({"within": math.nan}, "a loss of nan dB"),
        ({"views": 0}, "0 views"),
        ({"repairs": ("magic",)}, "repairs: magic; expected some of none, refiner, quick"),
        ({"repairs": ()}, "repairs: empty"),
    ],
)
def test_options_that_mean_nothing_are_refused_before_the_scene_is_read(tmp_path, options, said):
    with pytest.raises(PointSplatError, match=said):
        ps.measure_tradeoff(tmp_path / "gone.ply", tmp_path / "out", **options)


SETTINGS = [Setting(40, 1), Setting(40, 1, "refiner"), Setting(40, 0, "quick", "paper"), Setting(40, 1, by="coverage")]


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: f"{setting.count} {setting.repair} {setting.by}")
def test_a_command_makes_the_scene_that_was_measured(setting, room, room_views, tmp_path, monkeypatch):
    monkeypatch.setitem(repair.STEPS, "quick", 2)
    monkeypatch.setattr(view_source.Sampler, "views", lambda *args, **options: room_views)
    monkeypatch.chdir(tmp_path)
    path, dense = Path("the room.ply"), ps.load(room)
    path.write_bytes(room.read_bytes())
    subject = Subject(dense, path, "room", lambda: ViewSource(dense))
    made = make(dense, setting, subject.new_views, lambda what, share: None)
    assert (len(made.scene), made.scene.sh_degree) == (setting.count, setting.sh_degree)
    program, *words = shlex.split(subject.names(setting)["command"])
    assert program == "pointsplat"
    main(words)
    written = Path(f"room_{subject.names(setting)['key']}.ply")
    assert same_bits(ps.load(written), made.scene) and written.stat().st_size == ply_bytes(
        setting.count, setting.sh_degree
    )


def test_keys_differ_and_fit_into_names_of_files(room):
    subject = Subject(ps.load(room), room, "room", lambda: None)
    repairs = [Setting(40, 1, repair) for repair in REPAIRS]
    keys = [
        subject.names(s)["key"] for s in (*repairs, Setting(40, 0), Setting(41, 1), Setting(40, 1, by="log-volume"))
    ]
    assert len(set(keys)) == len(keys)
    assert all(character.isalnum() or character in "._-" for key in keys for character in key)
