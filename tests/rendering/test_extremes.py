"""Degenerate and extreme scenes: finite, the same in float32 as in float64, and in float64 as the
reference says.

Input is rounded to float32 first, so that what is compared is the arithmetic, not what float32 can
hold.
"""

import dataclasses
import functools
import itertools
import math

import pytest
import torch

from lab.numerics.reference import rasterize_reference
from making import camera_askew, splats_in_view
from pointsplat_ns.rendering import rasterization, render, render_depth
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View

F64 = torch.float64
NAMES = ("means", "quats", "scales", "opacities", "colors")

make_scene = functools.partial(splats_in_view, seed=11, scale=-2.5)


def draw(
    scene, view, K, size, dtype, near=0.01, mode="classic", sh_degree=3, slow=False, compiled=None
):
    """Image with depth, alpha, and the gradients of a fixed random sum of them, in float64."""
    leaves = [t.detach().to(dtype, copy=True).requires_grad_() for t in scene]
    w, h = size
    if slow:
        image, alpha, depth = rasterize_reference(
            *leaves,
            view.to(dtype),
            K.to(dtype),
            w,
            h,
            near,
            sh_degree=sh_degree,
            antialiased=mode == "antialiased",
        )
        image = torch.cat([image, depth], -1)
    else:
        image, alpha, meta = rasterization(
            *leaves,
            view[None].to(dtype),
            K[None].to(dtype),
            w,
            h,
            near_plane=near,
            sh_degree=sh_degree,
            rasterize_mode=mode,
            render_mode="RGB+D",
            compiled=compiled,
        )
        image = image[0]
        alpha = alpha[0]
    g = torch.Generator().manual_seed(1)
    far = max(float(scene[0].abs().max()), float(view[:3, 3].norm()))
    pixels = torch.cat([image[..., :3], alpha, image[..., 3:] / far], -1)
    weights = torch.rand(pixels.shape, generator=g, dtype=F64).to(dtype)
    total = (pixels * weights).sum()
    grads = torch.autograd.grad(total, leaves, materialize_grads=True)
    assert pixels.isfinite().all()
    for name, grad in zip(NAMES, grads, strict=True):
        assert grad.isfinite().all(), name
    return pixels.detach().double(), [g.double() for g in grads]


def relative_change(scene, grads):
    """Gradients by log scale and by the direction of the quaternion, whose size means something at
    any scale."""
    means, quats, scales, opacities, colors = grads
    size = scene[0].std().clamp_min(1e-30)
    return [
        means * size,
        quats * scene[1].norm(dim=-1, keepdim=True),
        scales * scene[2],
        opacities,
        colors,
    ]


def check(
    scene,
    camera,
    size=(37, 29),
    tolerance=1e-5,
    grad_tolerance=5e-5,
    flips=0.005,
    reference=True,
    **options,
):
    """float32 against float64, and float64 against the reference.

    The tolerances are ten times what float32's 1e-7 was seen to become over 50 layers: 1e-6 in a
    pixel, 5e-6 in the norm of a gradient.
    """
    view, K = (t.float().double() for t in camera)
    scene = [t.float().double() for t in scene]
    single, single_grads = draw(scene, view, K, size, torch.float32, **options)
    double, double_grads = draw(scene, view, K, size, F64, **options)
    difference = (single - double).abs().amax(-1)
    assert double[..., 3].max() > 0.05, "the scene shows nothing"
    # a pixel whose alpha is at 1/255, or whose transmittance is at 1e-4, may fall on either side
    flipped = difference > tolerance
    assert flipped.double().mean() <= flips, difference.max()
    assert difference.max() < 0.02
    pairs = list(
        zip(
            NAMES,
            relative_change(scene, single_grads),
            relative_change(scene, double_grads),
            strict=True,
        )
    )
    for name, got, want in pairs:
        assert (got - want).norm() <= grad_tolerance * want.norm() + 1e-7, (
            name,
            (got - want).norm() / want.norm(),
        )
    if reference:
        truth, truth_grads = draw(scene, view, K, size, F64, slow=True, **options)
        assert (double - truth).abs().max() < 1e-8  # the same in another order
        for name, got, want in zip(
            NAMES,
            relative_change(scene, double_grads),
            relative_change(scene, truth_grads),
            strict=True,
        ):
            assert (got - want).norm() <= 1e-6 * want.norm() + 1e-12, name
    return single, single_grads


def _log_scales(scene):
    scene[2] = torch.linspace(-80, 20, 150, dtype=F64)[
        torch.randperm(150, generator=torch.manual_seed(0))
    ].view(50, 3)
    # the first is flat over the image, and its determinant 1e39
    scene[2][0] = 20
    scene[2][1] = -80
    scene[2] = scene[2].exp()
    scene[3] = 0.3 * scene[3]


