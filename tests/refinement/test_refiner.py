"""The refiner, also on hard scenes."""

import pytest
import torch

from making import cloud, same, small_refiner
from pointsplat_ns.errors import SceneError
from pointsplat_ns.refinement import Refiner
from pointsplat_ns.refinement.config import refiner_preset
from pointsplat_ns.scene.gaussians import Gaussians


def scene_to_refine(
    n: int = 200, sh_degree: int = 3, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """Small blobs, uniform in a cube of side 4."""
    scene = cloud(n, sh_degree=sh_degree).to(dtype)
    return scene.replace(means=4 * scene.means)


ENCODERS = pytest.mark.parametrize("encoder", ["dual", "concat"])
UNITS = pytest.mark.parametrize("units", ["scene", "local"])


@pytest.mark.parametrize(
    "changes",
    [
        {"encoder": "dual"},
        {"encoder": "concat"},
        {"units": "local"},
        {"encoder": "concat", "units": "local"},
    ],
)
@pytest.mark.parametrize("duplicates", [False, True])
def test_permuting_the_gaussians_permutes_the_result(duplicates, changes):
    scene = scene_to_refine(300)
    if duplicates:  # shared cells, coincident means with other parameters
        scene = scene.replace(means=scene.means[torch.arange(300) % 100])
    refiner = small_refiner(**changes)
    mix = torch.randperm(300, generator=torch.Generator().manual_seed(5))
    assert same(refiner(scene[mix]), refiner(scene)[mix])


@ENCODERS
def test_the_sign_of_a_quaternion_changes_no_rotation_and_nothing_else(encoder):
    scene = scene_to_refine()
    signs = torch.tensor([1.0, -1.0]).repeat(100)[:, None]
    refiner = small_refiner(encoder=encoder)
    found = []
    for start in (scene, scene.replace(quats=scene.quats * signs)):
        start = start.map(lambda value: value.clone().requires_grad_())
        refined = refiner(start)
        refiner.zero_grad()
        turned = (
            refined.quats[:, :, None] * refined.quats[:, None]
        )  # all that a rotation depends on
        (
            turned.sum() + sum(value.sum() for name, value in refined.items() if name != "quats")
        ).backward()
        found.append((refined, turned, start, [p.grad.clone() for p in refiner.parameters()]))
    (a, turned, start, gradients), (b, b_turned, b_start, b_gradients) = found
    assert torch.equal(b.quats, a.quats * signs) and torch.equal(turned, b_turned)
    assert same(a, b.replace(quats=a.quats))
    assert not torch.equal(a.quats, scene.quats)
    # what is learned is the same, too
    assert all(torch.equal(x, y) for x, y in zip(gradients, b_gradients, strict=True))
    assert torch.equal(b_start.quats.grad, start.quats.grad * signs)


@ENCODERS
def test_residuals_do_not_depend_on_unit_and_place(encoder):
    scene = scene_to_refine(dtype=torch.float64)
    scene = scene.replace(means=(scene.means * 1024).round() / 1024)
    moved = scene.replace(
        means=scene.means * 8 + torch.tensor([16.0, -64.0, 4.0], dtype=torch.float64),
        scales=scene.scales + torch.tensor(8.0, dtype=torch.float64).log(),
    )
    refiner = small_refiner(encoder=encoder)
    a, b = (
        [
            after - before
            for after, before in zip(refiner(start).tensors(), start.tensors(), strict=True)
        ]
        for start in (scene, moved)
    )
    assert a[0].abs().max() > 1e-3
    # The positions are the same to the bit; log 8 is rounded, by 1e-15 in the log-scales, which the
    # float32 network may see as one rounding of 1e-7 and amplify.
    for key, x, y in zip(["means", *"sqodr"], a, b, strict=True):
        assert torch.allclose(x * 8 if key == "means" else x, y, atol=1e-5), key


def test_means_stay_within_reach_and_follow_the_extent():
    scene = scene_to_refine()
    refiner = small_refiner(means_reach=0.02)
    with torch.no_grad():
        refiner.heads.mlps["means"][-1].bias.fill_(100.0)
    extent = refiner.prepare(scene).cube.extent.float()
    moved = refiner(scene).means - scene.means
    assert torch.allclose(moved, (0.02 * extent).expand_as(moved), rtol=1e-4)


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_a_scene_of_lower_degree_is_refined_as_if_padded_with_zeros(sh_degree):
    scene = scene_to_refine(sh_degree=sh_degree)
    padding = torch.zeros(len(scene), 15 - scene.features_rest.shape[1], 3)
    padded = scene.replace(features_rest=torch.cat([scene.features_rest, padding], dim=1))
    refiner = small_refiner()
    a = refiner(scene)
    b = refiner(padded)
    assert a.sh_degree == sh_degree
    assert same(a, b.replace(features_rest=b.features_rest[:, : a.features_rest.shape[1]]))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"encoder": "concat"},
        {"use_appearance": False},
        {"use_position": False},
        {"use_appearance": False, "use_position": False},
        {"stem": "linear", "raw_inputs": True},
        {"units": "local"},
    ],
    ids=[
        *("dual", "concat", "no appearance", "no position", "geometry only", "linear stem"),
        "local units",
    ],
)
def test_gradients_reach_every_parameter_once_the_zero_layers_have_moved(changes):
    scene = scene_to_refine(400)
    refiner = small_refiner(**changes).train()
    refined = refiner(scene)
    weights = [
        torch.randn(v.shape, generator=torch.Generator().manual_seed(i))
        for i, v in enumerate(scene.tensors())
    ]
    sum((v * w).sum() for v, w in zip(refined.tensors(), weights, strict=True)).backward()
    for name, parameter in refiner.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


