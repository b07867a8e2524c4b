"""Projection and colours against gsplat's own plain-torch formulas, in float64, with gradients."""

import pytest
import torch

from making import camera_askew, splats_in_view
from pointsplat_ns.rendering.projection import camera_of, project
from pointsplat_ns.rendering.spherical_harmonics import sh_to_color

F64 = torch.float64


def make_scene(n=60, seed=3, scale=-2.5):
    means, quats, stds, opacities, _ = splats_in_view(n, seed, scale=scale)
    return [
        means * torch.tensor([1.5, 1.2, 1.0], dtype=F64),
        3 * quats,
        stds,
        0.1 + 0.9 * opacities,
    ]


def gsplat_formulas():
    return pytest.importorskip("gsplat.cuda._torch_impl", reason="gsplat is not installed")


def random_like(tensors):
    g = torch.Generator().manual_seed(1)
    return [torch.randn(t.shape, generator=g, dtype=F64) for t in tensors]


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("cx,cy", [(20.0, 13.0), (-30.0, 13.0), (60.0, 45.0)])
def test_projection_and_its_gradients_are_gsplats(antialiased, cx, cy):
    """Means, depths, conics and compensation, with the frustum clamp that follows the principal
    point.

    Two differences on purpose: gsplat's compensation has no lower bound (ours is 0.005), so that
    this scene stays above it; and gsplat culls by a square of 3 standard deviations, ours by the
    ellipse at 1/255, so that what is compared is what ours keeps.
    """
    theirs = gsplat_formulas()
    scene = [t.requires_grad_() for t in make_scene(100, scale=-1.0)]
    means, quats, scales, opacities = scene
    view, K, w, h = *camera_askew(cx=cx, cy=cy), 37, 29
    view.requires_grad_()
    seen = project(*scene, camera_of(view, K, w, h, antialiased=antialiased))
    assert len(seen.ids) > 15

    covars, _ = theirs._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    _, means2d, depths, conics, compensations = theirs._fully_fused_projection(
        means, covars, view[None], K[None], w, h, calc_compensations=True
    )
    want = [means2d[0, seen.ids], depths[0, seen.ids], conics[0, seen.ids], opacities[seen.ids]]
    if antialiased:
        assert compensations[0, seen.ids].min() > 0.005
        want[3] = want[3] * compensations[0, seen.ids]
    got = [seen.means2d, seen.depths, seen.conics, seen.opacities]
    x = (means2d[0, :, 0] - cx) / 40.0
    low = -cx / 40 - 0.3 * 0.5 * w / 40
    high = (w - cx) / 40 + 0.3 * 0.5 * w / 40
    clamped = (x[seen.ids] < low) | (x[seen.ids] > high)
    assert clamped.any() and not clamped.all()
    for ours, gsplats in zip(got, want, strict=True):
        assert (ours - gsplats).abs().max() <= 1e-11 * gsplats.abs().max()
    weights = random_like(want)
    grads = [
        torch.autograd.grad(
            sum((o * x).sum() for o, x in zip(outputs, weights, strict=True)), [*scene, view]
        )
        for outputs in (got, want)
    ]
    for name, ours, gsplats in zip(
        "means quats scales opacities viewmat".split(), *grads, strict=True
    ):
        assert gsplats.any(), name
        assert (ours - gsplats).abs().max() <= 1e-9 * gsplats.abs().max(), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("stored", [1, 4, 9, 16])
def test_colours_and_their_gradients_are_gsplats(degree, stored):
    theirs = gsplat_formulas()
    if stored < (degree + 1) ** 2:
        with pytest.raises(ValueError, match=f"{stored} SH coefficients given"):
            sh_to_color(
                torch.zeros(2, 3),
                torch.zeros(2, 3),
                torch.zeros(2, stored - 1, 3),
                degree,
                torch.arange(2),
            )
        return
    g = torch.Generator().manual_seed(degree)
    directions = (4 * torch.randn(5000, 3, generator=g, dtype=F64)).requires_grad_()
    coefficients = torch.randn(6000, stored, 3, generator=g, dtype=F64).requires_grad_()
    ids = torch.randperm(6000, generator=g)[:5000].sort().values
    got = sh_to_color(directions, coefficients[:, 0], coefficients[:, 1:], degree, ids)
    want = (theirs._spherical_harmonics(degree, directions, coefficients[ids]) + 0.5).clamp_min(0)
    assert (got == 0).any() and (got - want).abs().max() < 1e-13
    (weights,) = random_like([want])
    grads = [
        torch.autograd.grad((out * weights).sum(), [coefficients, directions], allow_unused=True)
        for out in (got, want)
    ]
    assert (grads[0][0] - grads[1][0]).abs().max() < 1e-12
    if degree > 0:
        assert (grads[0][1] - grads[1][1]).abs().max() < 1e-12
    else:
        assert grads[0][1] is None  # a constant has no direction