def _needles(scene):
    scene[2][:, 0] = 3.0
    scene[2][:, 1:] = 3e-6


def _stacked(scene):
    scene[3][:] = 1.0
    scene[0][:30] = torch.tensor([0.0, 0.0, 3.0], dtype=F64)


CASES = {
    "zero quaternions": lambda s: s[1][::2].zero_(),
    "quaternions of any length": lambda s: s[1].mul_(
        10.0 ** torch.linspace(-18, 18, 50, dtype=F64)[:, None]
    ),
    "one flat axis": lambda s: s[2][:, 2].zero_(),
    "lines": lambda s: s[2][:, 1:].zero_(),
    "points": lambda s: s[2].zero_(),
    "opacity exactly 1, stacked": _stacked,
    "opacity exactly 0": lambda s: s[3][::2].zero_(),
    "opacity above 1": lambda s: s[3].mul_(3),
    "coincident": lambda s: s[0].copy_(
        s[0][:1].expand_as(s[0]).clone() * torch.tensor([0.1, 0.1, 1])
    ),
    "log-scales from -80 to 20": _log_scales,
    "needles of aspect 1e6": _needles,
    "covering the image a hundred times": lambda s: (
        s[2].fill_(37 * 100 * 3.0 / 40),
        s[3].mul_(0.3),
    ),
}


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("case", CASES)
def test_degenerate_gaussians(case, mode):
    scene = make_scene(50)
    CASES[case](scene)
    if mode == "antialiased" and any(word in case for word in ("lines", "points", "needles")):
        scene[3][:] = 40.0  # the compensation is at or near its lower bound of 0.005
    check(scene, camera_askew(), mode=mode, reference=case != "log-scales from -80 to 20")
    # (with axes of 1e20 pixels the reference's xx yy - xy^2 cancels to 0 even in float64)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_gradients_are_right_for_any_size_that_float32_holds(axes, mode):
    view, K = (t.float().double() for t in camera_askew())
    for log_scale, opacity in itertools.product((0.0, 20.0, 88.7), (0.02, 0.99)):
        scene = make_scene(5)
        scene[2][:, :axes] = math.exp(log_scale)
        scene[3][:] = opacity
        scene = [t.float().double() for t in scene]
        double, double_grads = draw(scene, view, K, (37, 29), F64, mode=mode)
        wanted = relative_change(scene, double_grads)
        # What is flat over the image does not change with its size: that gradient is 1e-9 of the
        # largest and less.
        largest = max(float(want.norm()) for want in wanted)
        for compiled in (None, False):
            single, single_grads = draw(
                scene, view, K, (37, 29), torch.float32, mode=mode, compiled=compiled
            )
            assert (single - double).abs().max() <= 1e-5, (log_scale, compiled)  # as in check()
            for name, got, want in zip(
                NAMES, relative_change(scene, single_grads), wanted, strict=True
            ):
                assert (got - want).norm() <= 5e-6 * largest, (name, log_scale, opacity, compiled)


def gaussians_of(means, quats, scales, opacities, sh):
    return Gaussians(
        means, scales.log(), quats, torch.logit(opacities)[:, None], sh[:, 0], sh[:, 1:]
    )


def test_unusable_gaussians_are_counted_and_have_no_gradient():
    scene = gaussians_of(*(value.float() for value in make_scene(9)))
    # as large as float32 holds
    scene.scales[3, 0] = 88.7
    scene.opacities[4] = math.inf
    spoilt = scene.map(torch.clone)
    rest = [0, *range(3, 9)]
    spoilt.features_dc[1, 0] = math.nan
    spoilt.scales[2, 0] = 89.0
    assert spoilt.usable().tolist() == [row in rest for row in range(9)]

    view = View(*camera_askew(), 37, 29, torch.zeros(3))
    leaves, others = (
        of.map(lambda value: value.clone().requires_grad_()) for of in (spoilt, scene[rest])
    )
    with pytest.warns(
        UserWarning, match="2 of 9 Gaussians have NaN or infinite values and are not drawn"
    ):
        image = render(leaves, view)
    wanted = render(others, view)
    grads, wanted_grads = (
        torch.autograd.grad(drawn.square().sum(), of.tensors())
        for drawn, of in ((image, leaves), (wanted, others))
    )
    assert torch.equal(image, wanted)
    for grad, expected in zip(grads, wanted_grads, strict=True):
        assert not grad[1:3].any() and torch.equal(grad[rest], expected)


def test_gaussians_at_and_across_the_camera_plane():
    scene = make_scene(50)
    (view, K) = camera_askew()
    centre = torch.linalg.solve(view[:3, :3], -view[:3, 3])
    scene[0][0] = centre  # depth and view vector exactly zero
    scene[0][1:9] = centre + (scene[0][1:9] - centre) * 1e-3
    scene[0][9:18, 2] *= -1
    scene[2][:18] *= 30  # wide enough to reach from behind the camera, or to hold it inside
    single, grads = check(scene, (view, K))
    assert all((g[0] == 0).all() for g in grads)


