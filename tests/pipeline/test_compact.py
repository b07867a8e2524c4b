"""A scene made smaller and refined: refinement is kept where it helps, left out where it does not,
and it is said."""

import math
from pathlib import Path

import pytest
import torch

import pointsplat_ns.pipeline.compact_scene as compact_module
import pointsplat_ns.pipeline.stages as stages_module
from making import ball, same
from pointsplat_ns.api import Compacted
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.pipeline.acceptance import views_improved
from pointsplat_ns.pipeline.compact_scene import compact_scene
from pointsplat_ns.pipeline.options import CompactOptions
from pointsplat_ns.pipeline.repair import Repaired
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import PruneSettings, prune
from pointsplat_ns.refinement import Refiner, RefinerConfig
from pointsplat_ns.rendering.comparison.closeness import Closeness, DenseReference
from pointsplat_ns.rendering.comparison.sizes import RendersOfSizes
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.progress import silent
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")

TINY = {
    "enc_channels": (8, 8),
    "enc_depths": (1, 1),
    "enc_heads": (1, 1),
    "strides": (2,),
    "patch": 64,
}
TINY |= {
    "dec_channels": (8,),
    "dec_depths": (1,),
    "dec_heads": (1,),
    "feature_dim": 8,
    "head_width": 8,
    "grid": None,
}


def tiny_refiner(head: str = "opacities", moved: float = 0.0, seed: int = 1, **config) -> Refiner:
    """An untrained refiner whose residual is ``moved`` for every value of one attribute, zero for
    the others."""
    torch.manual_seed(seed)
    refiner = Refiner(RefinerConfig(**{**TINY, **config})).eval()
    with torch.no_grad():
        [*refiner.heads.mlps[head].modules()][-1].bias.fill_(moved)
    return refiner


def trained(
    refiner: Refiner, keep: float | int = 0.5, by: str = "opacity", **options
) -> TrainedRefiner:
    return TrainedRefiner(refiner, PruneSettings(keep, by, **options), Path("in memory"))


REPAIRED = {"effort": "quick", "seconds": 1.0}


def compacted(
    scene: Gaussians,
    refiner: TrainedRefiner | None,
    views: Views | ViewProvider | None,
    progress=silent,
    **options,
) -> Compacted:
    """Compacted with renders compared in the given views."""
    source = ViewProvider(scene, given=views) if isinstance(views, Views) else views
    asked = CompactOptions(**{"effort": "instant", **options}).completed(refiner)
    made = compact_scene(scene, asked, source, progress, refiner=refiner)
    return Compacted(**vars(made))


@pytest.fixture
def repaired_to(monkeypatch):
    """A function that makes every repair give one scene."""

    def give(made: Gaussians, interrupted: bool = False) -> None:
        monkeypatch.setattr(
            stages_module, "repair", lambda *_, **others: Repaired(made, 5, 0.5, interrupted)
        )

    return give


class NoViews(ViewProvider):
    """Of a scene without a place to look at it from."""

    def views(self, count: int) -> Views:
        raise DataError("no free place to look at the scene from was found")


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    """As faint as merging never leaves it."""
    return ball(400, opacity=1.0, bright=1.0)


@pytest.fixture(scope="module")
def views(scene) -> Views:
    return sample_views(scene, 3, 48, 36)


def test_what_is_not_finite_never_gets_out(scene, views):
    pruned = prune(scene, 0.5, "opacity")
    refiner = tiny_refiner(
        "features_dc", math.nan
    )  # the refiner itself holds back what it cannot compute
    result = compacted(scene, trained(refiner), views)
    assert not result.accepted and same(result.scene, pruned)

    class Unsound(Refiner):
        def forward(self, scene, structure=None, kept=None):
            means = scene.means.clone()
            means[:7] = math.nan
            return scene.replace(means=means)

    unsound = Unsound(refiner.config).eval()
    for source in (ViewProvider(scene, given=views), NoViews(scene)):
        result = compacted(scene, trained(unsound), source)
        assert (
            not result.accepted and same(result.scene, pruned) and result.stages[-1].after is None
        )
        assert result.verdict == "not refined by the network: 7 of 200 Gaussians are not finite"


def test_without_views_refinement_is_left_out_with_the_reason(scene):
    result = compacted(scene, trained(tiny_refiner("scales", 0.2)), NoViews(scene))
    assert not result.accepted and same(result.scene, prune(scene, 0.5, "opacity"))
    assert result.reference is None and result.views is None and result.psnr is None
    assert result.verdict == (
        "not refined by the network: no comparison with the dense scene (no free place to "
        "look at the scene from was found)"
    )


