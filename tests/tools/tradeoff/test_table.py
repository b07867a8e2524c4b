"""The table: what is measured, kept and recommended, and that its commands make the same scenes."""

import itertools
import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import torch

import pointsplat_ns as ps
from making import same_bits
from pointsplat_ns.cli import main
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.pipeline import repair_budget, stages, view_provider
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.pipeline.repair import Repaired
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.tools.tradeoff import measure_table as table
from pointsplat_ns.tools.tradeoff import measuring
from pointsplat_ns.tools.tradeoff.estimate import measuring_seconds, unit_seconds
from pointsplat_ns.tools.tradeoff.measure_table import settings_of
from pointsplat_ns.tools.tradeoff.measured_scene import Subject, make
from pointsplat_ns.tools.tradeoff.measuring import views_to_judge
from pointsplat_ns.tools.tradeoff.points import DENSE, Setting
from pointsplat_ns.tools.tradeoff.recommend import (
    PHOTO_PSNR,
    expected_loss,
    fastest_within,
    recommend,
)
from pointsplat_ns.tools.wording import QUICK_NOTE
from trades import POINTS, point

pytestmark = pytest.mark.usefixtures("quick")


def test_the_figures_are_returned_and_written_beside_a_page(measured, tmp_path, monkeypatch):
    monkeypatch.setattr(measuring, "_timed", lambda scene, view: 1e-5 * len(scene))
    heard: dict[str, list[float]] = {}
    found = measured(progress=lambda what, share: heard.setdefault(what, []).append(share))
    assert [point.key for point in found.points] == ["dense", "10pct"] and found.points[
        1
    ].gaussians == 40
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "tradeoff.html",
        "tradeoff.json",
    ]
    content = json.loads((tmp_path / "out" / "tradeoff.json").read_text())
    dense, tenth = content["points"]
    assert dense["against_dense"]["psnr"] is None, "infinite" and dense["speed"]["median"] == 1
    assert (
        tenth["against_dense"]["psnr"] == found.points[1].against_dense.psnr
        and tenth["against_photos"] is None
    )
    assert (dense["frame_ms"], tenth["frame_ms"]) == pytest.approx((4.0, 0.4))
    assert [*tenth["speed"].values()] == pytest.approx([10.0, 10.0, 10.0])
    assert content["recommended"] == found.recommended
    assert heard["point 2 of 2: timing frames"] == [
        pytest.approx(frame / 9) for frame in range(1, 10)
    ]
    with pytest.raises(SceneError, match="tradeoff.json: exists already"):
        measured()
    assert measured(force=True).points[1].against_dense == found.points[1].against_dense


def test_the_table_has_each_combination_once_and_each_a_key_fit_for_a_file(room):
    dense = ps.load(room)
    settings = settings_of(
        dense, ("50%", 200, "10%", 41), ("merge", "log-volume"), ("quick", "none")
    )
    ways = itertools.product((200, 41, 40), ("none", "quick"), ("merge", "log-volume"))
    assert settings == [Setting(400, by=DENSE), *(Setting(*way) for way in ways)]
    subject = Subject(dense, room, lambda: None)
    keys = [subject.names(setting)["key"] for setting in settings]
    assert len(set(keys)) == len(keys) == 13 and all(
        re.fullmatch(r"[a-z0-9._-]+", key) for key in keys
    )


def test_the_duration_is_told_before_the_first_point(measured, monkeypatch, caplog):
    monkeypatch.setattr(measuring, "measuring_seconds", lambda settings, *_: 100.0 * len(settings))
    monkeypatch.setattr(table, "make", mock.Mock(side_effect=KeyboardInterrupt))
    with caplog.at_level("INFO"), pytest.raises(KeyboardInterrupt):
        measured()
    assert caplog.messages == [
        "measuring 2 points of 400 Gaussians takes about 3 min on this machine; --quick gives a "
        "first look"
    ]


def test_an_estimate_grows_with_the_work_and_shrinks_with_the_machine():
    dense, merged, repaired, trained = (
        Setting(50_000, by=DENSE),
        *(Setting(5_000, repair) for repair in ("none", "quick", "photos")),
    )
    alone = [
        measuring_seconds([setting], 50_000, frames=0, frame_seconds=0.0, unit=0.01)
        for setting in (dense, merged, repaired, trained)
    ]
    assert alone[0] == 0 and alone == sorted(alone)
    assert measuring_seconds([merged], 100_000, frames=0, frame_seconds=0.0, unit=0.01) > alone[1]
    two = [merged, repaired]
    slow = measuring_seconds(two, 50_000, frames=0, frame_seconds=0.0, unit=0.02)
    assert slow == pytest.approx(2 * (alone[1] + alone[2]))
    timed = measuring_seconds(two, 50_000, frames=36, frame_seconds=0.1, unit=0.02)
    assert timed - slow == pytest.approx(2 * 36 * 0.1 * 1.1)  # of the dense scene, and of a tenth
    assert 0 < unit_seconds() < 60


