"""``compact --target-db``: the smallest file that reaches a PSNR, as it is written."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.pipeline import compact_scene as compact
from pointsplat_ns.pipeline import stages, view_provider
from pointsplat_ns.pipeline.quality import Judge, quality_of_file, through_file
from pointsplat_ns.pipeline.repair import Repaired
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def dense() -> ps.Gaussians:
    return box_room(0, 400)


@pytest.fixture(scope="module")
def views(dense, quick) -> ps.Views:
    return sample_views(dense, 3, 48, 36, seed=1)


@pytest.fixture(autouse=True)
def few_views(views, monkeypatch):
    """Three small views of any scene."""
    monkeypatch.setattr(
        view_provider.Sampler, "views", lambda sampler, count, *_, **options: views[:count]
    )


def mean_psnr(scene, dense, views) -> float:
    return float(ps.psnr(ps.render(scene, views), ps.render(dense, views)).mean())


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog"])
def test_the_file_that_is_written_has_the_quality_and_few_gaussians(dense, views, tmp_path, suffix):
    found = ps.compact(dense, by="opacity", target_db=25.0, target_format=suffix)
    path = tmp_path / f"found{suffix}"
    ps.save(found.scene, path)
    assert mean_psnr(ps.load(path), dense, views) >= 25 - 1e-3, "sums in another order"
    said = quality_of_file(found.judge, found.scene, path)
    assert said.psnr >= 25
    assert found.target is not None
    assert (found.target.psnr, found.target.bytes) == (said.psnr, path.stat().st_size)
    assert found.target.gaussians == len(found.scene)
    assert (found.stages[-1].stage == "round") == (suffix != ".ply")
    fewer = ps.compact(dense, round(0.85 * len(found.scene)), by="opacity")  # which is not rounded
    _, written = through_file(fewer.scene, format_to_write(suffix))
    assert Judge(dense, ViewProvider(dense)).psnr(written)[0] < 25


def test_each_count_is_repaired_and_has_the_sh_bands_that_are_asked_for(dense, monkeypatch):
    grey = dense.replace(features_rest=0.01 * dense.features_rest)
    repaired = []

    def repair(scene, dense, views, budget, *_, **others) -> Repaired:
        repaired.append((len(scene), budget.effort))
        return Repaired(scene.replace(opacities=scene.opacities + 0.01), 1, 0.1, interrupted=False)

    monkeypatch.setattr(stages, "repair", repair)
    found = ps.compact(grey, target_db=20.0, sh="auto", effort="thorough")
    assert found.scene.sh_degree == 0 and found.target.tried == len(repaired)
    assert len(repaired) > 1 and (len(found.scene), "thorough") in repaired


@pytest.mark.parametrize("found", [True, False])
def test_ctrl_c_gives_the_smallest_scene_so_far_if_any_reaches_it(dense, monkeypatch, found):
    made = []
    original = compact.compact_scene

    def interrupted(*args, **named):
        if len(made) == (3 if found else 0):
            raise KeyboardInterrupt
        made.append(original(*args, **named))
        return made[-1]

    monkeypatch.setattr(compact, "compact_scene", interrupted)
    if not found:
        with pytest.raises(KeyboardInterrupt):
            ps.compact(dense, by="opacity", target_db=20.0)
        return
    result = ps.compact(dense, by="opacity", target_db=20.0)
    reaching = [len(some.scene) for some in made if some.psnr >= 20]
    assert result.interrupted and result.target.interrupted and len(result.scene) == min(reaching)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"target_db": 90.0, "target_format": ".spz"}, "all 400 Gaussians reach .* dB, not 90 dB"),
        ({"target_db": math.nan}, "--target-db is nan"),
        ({"target_db": 0.0}, "--target-db is 0"),
        ({"target_db": 30.0, "keep": "10%"}, "expected no --keep"),
        ({"target_db": 30.0, "photos": "photos"}, "expected no --photos"),
        ({"target_db": 30.0, "target_format": ".bmp"}, "bmp"),
    ],
)
def test_what_cannot_be_reached_or_means_nothing_is_refused(dense, options, said):
    with pytest.raises(PointSplatError, match=said):
        ps.compact(dense, by="opacity", **options)


def test_scenes_of_a_folder_each_reach_it(tmp_path, dense, views):
    ps.save(dense, tmp_path / "rooms" / "a.ply")
    [result] = ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=24.0)
    assert result.status == "done" and result.after < result.before
    assert mean_psnr(ps.load(Path(result.output)), dense, views) >= 24
    assert ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=24.0) == [
        replace(result, status="done before")
    ]
    with pytest.raises(PointSplatError, match="contains results of other options"):
        ps.compact_folder(tmp_path / "rooms", by="opacity", target_db=25.0)