@UNITS
def test_a_float64_network_equals_the_float32_one_within_rounding(units):
    scene = scene_to_refine(dtype=torch.float64)
    refiner = small_refiner(units=units)
    single = refiner(scene)
    double = refiner.double()(scene)
    for (key, a), b in zip(single.items(), double.tensors(), strict=True):
        assert a.dtype == torch.float64
        assert torch.allclose(a, b, atol=1e-4), (
            key
        )  # a dozen layers of sums of up to 500 terms in float32


def test_a_scene_of_a_higher_degree_than_the_network_is_refused():
    with pytest.raises(SceneError, match="SH degree 3; this refiner was built for at most 1"):
        small_refiner(sh_degree=1)(scene_to_refine())


def hard_scenes() -> dict[str, Gaussians]:
    base = scene_to_refine(60, sh_degree=1)
    line = torch.linspace(-3, 3, 60)[:, None] * torch.tensor([1.0, 2.0, 3.0])
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
        "coincident": base.replace(means=torch.full((60, 3), 1.5)),
        "within 1e-30": base.replace(means=base.means * 1e-30),
        # too few to tell an outlier from a scene: the others share a cell
        "one voxel and one far": base[:6].replace(
            means=torch.cat([base.means[:5] * 1e-6, torch.ones(1, 3)])
        ),
        "line": base.replace(means=line),
        "duplicates": Gaussians.cat([base[:20]] * 3),
        "outlier": base.replace(means=outlier),
        "far from the origin": base.replace(means=base.means + 1e6),
        "extreme parameters": extreme,
    }


@UNITS
@pytest.mark.parametrize("name", hard_scenes())
def test_an_untrained_refiner_returns_hard_scenes_to_the_bit(name, units):
    scene = hard_scenes()[name]
    refined = small_refiner(trained=False, units=units)(scene)
    zero = (scene.quats == 0).all(dim=1)
    identity = torch.tensor([1.0, 0, 0, 0])
    assert same(refined, scene.replace(quats=torch.where(zero[:, None], identity, scene.quats)))


@pytest.mark.parametrize(
    ("changes", "training"),
    [
        ({"norm": "scene"}, False),
        ({"norm": "batch"}, True),
        ({"grid": 384}, True),
        ({"encoder": "concat"}, False),
        ({"units": "local"}, False),
        ({"units": "local"}, True),
    ],
)
@pytest.mark.parametrize("name", hard_scenes())
def test_output_and_gradients_of_hard_scenes_are_finite(name, training, changes):
    """Also, the network has a gradient that is not 0."""
    refiner = small_refiner(**changes).train(training)
    scene = hard_scenes()[name].map(lambda value: value.clone().requires_grad_())
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


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["means", "scales", "quats", "features_dc", "features_rest"])
@UNITS
def test_unusable_gaussians_come_back_unchanged_and_change_no_others(units, name, bad):
    scene = scene_to_refine(60)
    bad_rows = torch.tensor([0, 17, 59])
    getattr(scene, name)[bad_rows] = bad
    refiner = small_refiner(units=units)
    refined = refiner(scene)
    good = scene.usable()
    # -Inf is a legal log-scale: such a Gaussian is flat, and refined
    assert torch.equal(
        (~good).nonzero()[:, 0], bad_rows[:0] if name == "scales" and bad < 0 else bad_rows
    )
    for before, after in zip(scene[~good].tensors(), refined[~good].tensors(), strict=True):
        assert torch.equal(before.nan_to_num(7.0), after.nan_to_num(7.0))
    assert same(refined[good], refiner(scene[good]))
    assert not torch.equal(refined.opacities[good], scene.opacities[good])
    alone = scene[~good]
    assert refiner(alone).usable().sum() == 0 and len(refiner(alone)) == len(alone)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_broken_network_changes_nothing_except_in_training(bad):
    scene = scene_to_refine(60)
    refiner = small_refiner()
    with torch.no_grad():
        refiner.heads.mlps["scales"][-1].bias[1] = bad
    assert same(refiner(scene), scene)
    assert not refiner.train()(scene).usable().any()


def test_a_structure_of_another_scene_or_configuration_is_refused():
    refiner = small_refiner()
    with pytest.raises(ValueError, match="structure of 200 Gaussians"):
        refiner(scene_to_refine(100), refiner.prepare(scene_to_refine(200)))
    with pytest.raises(ValueError, match="call prepare"):
        refiner(scene_to_refine(200), small_refiner(grid=32).prepare(scene_to_refine(200)))


@pytest.mark.parametrize("name", ["tiny", "small", "full"])
def test_a_network_prints_as_one_line_with_its_size_and_device(name):
    config = refiner_preset(name, encoder="concat", patch=64, sh_degree=1)
    network = Refiner(config, device="meta")
    text = repr(network)
    count = sum(parameter.numel() for parameter in network.parameters())
    assert "\n" not in text and len(text) < 100
    assert all(part in text for part in (name, f"{count:,}", "concat", "scene", "meta"))


def test_a_network_of_other_layers_prints_no_preset():
    text = repr(Refiner(refiner_preset("tiny", units="local", head_width=48), device="meta"))
    assert "tiny" not in text and "local" in text and "\n" not in text