def _around_the_camera(scene, view):
    scene[2][:] = scene[2] / scene[2].amax(-1, keepdim=True) * 20.0
    scene[3][:] = 0.2


def _far_from_the_origin(scene, view):
    # check() rounds means and view to float32 before anything is drawn: they move by 0.03 units,
    # the arithmetic not
    shift = torch.tensor([1e6, -7e5, 4e5], dtype=F64)
    scene[0] = scene[0] * 64 + shift
    scene[2] = scene[2] * 64
    view[:3, 3] = view[:3, 3] * 64 - view[:3, :3] @ shift


def _ten_thousand_times_farther(scene, view):
    # as from a satellite: x and y before the camera are small sums of products of the distance
    view[2, 3] += 3.0 * 9999


def _into_sight(cx, cy):
    def change(scene, view):
        scene[2] *= 3
        scene[0][:, :2] -= (
            (torch.tensor([cx, cy], dtype=F64) - torch.tensor([18.0, 14.0])) / 40.0 * 3.0
        )

    return change


def _larger(times):
    def change(scene, view):
        scene[2] *= times

    return change


VIEWED = {
    "camera inside Gaussians": (_around_the_camera, {}, (37, 29)),
    "a million units from the origin": (_far_from_the_origin, {}, (37, 29)),
    "lens of 4e5 pixels": (_ten_thousand_times_farther, {"focal": 4e5}, (37, 29)),
    "lens of a pixel": (_larger(10), {"focal": 1.0}, (37, 29)),  # a degree and more per pixel
    **{
        f"principal point at {cx:g}, {cy:g}": (_into_sight(cx, cy), {"cx": cx, "cy": cy}, (37, 29))
        for cx, cy in ((-60.0, 13.0), (90.0, 80.0), (20.0, -500.0))
    },
    **{
        f"{w} x {h} pixels": (
            _larger(4),
            {"cx": w / 2, "cy": h / 2, "focal": max(20.0, 0.6 * max(w, h))},
            (w, h),
        )
        for w, h in ((1, 1), (1, 1500), (1500, 1), (61, 53))
    },
}
"""What changes scene and view, arguments of the camera, and the size of the image."""


@pytest.mark.parametrize("case", VIEWED)
def test_places_and_lenses_of_the_camera(case):
    change, lens, size = VIEWED[case]
    scene = make_scene(50)
    (view, K) = camera_askew(**lens)
    change(scene, view)
    check(scene, (view, K), size)


def test_nothing_is_too_far_away_to_be_drawn():
    """Of this nothing is nearer than gsplat's far plane of 1e10."""
    scene = gaussians_of(*make_scene(50))
    view, K = camera_askew()
    plain = View(view, K, 37, 29, torch.zeros(3))
    want = render(scene, plain)
    depth = render_depth(scene, plain)[0]
    assert want.max() > 0.3

    vast = scene.replace(means=scene.means * 1e12, scales=scene.scales + math.log(1e12))
    view = plain.viewmat.clone()
    view[:3, 3] *= 1e12
    there = dataclasses.replace(plain, viewmat=view, near_plane=1e10)
    assert (render(vast, there) - want).abs().max() < 1e-9
    assert (render_depth(vast, there)[0] / 1e12 - depth).abs().max() < 1e-9


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    "n,hidden", [(0, ""), (1, ""), (1, "behind"), (20, "behind"), (7, "transparent")]
)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_few_or_no_gaussians(n, hidden, dtype, packed):
    means, quats, scales, opacities, sh = (value[:n] for value in make_scene(max(n, 1)))
    means[:1] = torch.tensor([0, 0, 3.0], dtype=F64)
    opacities = 0.5 + 0.5 * opacities
    if hidden == "behind":
        means[:, 2] = -means[:, 2].abs() - 1
    if hidden == "transparent":
        opacities *= 1e-4
    view, K = (camera[None].to(dtype) for camera in camera_askew())
    leaves = [value.to(dtype).requires_grad_() for value in (means, quats, scales, opacities, sh)]
    options = {"sh_degree": 2, "render_mode": "RGB+ED", "packed": packed, "absgrad": True}
    image, alpha, meta = rasterization(*leaves, view, K, 37, 29, **options)
    assert image.isfinite().all() and meta["skipped"] == 0
    assert bool(alpha.any()) == bool(image.any()) == (n > 0 and not hidden)
    for grad in torch.autograd.grad(image.sum() + alpha.sum(), leaves, materialize_grads=True):
        assert grad.isfinite().all() and not (hidden and grad.any())
