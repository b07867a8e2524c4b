"""Views sampled in free space, budgets found by rendering, and the optimisation of what was kept."""

import math

import pytest
import torch

from pointsplat_ns.compression.budget_search import (
    PRECISION,
    Closeness,
    DenseReference,
    needed_sh_degree,
    smallest_within,
)
from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.compression.view_sampling import content_box, look_at, sample_views
from pointsplat_ns.errors import BudgetError, DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.pruning import coverage_score, cut_sh, select
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import Views


def room(n=1500, seed=0, degree=2):
    """The inside of a ball of radius 2 about (5, 0, 0), covered with opaque blobs, and an outlier far away."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.randn(n, 3, generator=generator)
    place = 2 * place / place.norm(dim=1, keepdim=True)
    scene = Gaussians(
        means=place + torch.tensor([5.0, 0.0, 0.0]),
        scales=torch.full((n, 3), math.log(0.12)) + 0.2 * torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        opacities=2 + torch.randn(n, 1, generator=generator),
        features_dc=torch.sin(2 * place) + 0.3 * torch.randn(n, 3, generator=generator),
        features_rest=0.03 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator),
    )
    scene.means[0] = 1e6
    return scene


@pytest.fixture(scope="module")
def scene():
    return room()


@pytest.fixture(scope="module")
def looks(scene):
    return sample_views(scene, 4, 64, 48)


def places_of(views):
    rotation, translation = views.viewmats[:, :3, :3], views.viewmats[:, :3, 3:]
    return -(rotation.mT @ translation)[..., 0]


def test_sampled_poses_stand_in_free_space_and_see_the_room(scene):
    views = sample_views(scene, 12, 64, 48)
    assert len(views) == 12 and (views.width, views.height) == (64, 48)
    rotation = views.viewmats[:, :3, :3]
    # 1e-12: unit vectors in float64
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(12, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(12).double(), atol=1e-12)
    distance = (places_of(views) - torch.tensor([5.0, 0.0, 0.0])).norm(dim=1)
    assert (distance < 1.95).all()  # inside, not in the blobs of the wall
    assert all(render(scene, views[i]).mean() > 0.1 for i in range(12))


def test_sampled_poses_are_those_of_their_seed(scene):
    a, b, c = (sample_views(scene, 3, seed=seed).viewmats for seed in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_an_object_is_looked_at_from_around_it():
    generator = torch.Generator().manual_seed(3)
    blob = room(400).replace(means=0.3 * torch.randn(400, 3, generator=generator))
    views = sample_views(blob, 4, 64, 48)
    assert (places_of(views).norm(dim=1) > 0.3).all()
    assert all(render(blob, views[i]).max() > 0.2 for i in range(len(views)))


def test_one_gaussian_is_looked_at(scene):
    views = sample_views(scene[5:6], 2, 64, 48)
    assert len(views) >= 1 and render(scene[5:6], views[0]).max() > 0


def test_a_scene_that_shows_nothing_has_no_poses(scene):
    clear = scene.replace(opacities=torch.full_like(scene.opacities, -math.inf))
    for nothing in (clear, scene[:0], scene.map(lambda value: value * math.nan)):
        with pytest.raises(DataError, match="nothing of the scene can be seen"):
            sample_views(nothing, 3)
    with pytest.raises(DataError, match="0 views asked for"):
        sample_views(scene, 0)


def test_the_box_is_not_moved_by_an_outlier(scene):
    low, high = content_box(scene)
    assert torch.allclose(0.5 * (low + high), torch.tensor([5.0, 0.0, 0.0]).double(), atol=0.3)
    assert (high - low < 4.1).all() and (high - low > 3).all()


def test_looking_straight_up_or_at_oneself_is_a_rotation_too():
    places = torch.zeros(4, 3, dtype=torch.float64)
    targets = torch.tensor([[0, 0, 1.0], [0, 0, -1.0], [0, 0, 0], [1e-30, 0, 1e-30]], dtype=torch.float64)
    rotation = look_at(places, targets)[:, :3, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).double().expand(4, 3, 3), atol=1e-12)
    assert torch.allclose(rotation[0] @ targets[0], torch.tensor([0, 0, 1.0]).double(), atol=1e-12)


@pytest.mark.parametrize("wanted", [22.0, 30.0])
def test_the_scene_found_is_good_enough_and_a_little_smaller_one_is_not(scene, looks, wanted):
    scores = coverage_score(scene)
    calls, shares = [], []

    def make(count):
        calls.append(count)
        return scene[select(scores, count)]

    found = smallest_within(scene, make, looks, wanted, shares.append)
    reference = DenseReference(scene, looks)
    assert found.psnr == reference.psnr(found.scene)[0] >= wanted and found.worst <= found.psnr + 1e-9
    count = len(found.scene)
    below = [k for k in calls if k < count]
    assert below and count <= max(max(below) * PRECISION, max(below) + 1)
    assert all(found.tried[k] < wanted for k in below)
    assert len(calls) == len(set(calls)) <= 12 and all(0 <= share <= 1 for share in shares)


def test_closeness_is_that_of_the_metrics_over_all_views(scene, looks):
    reference, kept, shares = DenseReference(scene, looks), scene[:900], []
    close = reference.closeness(kept, shares.append)
    pictures = torch.stack([render(kept, looks[i]) for i in range(4)]).double()
    wanted = torch.stack(reference.pictures).double()
    each = psnr(pictures, wanted)
    # 1e-6: float64 means, summed in another order
    assert close.psnr == pytest.approx(float(-10 * torch.log10((pictures - wanted).square().mean())), abs=1e-6)
    assert close.worst == pytest.approx(float(each.min()), abs=1e-6) and close.worst < close.psnr
    assert close.ssim == pytest.approx(float(ssim(pictures, wanted).mean()), abs=1e-5)  # float32 there
    assert reference.psnr(kept) == (close.psnr, close.worst) and shares == [0.25, 0.5, 0.75, 1.0]
    itself = reference.closeness(scene)
    assert itself.psnr == itself.worst == math.inf and itself.ssim == pytest.approx(1.0)
    assert DenseReference(scene, looks.resized(10)).closeness(kept).ssim is None


def test_an_error_that_is_no_number_is_no_perfect_score():
    spoiled = Closeness((1e-3, math.nan), None)
    assert math.isnan(spoiled.psnr) and not spoiled.psnr > Closeness((0.5,), None).psnr
    assert Closeness((1e-300,), None).psnr == pytest.approx(3000) and Closeness((0.0,), None).psnr == math.inf


def test_a_psnr_that_any_scene_reaches_keeps_one_gaussian(scene, looks):
    assert len(smallest_within(scene, lambda k: scene[:k], looks, 0.1).scene) == 1


def test_a_psnr_that_only_the_whole_scene_reaches_keeps_it(looks):
    whole = room(40)
    found = smallest_within(whole, lambda k: whole[:k], looks, 300.0)
    errors = {k: psnr for k, psnr in found.tried.items() if k < len(found.scene)}
    assert math.isinf(found.psnr) and all(psnr < 300 for psnr in errors.values())


def test_a_psnr_out_of_reach_is_said(scene, looks):
    with pytest.raises(BudgetError, match="all 1500 Gaussians reach .* dB, not 60 dB"):
        smallest_within(scene, lambda k: cut_sh(scene, 0)[:k], looks, 60.0)
    for wanted in (0.0, -3.0, math.nan, math.inf):
        with pytest.raises(BudgetError, match="expected a positive number"):
            smallest_within(scene, lambda k: scene[:k], looks, wanted)
    with pytest.raises(BudgetError, match="no view"):
        smallest_within(scene, lambda k: scene[:k], looks[:0], 30.0)


def test_the_sh_degree_found_is_the_lowest_that_is_good_enough(scene, looks):
    reference = DenseReference(scene, looks)
    reached = [reference.psnr(cut_sh(scene, degree))[0] for degree in range(3)]
    assert reached[0] < reached[1] < reached[2] == math.inf
    for degree in (0, 1):
        assert needed_sh_degree(scene, looks, reached[degree] - 0.01) == (degree, pytest.approx(reached[degree]))
    assert needed_sh_degree(scene, looks, reached[1] + 0.01) == (2, math.inf)


def test_fine_tuning_comes_closer_to_the_dense_scene_and_leaves_its_input_alone(scene, looks):
    kept = scene[select(coverage_score(scene), 500)]
    before = [value.clone() for value in kept.tensors()]
    shares = []
    tuned = fine_tune(kept, looks, scene, 20, progress=shares.append)
    reference = DenseReference(scene, looks)
    assert reference.psnr(tuned)[0] > reference.psnr(kept)[0] + 1
    assert len(tuned) == 500 and not any(value.requires_grad for value in tuned.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, kept.tensors(), strict=True))
    assert shares == pytest.approx([(i + 1) / 20 for i in range(20)])


def test_fine_tuning_takes_pictures_too_and_no_steps_change_nothing(scene, looks):
    pictures = DenseReference(scene, looks).pictures
    a, b = fine_tune(scene[:300], looks, pictures, 3), fine_tune(scene[:300], looks, scene, 3)
    assert all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))
    same = fine_tune(scene[:300], looks, scene, 0)
    assert all(torch.equal(x, y) for x, y in zip(same.tensors(), scene[:300].tensors(), strict=True))


def test_fine_tuning_leaves_infinite_parameters_where_they_are(scene, looks):
    spoiled = scene[:300].map(torch.clone)
    spoiled.opacities[3], spoiled.opacities[4], spoiled.scales[5, 1] = math.inf, -math.inf, -math.inf
    tuned = fine_tune(spoiled, looks, scene, 4)
    assert tuned.opacities[3] == math.inf and tuned.opacities[4] == -math.inf and tuned.scales[5, 1] == -math.inf
    assert bool(tuned.usable().all()) and not torch.equal(tuned.features_dc, spoiled.features_dc)


def test_fine_tuning_says_what_does_not_fit(scene, looks):
    with pytest.raises(DataError, match="no view"):
        fine_tune(scene, looks[:0], scene, 1)
    with pytest.raises(DataError, match="1 pictures for 4 views"):
        fine_tune(scene, looks, [torch.zeros(48, 64, 3)], 1)
    with pytest.raises(DataError, match="picture . has shape"):
        fine_tune(scene, looks, [torch.zeros(8, 8, 3)] * 4, 1)


def test_views_are_spread_resized_and_checked(looks):
    assert torch.equal(looks.spread(2).viewmats, looks.viewmats[[0, 3]]) and looks.spread(9) is looks
    half = looks.resized(32)
    assert (half.width, half.height) == (32, 24) and torch.allclose(half.Ks[:, :2], looks.Ks[:, :2] / 2)
    assert looks.resized(64) is looks
    with pytest.raises(DataError, match="viewmats of the views has shape"):
        Views(torch.eye(4), looks.Ks, 8, 8, torch.zeros(3))
    with pytest.raises(DataError, match="0 x 8 pixels"):
        Views(looks.viewmats, looks.Ks, 0, 8, torch.zeros(3))
