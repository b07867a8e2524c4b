"""Finding a setting, and judging it."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, same_bits
from pointsplat_ns import folders
from pointsplat_ns.compression import repair
from pointsplat_ns.compression.optimiser import Example
from pointsplat_ns.compression.quality import decibels, quality_of_file
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.system.progress import silent as SILENT
from pointsplat_ns.tradeoff import measuring, points
from pointsplat_ns.tradeoff.making import Subject, subject_of
from pointsplat_ns.tradeoff.measuring import Measurer, views_to_judge
from pointsplat_ns.tradeoff.points import Setting
from pointsplat_ns.tradeoff.search import Targets, find_scene

SAMPLED = view_source.Sampler.views


@pytest.fixture(autouse=True)
def quick(room_views, no_lpips, monkeypatch):
    """Three small views of any scene, no repairs, which take long, and times as counts are."""
    monkeypatch.setattr(view_source.Sampler, "views", lambda sampler, count, *_, **options: room_views[:count])
    for module in (points, folders):
        monkeypatch.setattr(module, "repairs_of", lambda effort: ("none",))
    monkeypatch.setattr(measuring, "_timed", lambda scene, view: 1e-5 * len(scene))


@pytest.fixture()
def dense(room):
    return ps.load(room)


def mean_psnr(scene, dense, views) -> float:
    return float(ps.psnr(ps.render(scene, views), ps.render(dense, views)).mean())


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog"])
def test_the_file_that_is_written_has_the_quality(dense, room_views, tmp_path, suffix):
    found = ps.compact(dense, by="opacity", target_db=25.0, target_format=suffix)
    ps.save(found.scene, tmp_path / f"found{suffix}")
    assert mean_psnr(ps.load(tmp_path / f"found{suffix}"), dense, room_views) >= 25 - 1e-3  # sums in another order
    size = (tmp_path / f"found{suffix}").stat().st_size
    said = quality_of_file(dense, ViewSource(dense), found.scene, tmp_path / f"found{suffix}", suffix)
    assert said.psnr >= 25 and f": {decibels(said.psnr)} against the dense scene in 3 views of 48 x 36" in found.target
    assert f", {bytes_text(size)}, {len(found.scene):,} Gaussians" in found.target
    assert "the next cheaper, " in found.target and "dB, less than 25 dB" in found.target


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog"])
def test_the_file_that_is_written_fits_and_leaves_little_unused(dense, tmp_path, suffix):
    ps.save(dense, tmp_path / f"whole{suffix}")
    limit = 0.5e-6 * (tmp_path / f"whole{suffix}").stat().st_size
    found = ps.compact(dense, by="opacity", target_mb=limit, target_format=suffix)
    ps.save(found.scene, tmp_path / f"found{suffix}")
    assert 0.8 * limit < (tmp_path / f"found{suffix}").stat().st_size / 1e6 <= limit


def test_it_is_the_scene_that_a_sweep_finds(room, tmp_path, plain_page, monkeypatch):
    monkeypatch.setattr(points, "repairs_of", lambda effort: ("none", effort))
    monkeypatch.setitem(repair.STEPS, "quick", 2)
    targets = {"target_mb": 0.01}
    sweep = ps.measure_tradeoff(room, tmp_path, **targets)
    [written] = tmp_path.glob("*.ply")
    found = ps.compact(room, **targets)
    assert same_bits(found.scene, ps.load(written))
    assert found.target.split(":")[0] == sweep.why.split(":")[0]


@pytest.mark.parametrize(
    ("search", "resolution"), [("compact", None), ("compact_folder", "96x54"), ("measure_tradeoff", "96x54")]
)
def test_scenes_are_judged_in_the_views_that_compact_compares_in(
    room, tmp_path, plain_page, monkeypatch, resolution, search
):
    monkeypatch.setattr(
        view_source.Sampler, "views", lambda sampler, count, *_, **options: SAMPLED(sampler, min(count, 3))
    )
    monkeypatch.setattr(view_source, "RESOLUTION", (512, 384))  # which decisions are made at, if nothing is asked for
    wanted = ps.compact(room, 0.5, by="opacity", effort="instant", resolution=resolution).views
    judged = []

    def watched(*args):
        judged.append(views_to_judge(*args))
        return judged[-1]

    monkeypatch.setattr(measuring, "views_to_judge", watched)
    options = {"resolution": resolution, "target_mb": 0.01, "by": "opacity"}
    if search == "measure_tradeoff":
        ps.measure_tradeoff(room, tmp_path / "found", **{**options, "by": ("opacity",)}, repairs=("none",))
    else:
        ps.save(ps.load(room), tmp_path / "rooms" / "room.ply")
        of = room if search == "compact" else tmp_path / "rooms"
        getattr(ps, search)(of, **options)
    [((views, _, _), _)] = judged
    assert (views.width, views.height) == (wanted.width, wanted.height)
    assert views.viewmats.equal(wanted.viewmats) and views.Ks.equal(wanted.Ks)
    assert max(views.width, views.height) == (405 if resolution is None else 96)


def test_a_scene_that_needs_no_repair_is_given_as_it_was_pruned(dense, tmp_path):
    found = find_scene(subject_of(dense, None), Targets(mb=0.01), "opacity", ("none",), SILENT)
    assert found.scene is found.pruned and not found.accepted and not found.repair_accepted
    assert found.psnr > 10 and len(found.views) == 3 and found.seconds > 0
    assert "side by side" in ps.plot_comparison(dense, found, tmp_path / "shown.png")


@pytest.mark.parametrize("after, found", [(0, False), (9, True)])
def test_ctrl_c_gives_the_best_so_far(dense, monkeypatch, after, found):
    measure, points = Measurer.measure, []

    def interrupted(self, *args):
        if sum(point.against_dense.psnr >= 20 for point in points) > 0 or len(points) == after:
            raise KeyboardInterrupt
        points.append(measure(self, *args))
        return points[-1]

    monkeypatch.setattr(Measurer, "measure", interrupted)
    if not found:
        with pytest.raises(KeyboardInterrupt):
            ps.compact(dense, by="opacity", target_db=20.0)
        return
    result = ps.compact(dense, by="opacity", target_db=20.0)
    assert result.interrupted and "interrupted" in result.target
    assert len(result.scene) == points[-1].gaussians


@pytest.mark.parametrize(
    "options, said",
    [
        ({"target_db": 30.0, "target_mb": 0.002}, "the smallest that reaches 30 dB .* more than 2.00 kB"),
        ({"target_db": 90.0, "target_format": ".spz"}, "no scene reaches --target-db 90 in this format"),
        ({"target_mb": 1e-6}, "too small for one Gaussian"),
        ({"target_mb": 1e-6, "target_format": ".spz"}, "too small for one Gaussian"),
        ({"target_ms": 1e-9}, "no scene meets --target-ms 1e-09"),
        ({"target_db": 150.0}, "--target-db is 150; no smaller scene reaches it, expected at most 100"),
        ({"target_db": math.nan}, "--target-db is nan"),
        ({"target_db": 30.0, "keep": "10%", "sh": "0", "seconds": 3.0}, "keep, sh, seconds cannot be given"),
        ({"target_db": 30.0, "clean": True}, "clean cannot be given with a target"),
        ({"target_db": 30.0, "target_format": ".bmp"}, "bmp"),
    ],
)  # fmt: skip
def test_targets_that_cannot_be_met_or_mean_nothing_are_refused(dense, options, said):
    with pytest.raises(PointSplatError, match=said):
        ps.compact(dense, by="opacity", **options)


def test_scenes_of_a_folder_each_meet_the_target(tmp_path, dense, room_views):
    for name, scene in (("a", dense), ("b", box_room(1, 300))):
        ps.save(scene, tmp_path / "rooms" / f"{name}.ply")
    results = ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=24.0)
    assert [result.status for result in results] == ["done", "done"]
    for result in results:
        whole, small = ps.load(result.source), ps.load(Path(result.output))
        assert mean_psnr(small, whole, room_views) >= 24
        assert 1e6 * result.megabytes == Path(result.output).stat().st_size < Path(result.source).stat().st_size
    again = ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=24.0)
    assert [replace(result, seconds=0) for result in again] == [
        replace(result, status="done before", seconds=0) for result in results
    ]
    with pytest.raises(PointSplatError, match="holds results of other options"):
        ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=25.0)


def test_a_folder_with_a_target_that_no_scene_meets_says_so_for_each(tmp_path, dense):
    ps.save(dense, tmp_path / "rooms" / "a.ply")
    [result] = ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=30.0, target_mb=0.002)
    assert result.status == "failed" and "no scene meets all targets" in result.error


def test_photos_are_reduced_with_their_views_by_the_mean_of_each_area(dense, room_views):
    photo, mask = torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(0)), torch.arange(48) < 25
    photos = [Example(view, photo, mask.expand(36, -1)[..., None]) for view in room_views]
    turned = Example(replace(room_views[0], width=36, height=48), photo.transpose(0, 1))
    subject = replace(subject_of(dense, None), held_out=lambda: [turned, *photos[1:]])
    (views, small, _), note = views_to_judge(replace(subject, resolution=(24, 18)), 3)
    assert (len(views), views.width, views.height) == (2, 24, 18) and note.startswith("1 of 3 held-out photos")
    assert torch.equal(views.viewmats, room_views.viewmats[1:])
    assert torch.allclose(small[0].target, photo.reshape(18, 2, 24, 2, 3).mean(dim=(1, 3)), atol=1e-6)
    assert small[0].mask.sum() == 18 * 13
    whole = views_to_judge(replace(subject, held_out=lambda: photos), 3)[0]
    assert torch.equal(whole.photos[0].target, photo) and torch.equal(whole.views.Ks, room_views.Ks)


def test_lpips_is_given_where_weights_are_at_hand(dense, some_lpips):
    measurer = Measurer(subject_of(dense, None), 3, SILENT, timed=False)
    lpips = measurer.measure(Setting(100, 1, by="opacity"), SILENT).against_dense.lpips
    assert (lpips is not None and 0 < lpips < 2) == some_lpips
    assert any("LPIPS is missing" in note for note in measurer.notes) != some_lpips


def test_pictures_too_small_for_ssim_are_refused(dense, room_views):
    views = ViewSource(dense, given=replace(room_views, width=10))
    with pytest.raises(DataError, match="views are 10 x 36 pixels; expected at least 11 a side"):
        Measurer(Subject(dense, Path("room.ply"), "room", lambda: views), 3, SILENT)