def test_one_gaussian_is_compacted_and_none_are_refused(scene):
    one = scene[5:6].replace(opacities=torch.tensor([[4.0]]))
    for moved in (0.0, 0.3):  # nothing is closer to a scene than itself
        result = compacted(one, trained(tiny_refiner("scales", moved), 1), None)
        assert len(result.scene) == 1 and same(result.scene, one) and not result.accepted
        [note] = result.notes
        assert note.startswith("views: sampled poses, up is ") and result.before.psnr == math.inf
    faint = one.replace(opacities=torch.tensor([[-4.0]]))
    result = compacted(faint, trained(tiny_refiner("scales", 0.3), 1), None)
    assert same(result.scene, faint) and not result.accepted
    for nothing in (scene[:0], scene.map(lambda value: value * math.nan)):
        with pytest.raises(SceneError, match="can be drawn"):
            compacted(nothing, trained(tiny_refiner()), None)


def test_a_degree_above_the_networks_is_refused_before_anything_is_done(scene, views, monkeypatch):
    refiner = trained(tiny_refiner(sh_degree=0))
    with monkeypatch.context() as patch:
        patch.setattr(compact_module, "prune_scene", None)
        with pytest.raises(
            SceneError, match="has SH degree 1, .* at most 0; cut the SH bands with --sh 0"
        ):
            compacted(scene, refiner, views, sh="1")
    assert compacted(scene, refiner, views, sh="0").scene.sh_degree == 0
    strong = scene.replace(
        features_rest=scene.features_rest * 20
    )  # auto keeps the band: only now it is known
    with pytest.raises(SceneError, match="SH degree 1.*at most 0"):
        compacted(strong, refiner, views, sh="auto")


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        (lambda pruned: pruned.replace(scales=pruned.scales + 0.1), True),
        (lambda pruned: pruned.replace(features_dc=pruned.features_dc - 2.0), False),
        (lambda pruned: pruned.replace(features_dc=pruned.features_dc * math.nan), False),
    ],
    ids=["better", "worse", "not finite"],
)
def test_a_repair_that_helps_is_kept_and_one_that_harms_is_left_out(
    change, kept, scene, views, repaired_to
):
    pruned = prune(scene, 0.5, "opacity")
    made = change(pruned)
    repaired_to(made, interrupted=not kept)
    result = compacted(scene, trained(tiny_refiner()), views, **REPAIRED)
    assert result.repair_accepted == kept
    assert same(result.scene, made if kept else pruned)
    assert (
        result.psnr == DenseReference(scene, views).psnr(result.scene)[0]
        and result.psnr >= result.before.psnr
    )
    line = result.verdict.splitlines()[1]
    assert line.startswith(
        "repaired by 5 steps in 0.5 s: " if kept else "not repaired by 5 steps in 0.5 s"
    )
    assert ("interrupted" in line) == (not kept)


def test_what_most_views_pay_for_is_left_out(scene, views, monkeypatch, repaired_to):
    """Over all pixels it is a gain."""
    pruned = prune(scene, 0.5, "opacity")
    repaired_to(pruned.replace(scales=pruned.scales + 0.1))

    def closeness(self, scene, progress=None):
        return Closeness(
            (0.9, 0.2, 0.2) if same(scene, pruned) else (0.1, 0.21, 0.21), self.covered
        )

    monkeypatch.setattr(DenseReference, "closeness", closeness)
    result = compacted(scene, trained(tiny_refiner("scales", 0.1)), views, **REPAIRED)
    assert same(result.scene, pruned) and result.repaired.after.psnr > result.before.psnr + 3
    assert views_improved(result.before, result.repaired.after) == 1
    assert result.verdict.startswith("not refined by the network, error increased in most views: ")
    assert "not repaired by 5 steps in 0.5 s, error increased in most views: " in result.verdict


def test_a_repair_that_harms_pictures_of_another_size_is_left_out(scene, monkeypatch, repaired_to):
    """Thinner Gaussians may be right in pictures of a middle size, and wrong in large ones. Little
    of a gain may go."""
    large = sample_views(scene, 2, 640, 480)
    pruned = prune(scene, 0.5, "opacity")
    repaired_to(pruned.replace(scales=pruned.scales + 0.1))
    options = {"by": "opacity", "keep": 0.5, **REPAIRED}
    assert compacted(scene, None, large, **options).repair_accepted
    psnrs = iter([[30.0, 30.0, 30.0], [31.0, 31.0, 29.9], [30.0, 30.0, 30.0], [31.0, 31.0, 28.0]])
    monkeypatch.setattr(RendersOfSizes, "psnrs", lambda self, scene: next(psnrs))
    assert compacted(scene, None, large, **options).repair_accepted
    left = compacted(scene, None, large, **options)
    assert not left.repair_accepted and same(left.scene, left.pruned)
    assert left.verdict.startswith(
        "not repaired by 5 steps in 0.5 s, PSNR decreased in pictures of other sizes: "
    )