def test_a_quick_look_has_fewer_points_of_the_same_scenes_in_smaller_frames(measured):
    whole = measured(keep=["50%"])
    quick = measured(keep=None, repairs=None, quick=True, force=True)
    assert [point.key for point in quick.points] == ["dense", "50pct", "20pct", "5pct"]
    assert quick.points[1].against_dense == whole.points[1].against_dense
    assert quick.points[1].command == whole.points[1].command
    assert (whole.width, whole.height, quick.width, quick.height) == (48, 36, 24, 18)
    assert QUICK_NOTE in quick.notes and QUICK_NOTE not in whole.notes
    chosen = measured(keep=["10%"], repairs=["quick"], quick=True, force=True)
    assert [point.key for point in chosen.points] == ["dense", "10pct_quick"]


def test_an_interruption_keeps_what_was_measured(measured, tmp_path, monkeypatch):
    made = []

    def interrupted(subject, setting, progress):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(setting)
        return make(subject, setting, progress)

    monkeypatch.setattr(table, "make", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measured(keep=["50%", "30%", "10%"])
    content = json.loads((tmp_path / "out" / "tradeoff.json").read_text())
    assert len(content["points"]) == 3 and any("interrupted" in note for note in content["notes"])
    monkeypatch.setattr(measuring, "_timed", mock.Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        measured(force=True, keep=["20%"])
    assert json.loads((tmp_path / "out" / "tradeoff.json").read_text()) == content, (
        "no point, so nothing is written"
    )


def test_ctrl_c_during_a_repair_is_no_shorter_repair(measured, tmp_path, monkeypatch):
    monkeypatch.setattr(
        stages, "repair", lambda scene, *_, **others: Repaired(scene, 1, 0.1, interrupted=True)
    )
    with pytest.raises(KeyboardInterrupt):
        measured(repairs=["quick"])
    assert len(json.loads((tmp_path / "out" / "tradeoff.json").read_text())["points"]) == 1


def with_photos(monkeypatch, held_out) -> None:
    """Let the scene have held-out photos."""
    original = table.subject_at
    monkeypatch.setattr(
        table, "subject_at", lambda *words: replace(original(*words), held_out=held_out)
    )


def test_held_out_photos_are_what_scenes_are_judged_by(measured, room, room_views, monkeypatch):
    photos = [
        Example(view, (ps.render(ps.load(room), view) + 0.05).clamp(0, 1)) for view in room_views
    ]
    with_photos(monkeypatch, lambda: photos)
    found = measured(views=2)
    assert found.views_origin == "held-out photos of the dataset" and "held-out photos" in found.why
    assert (
        found.points[0].against_photos.psnr < 40 and found.points[0].against_dense.psnr == math.inf
    )
    assert found.points[1].against_photos.psnr < found.points[0].against_photos.psnr


def test_photos_that_cannot_be_had_are_named_and_left_out(measured, monkeypatch):
    with_photos(monkeypatch, mock.Mock(side_effect=DataError("photo_3.jpg: no such file")))
    found = measured()
    assert found.points[1].against_photos is None and found.views_origin.startswith("sampled poses")
    assert "there are no held-out photos: photo_3.jpg: no such file" in found.notes
    with pytest.raises(SceneError, match="not a nerfstudio run"):
        measured(force=True, repairs=["photos"])


def test_photos_are_reduced_with_their_views_by_the_mean_of_each_area(room, room_views):
    dense = ps.load(room)
    photo = torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.arange(48) < 25
    photos = [Example(view, photo, mask.expand(36, -1)[..., None]) for view in room_views]
    turned = Example(replace(room_views[0], width=36, height=48), photo.transpose(0, 1))
    subject = Subject(dense, room, lambda: ViewProvider(dense), lambda: [turned, *photos[1:]])
    (views, small, _), note = views_to_judge(replace(subject, resolution=(24, 18)), 3)
    assert [(view.width, view.height) for view in views] == [(18, 24), (24, 18), (24, 18)]
    assert not note and torch.equal(views.viewmats, room_views.viewmats)
    reduced = photo.reshape(18, 2, 24, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(small[0].target, reduced.transpose(0, 1), atol=1e-6)
    assert torch.allclose(small[1].target, reduced, atol=1e-6)
    assert small[1].mask.sum() == 18 * 13
    whole = views_to_judge(replace(subject, held_out=lambda: photos), 3)[0]
    assert torch.equal(whole.photos[0].target, photo) and torch.equal(whole.views.Ks, room_views.Ks)


def test_pictures_too_small_for_ssim_are_refused(measured, room_views, monkeypatch):
    views = replace(room_views, width=10)
    monkeypatch.setattr(view_provider.Sampler, "views", lambda sampler, count, *_, **options: views)
    with pytest.raises(DataError, match="views are 10 x 36 pixels; expected at least 11 per side"):
        measured()


@pytest.mark.parametrize(
    "options, said",
    [
        ({"keep": ("much",)}, "keep is 'much'"),
        ({"by": ("magic",)}, "no method is called 'magic'"),
        ({"within": math.nan}, "a loss of nan dB"),
        ({"views": 0}, "0 views"),
        ({"repairs": ("magic",)}, "repairs: magic; expected some of none, quick"),
    ],
)
def test_options_that_mean_nothing_are_refused_before_the_scene_is_read(tmp_path, options, said):
    with pytest.raises(PointSplatError, match=said):
        ps.measure_tradeoff(tmp_path / "gone.ply", tmp_path / "out", **options)


SETTINGS = [Setting(40), Setting(40, "quick", "paper"), Setting(40, by="coverage")]


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: f"{setting.repair} {setting.by}")
def test_a_command_makes_the_scene_that_was_measured(
    setting, room, room_views, tmp_path, monkeypatch
):
    monkeypatch.setitem(repair_budget.STEPS, "quick", 2)
    monkeypatch.setattr(view_provider.Sampler, "views", lambda *args, **options: room_views)
    monkeypatch.chdir(tmp_path)
    path = Path("the room.ply")
    dense = ps.load(room)
    path.write_bytes(room.read_bytes())
    subject = Subject(dense, path, lambda: ViewProvider(dense))
    (made, _) = make(subject, setting, lambda what, share: None)
    names = subject.names(setting)
    program, *words = shlex.split(names["command"])
    assert program == "pointsplat"
    main(words)
    written = Path(f"the-room_{names['key']}.ply")
    assert same_bits(ps.load(written), made) and written.stat().st_size == ply_bytes(
        setting.count, 1
    )


@pytest.mark.parametrize(
    ("loss", "key"), [(0, "dense"), (0.1, "half"), (0.49, "half"), (0.5, "third"), (3, "tenth")]
)
def test_the_fastest_that_is_good_enough(loss, key):
    assert fastest_within(POINTS, loss).key == key  # 30.1 - 29.6 is a little more than 0.5


@pytest.mark.parametrize("db, key", [(43, "dense"), (42, "half"), (35, "third"), (30, "tenth")])
def test_without_photos_the_loss_is_that_expected_of_renders(db, key):
    without = [replace(point, against_photos=None) for point in POINTS]
    assert fastest_within(without, expected_loss(db)).key == key


def test_of_two_as_fast_the_smaller_is_recommended():
    twin = replace(POINTS[3], key="twin", bytes=20)
    assert fastest_within([*POINTS, twin], 0.5).key == "twin"
    slow = replace(POINTS[1], key="few", frame_ms=1e6, gaussians=1)
    assert fastest_within([*POINTS, slow], 100, trusted=False).key == "few"
    assert fastest_within([*POINTS, slow], 100).key != "few"


def test_the_expected_loss_is_that_of_independent_errors():
    """Seed 0. The errors of 300,000 values are independent to a thousandth or so."""
    generator = torch.Generator().manual_seed(0)
    photo, of_training, of_merging = (
        torch.randn(1, 100, 1000, 3, generator=generator).double() for _ in range(3)
    )
    dense = photo + 10 ** (-PHOTO_PSNR / 20) * of_training
    small = dense + 10 ** (-33.0 / 20) * of_merging
    lost = float(ps.psnr(dense, photo) - ps.psnr(small, photo))
    assert lost == pytest.approx(expected_loss(float(ps.psnr(small, dense))), abs=0.02)


@pytest.mark.parametrize(
    "photos, loss", [((30.0, 25.0, 27.75), "loses 2.25 dB:"), ((None,) * 3, "has 30.0 dB:")]
)
def test_the_dense_scene_comes_with_the_next_best_and_its_cost(photos, loss):
    settings = (
        ("dense", 100, math.inf, photos[0], 500),
        ("poor", 5, 20.0, photos[1], 1),
        ("b", 50, 30.0, photos[2], 90),
    )
    dense, poor, other = (point(*some) for some in settings)
    best, why = recommend([dense, poor, other], 0.5)
    limit = (
        "that loses at most 0.5 dB against held-out photos"
        if photos[0]
        else "above 36.1 dB (0.5 dB of loss against photos)"
    )
    assert best is dense and why.startswith(f"no faster point {limit}")
    assert f"; the best, the b, {loss} 90 Gaussians, 0.900 kB in place of 5.00 kB, " in why
    assert "50 ms per frame in place of 100, made in 3 s" in why
    assert "the best" not in recommend([dense], 0.5)[1]
    for trusted, what in (
        (True, "fastest point"),
        (False, "smallest point"),
    ):
        best, why = recommend([dense, poor, other], 2.5, trusted)
        assert best is other and why.startswith(f"{what} ") and (" ms" in why) == trusted


def test_a_machine_is_busy_when_too_few_cores_are_left(monkeypatch):
    monkeypatch.setattr(measuring, "cores", lambda: 4)
    monkeypatch.setattr(measuring, "most_threads", lambda: 2)
    assert [bool(measuring.busy_note([others])) for others in (0.0, 2.0, 2.3, 4.0)] == [
        False,
        False,
        True,
        True,
    ]
    assert measuring.busy_note([None, 2.0]) == ""
    assert (
        "while 1 of 2 points were timed, other programs took up to 3.0 of 4"
        in measuring.busy_note([None, 2.0, 3.0])
    )
