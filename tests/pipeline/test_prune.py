"""Pruning with searches, SH bands and views."""

import dataclasses

import pytest

from making import ball, same
from pointsplat_ns.pipeline.options import PruneOptions
from pointsplat_ns.pipeline.prune_scene import Pruned, prune_scene
from pointsplat_ns.pipeline.report import ShCut
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import METHODS, Keep, WithinPsnr, select
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.progress import silent
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(400)


@pytest.fixture(scope="module")
def views(scene) -> Views:
    return sample_views(scene, 3, 48, 36)


def pruned(
    scene: Gaussians,
    views: Views | ViewProvider | None,
    keep: Keep | str,
    by: str = "merge",
    progress=silent,
    **options,
) -> Pruned:
    """Pruned with renders compared in the given views."""
    source = ViewProvider(scene, given=views) if isinstance(views, Views) else views
    return prune_scene(scene, PruneOptions(keep, by, **options), source, progress)


@pytest.mark.parametrize(
    "by", sorted(name for name, method in METHODS.items() if method.needs_views)
)
def test_a_score_that_looks_at_the_scene_is_computed_once_and_chooses(
    by, scene, views, monkeypatch
):
    calls = []
    method = METHODS[by]

    def counted(*args, **options):
        calls.append(1)
        return method.score(*args, **options)

    monkeypatch.setitem(METHODS, by, dataclasses.replace(method, score=counted))
    result = pruned(scene, views, WithinPsnr(20.0), by)
    assert calls == [1]
    assert same(result.scene, scene[select(method.score(scene, views), len(result.scene))])


def test_a_psnr_in_a_format_is_reached_by_its_rounded_scene(scene, views):
    plain, small = (
        pruned(scene, views, WithinPsnr(22.0, suffix), "coverage").scene
        for suffix in (".ply", ".spz")
    )
    assert len(encode_spz(small)) < len(encode_spz(plain))
    assert DenseReference(scene, views).psnr(small)[0] >= 22.0


def test_auto_sh_keeps_bands_that_are_seen_and_drops_those_that_are_not(scene, views):
    faint = scene.replace(features_rest=scene.features_rest * 1e-3)
    assert pruned(faint, views, 1.0, "paper", sh="auto").scene.sh_degree == 0
    strong = scene.replace(features_rest=scene.features_rest * 10)
    result = pruned(strong, views, 1.0, "paper", sh="auto")
    assert result.scene.sh_degree == 1
    assert result.sh == ShCut(before=1, after=1)
