"""From what a person asks for to a smaller scene: what is combined, what is told, what is refused."""

import math

import pytest
import torch

from making import ball, same
from pointsplat_ns.compression.budget_search import DenseReference
from pointsplat_ns.compression.distributions import opacity_quantiles, plot_distributions, size_quantiles
from pointsplat_ns.compression.prune import ALL_METHODS, IMAGE_SCORES, Poses, compact_scene
from pointsplat_ns.compression.view_sampling import sample_views
from pointsplat_ns.errors import BudgetError, DataError, PointSplatError, SceneError
from pointsplat_ns.io import write_ply
from pointsplat_ns.pruning import SCORES, Megabytes, WithinPsnr, cut_sh, ply_bytes, prune, select


@pytest.fixture(scope="module")
def scene():
    return ball(400)


@pytest.fixture(scope="module")
def looks(scene):
    return sample_views(scene, 3, 48, 36)


def test_no_poses_are_asked_for_where_none_are_needed(scene):
    def refuse(count):
        raise AssertionError("poses were asked for")

    made = compact_scene(scene, 0.25, "coverage", sh="0", poses=refuse)
    assert same(made.scene, cut_sh(prune(scene, 0.25, "coverage").scene, 0))
    assert made.notes == ("SH degree 1 cut to 0: 100 % of the directional energy lost",)


@pytest.mark.parametrize("by", sorted(IMAGE_SCORES))
def test_an_image_driven_score_is_computed_once_and_chooses(by, scene, looks, monkeypatch):
    calls = []
    score = IMAGE_SCORES[by]
    monkeypatch.setitem(IMAGE_SCORES, by, lambda *args: calls.append(1) or score(*args))
    made = compact_scene(scene, WithinPsnr(20.0), by, poses=lambda count: looks)
    assert calls == [1] and same(made.scene, scene[select(score(scene, looks), len(made.scene))])


def test_a_size_counts_the_bands_that_are_left(scene):
    made = compact_scene(scene, Megabytes(0.01), "opacity", sh="0")
    assert ply_bytes(len(made.scene), 0) <= 10_000 < ply_bytes(len(made.scene) + 1, 0)


def test_an_auto_budget_is_measured_against_the_scene_with_all_its_bands(scene, looks):
    made = compact_scene(scene, WithinPsnr(22.0), "coverage", sh="0", poses=lambda count: looks)
    assert made.scene.sh_degree == 0 and DenseReference(scene, looks).psnr(made.scene)[0] >= 22
    assert any("renders reach" in note and "3 views" in note for note in made.notes)


def test_auto_sh_keeps_bands_that_are_seen_and_drops_those_that_are_not(scene, looks):
    faint = scene.replace(features_rest=scene.features_rest * 1e-3)
    assert compact_scene(faint, 1.0, "paper", sh="auto", poses=lambda count: looks).scene.sh_degree == 0
    strong = scene.replace(features_rest=scene.features_rest * 10)
    made = compact_scene(strong, 1.0, "paper", sh="auto", poses=lambda count: looks)
    assert made.scene.sh_degree == 1 and made.notes == ("SH degree 1 kept, no band dropped",)


def test_fine_tuning_follows_where_it_is_asked_for(scene, looks):
    plain = compact_scene(scene, 0.3, "coverage").scene
    tuned = compact_scene(scene, 0.3, "coverage", poses=lambda count: looks, fine_tune_steps=10).scene
    reference = DenseReference(scene, looks)
    assert len(tuned) == len(plain) and reference.psnr(tuned)[0] > reference.psnr(plain)[0]


def test_progress_names_what_is_done(scene, looks):
    told = []
    compact_scene(
        scene,
        WithinPsnr(20.0),
        "lightgaussian",
        sh="auto",
        poses=lambda count: looks,
        fine_tune_steps=2,
        progress=lambda what, share: told.append((what, share)),
    )
    assert all(0 <= share <= 1 for _, share in told)
    assert list(dict.fromkeys(what for what, _ in told)) == [
        "comparing SH degrees",
        "by lightgaussian",
        "trying counts",
        "fine-tuning",
    ]


def test_a_bare_scene_is_looked_at_from_sampled_poses_and_a_run_from_its_own(scene, trained_walls, tmp_path):
    write_ply(scene, tmp_path / "scene.ply")
    bare = Poses(tmp_path / "scene.ply", scene)
    assert len(bare(2)) == 2 and bare.origin == "poses sampled in free space"
    (run,) = (trained_walls / "wall-b" / "splatfacto-cpu").iterdir()
    own = Poses(run, scene)
    views = own(4)
    assert len(views) == 4 and own.origin == "poses of the dataset"
    assert (views.width, views.height) == (64, 48) and views.rasterize_mode == "antialiased"
    assert views.background.tolist() == [1.0, 1.0, 1.0]


def test_a_run_whose_data_is_gone_is_looked_at_from_sampled_poses_and_it_is_said(trained_walls, tmp_path, monkeypatch):
    import pointsplat_ns.compression.prune as compaction

    def gone(path):
        raise SceneError("its data is not there")

    monkeypatch.setattr(compaction, "dataset_views", gone)
    for name, mode in (("wall-a", "classic"), ("wall-b", "antialiased")):  # as the run rendered
        (run,) = (trained_walls / name / "splatfacto-cpu").iterdir()
        poses = Poses(run, ball(400))
        views = poses(2)
        assert len(views) == 2 and views.rasterize_mode == mode
        assert poses.origin == "poses sampled in free space (no dataset: its data is not there)"
    nothing = Poses(run, ball(400)[:0])
    with pytest.raises(DataError, match="nothing of the scene can be seen"):
        nothing(2)
    assert nothing.origin == ""


@pytest.mark.parametrize("by", ALL_METHODS)
@pytest.mark.parametrize("keep", [0, 0.0, 1.5, math.nan, 401, -1, Megabytes(1e-6), WithinPsnr(math.nan)])
def test_what_cannot_be_made_is_refused_by_every_method(by, keep, scene, looks):
    with pytest.raises(BudgetError):
        compact_scene(scene, keep, by, poses=lambda count: looks)


def test_what_is_no_scene_method_or_degree_is_refused(scene):
    with pytest.raises(SceneError, match="can be drawn"):
        compact_scene(scene.map(lambda value: value * math.nan), 0.5, "coverage")
    with pytest.raises(PointSplatError, match="no method is called 'best'"):
        compact_scene(scene, 0.5, "best")
    with pytest.raises(PointSplatError, match="sh is '4'; expected all, auto or a degree from 0 to 3"):
        compact_scene(scene, 0.5, "paper", sh="4")


def test_the_methods_are_those_of_pruning_and_the_image_driven():
    assert set(ALL_METHODS) == {"merge", *SCORES, *IMAGE_SCORES}


def test_distributions_are_numbers_and_a_picture(scene, tmp_path):
    assert opacity_quantiles(scene)[1] == pytest.approx(float(scene.alphas.median()), abs=0.01)
    assert size_quantiles(scene) == sorted(size_quantiles(scene))
    assert all(math.isnan(value) for value in size_quantiles(scene[:0]) + opacity_quantiles(scene[:0]))
    flat = scene.replace(scales=torch.full_like(scene.scales, -math.inf))
    for i, after in enumerate((scene[:50], scene[:1], scene[:0], flat)):
        plot_distributions({"before": scene, "after": after}, tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").read_bytes().startswith(b"\x89PNG")
