"""From what a person asks for to a smaller scene: what is combined, what is noted, what is refused."""

import dataclasses
import math

import pytest
import torch

from making import ball, box_room, same
from pointsplat_ns.compression.pictures import opacity_quantiles, plot_distributions, size_quantiles
from pointsplat_ns.compression.prune import Pruned, prune_scene
from pointsplat_ns.compression.requests import PruneRequest
from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import METHODS, Keep, Megabytes, WithinPsnr, cut_sh, ply_bytes, prune, select
from pointsplat_ns.system.progress import silent
from pointsplat_ns.views import Views


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(400)


@pytest.fixture(scope="module")
def views(scene) -> Views:
    return sample_views(scene, 3, 48, 36)


def pruned(
    scene: Gaussians, views: Views | ViewSource | None, keep: Keep | str, by: str = "merge", progress=silent, **options
) -> Pruned:
    """Pruned with renders compared in the given views."""
    source = ViewSource(scene, given=views) if isinstance(views, Views) else views
    return prune_scene(scene, PruneRequest(keep, by, **options), source, progress)


class Refusing(ViewSource):
    """Views that must not be asked for."""

    def views(self, count: int) -> Views:
        raise AssertionError("views were asked for")


def test_no_views_are_asked_for_where_none_are_needed(scene):
    result = pruned(scene, Refusing(scene), 0.25, "coverage", sh="0")
    assert same(result.scene, cut_sh(prune(scene, 0.25, "coverage"), 0))
    assert result.notes == ("SH degree 1 cut to 0: 100 % of what SH add to colours is lost",)


@pytest.mark.parametrize("by", sorted(name for name, method in METHODS.items() if method.needs_views))
def test_a_score_that_looks_at_the_scene_is_computed_once_and_chooses(by, scene, views, monkeypatch):
    calls = []
    method = METHODS[by]

    def counted(*args, **options):
        calls.append(1)
        return method.score(*args, **options)

    monkeypatch.setitem(METHODS, by, dataclasses.replace(method, score=counted))
    result = pruned(scene, views, WithinPsnr(20.0), by)
    assert calls == [1]
    assert same(result.scene, scene[select(method.score(scene, views), len(result.scene))])


def test_a_psnr_for_a_format_is_reached_by_its_rounded_scene_in_fewer_bytes(scene, views):
    plain, small = (pruned(scene, views, WithinPsnr(22.0, suffix), "coverage").scene for suffix in (".ply", ".spz"))
    assert len(encode_spz(small)) < len(encode_spz(plain))
    assert DenseReference(scene, views).psnr(small)[0] >= 22.0


def test_a_size_counts_the_bands_that_are_left(scene):
    result = pruned(scene, None, Megabytes(0.01), "opacity", sh="0")
    assert ply_bytes(len(result.scene), 0) <= 10_000 < ply_bytes(len(result.scene) + 1, 0)


@pytest.mark.parametrize("sh", ["0", "auto"])
def test_a_size_that_only_fits_without_bands_is_no_reason_to_refuse(sh, scene, views):
    faint = scene.replace(features_rest=scene.features_rest * 1e-3)
    size = Megabytes(ply_bytes(1, 0) / 1e6)
    with pytest.raises(BudgetError, match="too small for one Gaussian of SH degree 1"):
        pruned(faint, views, size, "opacity")
    assert len(pruned(faint, views, size, "opacity", sh=sh).scene) == 1


@pytest.mark.parametrize("by", sorted(name for name, method in METHODS.items() if method.needs_views))
def test_a_scene_without_directional_bands_can_be_looked_at(by, scene, views):
    assert len(pruned(scene, views, 0.25, by, sh="0").scene) == 100


def test_an_auto_budget_is_measured_against_the_scene_with_all_its_bands(scene, views):
    result = pruned(scene, views, WithinPsnr(22.0), "coverage", sh="0")
    assert result.scene.sh_degree == 0 and DenseReference(scene, views).psnr(result.scene)[0] >= 22
    assert any("dB PSNR against the dense scene" in note and "3 views" in note for note in result.notes)


