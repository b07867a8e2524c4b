"""The image-driven scores at the extremes; ``tests/lab/test_independent.py`` recomputes both on a
usual scene."""

import math

import pytest
import torch

from making import normal_scene
from pointsplat_ns.errors import DataError
from pointsplat_ns.pruning.view_scores import (
    lightgaussian_score,
    log_determinant,
    pup_score,
    sensitivity,
)
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.views import Views

# four tiles, three of them cut off
WIDTH = 10
HEIGHT = 9


def make(n=8, degree=2, seed=3, dtype=torch.float64):
    scene = normal_scene(n, degree, seed, dtype)
    shape = {
        "means": 0.4 * scene.means,
        "scales": 0.3 * scene.scales - 1.5,
        "opacities": scene.opacities + 1,
    }
    return scene.replace(**shape, features_rest=0.3 * scene.features_rest)


def views(mode="classic", count=2):
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    viewmats[:, 2, 3] = 3.0
    viewmats[:, 0, 3] = 0.3 * torch.arange(count)
    K = torch.tensor([[10.0, 0, 5], [0, 10, 4.5], [0, 0, 1]], dtype=torch.float64)
    return Views(
        viewmats, K.repeat(count, 1, 1), WIDTH, HEIGHT, torch.tensor([0.3, 0.2, 0.6]), mode
    )


def hessians_by_definition(scene, views):
    """Every channel of every pixel differentiated by itself."""
    total = torch.zeros(len(scene), 6, 6, dtype=scene.dtype)
    for view in views:
        means = scene.means.clone().requires_grad_()
        scales = scene.scales.clone().requires_grad_()
        for value in render(scene.replace(means=means, scales=scales), view).reshape(-1):
            gradient = torch.cat(
                torch.autograd.grad(value, (means, scales), retain_graph=True), dim=1
            )
            total += gradient[:, :, None] * gradient[:, None, :]
    return total


@pytest.mark.parametrize(
    ("case", "mode"),
    [("opaque", "antialiased"), ("behind a wall", "classic"), ("one colour", "classic")],
)
def test_the_hessian_is_the_sum_over_pixels_of_outer_products(case, mode):
    scene = make(
        degree=0 if case == "one colour" else 2
    )  # whose colours do not depend on the direction
    if case == "opaque":  # alpha is held at its maximum and has no gradient there
        scene = scene.replace(opacities=torch.full_like(scene.opacities, 9.0))
    if case == "behind a wall":  # pixels are finished before the last Gaussians
        front = torch.tensor([[0.0, 0.0, -1.0]], dtype=scene.dtype).repeat(3, 1)
        means = scene.means.clone()
        scales = scene.scales.clone()
        means[:3] = front
        scales[:3] = 0.5
        scene = scene.replace(means=means, scales=scales, opacities=scene.opacities.abs() + 4)
    looks = views(mode)[[1]]
    wanted = hessians_by_definition(scene, looks)
    found = sensitivity(scene, looks)
    # 1e-10 of the largest entry: both sum some thousand terms in float64, in another order
    assert (found - wanted).abs().max() <= 1e-10 * wanted.abs().max()
    assert wanted.abs().amax(dim=(1, 2)).min() > 0 or case == "behind a wall"


@pytest.mark.parametrize("score", [lightgaussian_score, pup_score])
def test_what_no_view_sees_is_worth_least_and_what_cannot_be_drawn_nothing(score):
    scene = make(6)
    means = scene.means.clone()
    means[1] = torch.tensor([0.0, 0.0, -50.0])  # behind the cameras
    means[4] = math.nan
    found = score(scene.replace(means=means), views(count=3))
    others = found[[0, 2, 3, 5]]
    assert found[4].isnan() and found[1] < others.min() and others.isfinite().all()


@pytest.mark.parametrize("score", [lightgaussian_score, pup_score])
@pytest.mark.parametrize("case", ["infinite logits", "flat", "huge", "tiny", "one", "empty"])
def test_extremes_give_no_nan(score, case):
    scene = make(6, dtype=torch.float32)
    flat = scene.scales.clone()
    flat[:, 1] = -math.inf
    scene = {
        "infinite logits": lambda: scene.replace(
            opacities=torch.tensor([math.inf, -math.inf] * 3)[:, None]
        ),
        "flat": lambda: scene.replace(scales=flat),
        "huge": lambda: scene.replace(scales=torch.full_like(scene.scales, 80.0)),
        "tiny": lambda: scene.replace(scales=torch.full_like(scene.scales, -80.0)),
        "one": lambda: scene[:1],
        "empty": lambda: scene[:0],
    }[case]()
    found = score(scene, views())
    assert found.shape == (len(scene),) and not found.isnan().any() and (found < math.inf).all()


def test_sensitivities_do_not_depend_on_the_precision_of_the_scene():
    scene = make(40, dtype=torch.float32)
    scales = scene.scales.clone()
    scales[:20, 0] += math.log(
        1e3
    )  # needles, whose blocks have condition numbers that float32 does not hold
    scales[20:] -= math.log(30)  # and points, seen by too few pixels to tell six parameters
    scene = scene.replace(scales=scales)
    single, double = (
        pup_score(scene.to(dtype), views(count=2)) for dtype in (torch.float32, torch.float64)
    )
    assert double.isfinite().sum() > 20
    # the six parameters, rounded to float32 after exp() and the sigmoid; 0.01 is 1 % of the
    # determinant
    assert torch.equal(single.isfinite(), double.isfinite())
    assert torch.allclose(single, double, atol=0.01)


@pytest.mark.parametrize("factor", [1e-40, 1.0, 1e40])
def test_determinants_neither_overflow_nor_underflow(factor):
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 6, 6, generator=generator, dtype=torch.float64)
    blocks = root @ root.mT
    wanted = torch.logdet(blocks) + 6 * math.log(factor)
    assert torch.allclose(log_determinant(blocks * factor), wanted, rtol=1e-9)
    assert (log_determinant(torch.zeros(2, 6, 6).double()) == -math.inf).all()


def test_what_is_undetermined_is_ranked_by_the_rest():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 6, 3, generator=generator, dtype=torch.float64)
    singular = root @ root.mT  # rank 3: the other three eigenvalues are rounding errors
    diagonal = singular.diagonal(dim1=1, dim2=2)
    unit = singular / (diagonal[:, :, None] * diagonal[:, None]).sqrt()
    wanted = (
        torch.linalg.eigvalsh(unit)[:, 3:].log().sum(1) + 3 * math.log(1e-9) + diagonal.log().sum(1)
    )
    assert torch.allclose(log_determinant(singular), wanted, rtol=1e-9)
    # seen twice as brightly, worth more; with the rounding errors themselves that is a matter of
    # luck
    assert torch.allclose(
        log_determinant(4 * singular) - log_determinant(singular),
        torch.tensor(6 * math.log(4.0)).double(),
    )


@pytest.mark.parametrize("score", [lightgaussian_score, pup_score])
def test_no_view_is_an_error(score):
    with pytest.raises(DataError, match="no view"):
        score(make(), views()[:0])
