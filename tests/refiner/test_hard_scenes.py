"""The refiner on degenerate, extreme and partly unusable scenes."""

import pytest
import torch

from making import same, scene_to_refine, small_refiner
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner import Refiner


def hard_scenes() -> dict[str, Gaussians]:
    base = scene_to_refine(60, sh_degree=1)
    line = torch.linspace(-3, 3, 60)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    plane = base.means * torch.tensor([1.0, 0.0, 1.0])
    outlier = base.means.clone()
    outlier[7] = 1e7
    values = torch.tensor([torch.inf, -torch.inf, 40.0, -40.0])
    extreme = base.replace(
        opacities=values.repeat(15)[:, None],
        scales=torch.tensor([80.0, -80.0, -torch.inf]).repeat(60, 1),
        quats=torch.cat([torch.zeros(20, 4), base.quats[:20] * 1e30, base.quats[:20] * 1e-30]),
    )
    return {
        "one": base[:1],
        "two": base[:2],
        "coincident": base.replace(means=torch.full((60, 3), 1.5)),
        "within 1e-30": base.replace(means=base.means * 1e-30),
        # too few to tell an outlier from a scene: the others share a cell
        "one voxel and one far": base[:6].replace(means=torch.cat([base.means[:5] * 1e-6, torch.ones(1, 3)])),
        "line": base.replace(means=line),
        "plane": base.replace(means=plane),
        "duplicates": Gaussians.cat([base[:20]] * 3),
        "outlier": base.replace(means=outlier),
        "far from the origin": base.replace(means=base.means + 1e6),
        "extreme parameters": extreme,
    }


@pytest.mark.parametrize("name", hard_scenes())
def test_an_untrained_refiner_returns_hard_scenes_to_the_bit_but_zero_quaternions(name):
    scene = hard_scenes()[name]
    refined = small_refiner(trained=False)(scene)
    zero = (scene.quats == 0).all(dim=1)
    identity = torch.tensor([1.0, 0, 0, 0])
    assert same(refined, scene.replace(quats=torch.where(zero[:, None], identity, scene.quats)))


@pytest.mark.parametrize(
    "changes", [{"norm": "scene"}, {"norm": "batch"}, {"norm": "layer"}, {"grid": 384}, {"encoder": "concat"}]
)
@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("name", hard_scenes())
def test_output_and_gradients_of_hard_scenes_are_finite(name, training, changes):
    assert_finite(small_refiner(**changes).train(training), hard_scenes()[name], name)


def assert_finite(refiner: Refiner, scene: Gaussians, name: str) -> None:
    """What comes out is usable, every gradient of a sum over it is finite, and the network has one that is not 0."""
    scene = scene.map(lambda value: value.clone().requires_grad_())
    refined = refiner(scene)
    assert refined.usable().all(), name
    total = 0
    for (key, after), before in zip(refined.items(), scene.tensors(), strict=True):
        assert torch.equal(after.isfinite(), before.isfinite()), (name, key)
        total = total + torch.where(after.isfinite(), after.tanh(), 0).sum()
    refiner.zero_grad()
    total.backward()
    for key, value in [*refiner.named_parameters(), *scene.items()]:
        assert value.grad is None or value.grad.isfinite().all(), (name, key)
    assert refiner.heads.mlps["features_dc"][-1].bias.grad.abs().max() > 0, name


"""The published grid, stages, strides, heads and patches, in fewer channels and blocks for the sake of time."""


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["means", "scales", "quats", "features_dc", "features_rest"])
def test_unusable_gaussians_come_back_unchanged_and_the_others_as_if_those_were_not_there(name, bad):
    scene = scene_to_refine(60)
    bad_rows = torch.tensor([0, 17, 59])
    getattr(scene, name)[bad_rows] = bad
    refiner = small_refiner()
    refined = refiner(scene)
    good = scene.usable()
    # -Inf is a legal log-scale: such a Gaussian is flat, and refined
    assert torch.equal((~good).nonzero()[:, 0], bad_rows[:0] if name == "scales" and bad < 0 else bad_rows)
    for before, after in zip(scene[~good].tensors(), refined[~good].tensors(), strict=True):
        assert torch.equal(before.nan_to_num(7.0), after.nan_to_num(7.0))
    assert same(refined[good], refiner(scene[good]))
    assert not torch.equal(refined.opacities[good], scene.opacities[good])


def test_a_scene_of_unusable_gaussians_alone_comes_back():
    scene = scene_to_refine(5)
    scene.opacities[:] = torch.nan
    refined = small_refiner()(scene)
    assert refined.opacities.isnan().all() and torch.equal(refined.means, scene.means)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_what_a_broken_network_computes_never_leaves_it_in_evaluation_but_shows_in_training(bad):
    scene = scene_to_refine(60)
    refiner = small_refiner()
    with torch.no_grad():
        refiner.heads.mlps["scales"][-1].bias[1] = bad
    assert same(refiner(scene), scene)
    assert not refiner.train()(scene).usable().any()


def test_a_mean_at_the_end_of_the_number_range_does_not_overflow():
    top = torch.finfo(torch.float32).max
    scene = scene_to_refine(4).replace(means=torch.tensor([[top, 0, 0], [-top, 0, 0], [0, 1.0, 0], [1.0, 0, 0]]))
    assert small_refiner(means_reach=1.0)(scene).means.isfinite().all()