def test_auto_sh_keeps_bands_that_are_seen_and_drops_those_that_are_not(scene, views):
    faint = scene.replace(features_rest=scene.features_rest * 1e-3)
    assert pruned(faint, views, 1.0, "paper", sh="auto").scene.sh_degree == 0
    strong = scene.replace(features_rest=scene.features_rest * 10)
    result = pruned(strong, views, 1.0, "paper", sh="auto")
    assert result.scene.sh_degree == 1
    assert result.notes == ("views: given views", "SH degree 1 kept")


def test_fine_tuning_follows_where_it_is_asked_for(scene, views):
    plain = pruned(scene, None, 0.3, "coverage").scene
    tuned = pruned(scene, views, 0.3, "coverage", fine_tune=10).scene
    reference = DenseReference(scene, views)
    assert len(tuned) == len(plain) and reference.psnr(tuned)[0] > reference.psnr(plain)[0]


def test_progress_names_what_is_done(scene, views):
    steps = []
    report = lambda what, share: steps.append((what, share))  # noqa: E731
    pruned(scene, views, WithinPsnr(20.0), "lightgaussian", report, sh="auto", fine_tune=2)
    assert all(0 <= share <= 1 for _, share in steps)
    assert list(dict.fromkeys(what for what, _ in steps)) == [
        "comparing SH degrees",
        "by lightgaussian",
        "trying counts",
        "fine-tuning",
    ]


@pytest.mark.parametrize("by", METHODS)
@pytest.mark.parametrize("keep", [0, 0.0, 1.5, math.nan, 401, -1, Megabytes(1e-6), WithinPsnr(math.nan)])
def test_what_cannot_be_made_is_refused_by_every_method_before_it_looks(by, keep, scene):
    with pytest.raises(BudgetError):
        pruned(scene, Refusing(scene), keep, by)


def test_what_is_no_scene_is_refused(scene):
    with pytest.raises(SceneError, match="can be drawn"):
        pruned(scene.map(lambda value: value * math.nan), None, 0.5, "coverage")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"by": "best"}, f"no method is called 'best'; expected one of {', '.join(METHODS)}"),
        ({"sh": "4"}, "sh is '4'; expected all, auto or a degree from 0 to 3"),
        ({"keep": "half"}, "keep is 'half'"),
        ({"keep": WithinPsnr(-1.0)}, "the wanted PSNR is -1.0 dB"),
        ({"fine_tune": -1}, "-1 steps of fine-tuning; expected 0 for none, or more"),
        ({"by": "merge", "opacity_weight": 0.5}, "opacity weight 0.5: merge does not weigh opacity"),
    ],
)
def test_options_that_fit_no_scene_are_refused_without_one(options, message):
    with pytest.raises(PointSplatError, match=message):
        PruneRequest(**{"keep": 0.5, "by": "paper", **options})


def test_distributions_are_numbers_and_a_picture(scene, tmp_path):
    assert opacity_quantiles(scene)[1] == pytest.approx(float(scene.alphas.median()), abs=0.01)
    assert size_quantiles(scene) == sorted(size_quantiles(scene))
    assert all(math.isnan(value) for value in size_quantiles(scene[:0]) + opacity_quantiles(scene[:0]))
    flat = scene.replace(scales=torch.full_like(scene.scales, -math.inf))
    for i, after in enumerate((scene[:50], scene[:1], scene[:0], flat)):
        plot_distributions({"before": scene, "after": after}, tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").read_bytes().startswith(b"\x89PNG")


def test_merging_looks_from_the_views_that_are_given_and_from_no_others(scene, views):
    given = pruned(scene, views, 30).scene
    assert same(given, prune(scene, 30, views=views)) and not same(given, prune(scene, 30))


def test_merging_stands_upright_in_views_that_are_sampled_for_it():
    scene = box_room(0, 3000)
    source = ViewSource(scene, resolution=(64, 48), up=up_named("x"))
    looked = pruned(scene, source, 300).views
    assert looked is not None and (looked.width, looked.height) == (64, 48)
    level = looked.viewmats[:, 0, :3] @ source.up.direction  # no camera is rolled about its axis
    assert float(level.abs().max()) < 1e-6
