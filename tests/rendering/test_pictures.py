"""Pictures drawn in one pass are those of torch, from ordinary scenes to degenerate ones."""

import math
from dataclasses import replace

import pytest
import torch

from making import assert_same_on_any_threads, normal_scene
from pointsplat_ns.rendering import pixels_of, pixels_of_each, render
from pointsplat_ns.rendering import render_scene as drawing
from pointsplat_ns.rendering import whole_pictures as pictures
from pointsplat_ns.scene.views import ImageSize, View, Views
from pointsplat_ns.system.kernels import KERNELS

WIDTH = 67
HEIGHT = 43

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def scene_of(degree=3, count=1500):
    """Gaussians in and around a picture, and behind the camera."""
    scene = normal_scene(count, degree, seed=3)
    means = scene.means * torch.tensor([2.0, 1.5, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    return scene.replace(means=means, scales=0.7 * scene.scales - 2.5)


def view_of(mode="classic"):
    K = torch.tensor([[50.0, 0.0, 30.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]])
    return View(
        torch.eye(4).double(),
        K,
        WIDTH,
        HEIGHT,
        rasterize_mode=mode,
        background=torch.tensor([0.2, 0.5, 0.9]),
    )


def _far(scene, view):
    shift = torch.tensor([1e6, -7e5, 4e5], dtype=torch.float64)
    means = (scene.means * 64 + shift).float()
    viewmat = view.viewmat.clone()
    viewmat[:3, 3] = -shift
    return scene.replace(means=means, scales=scene.scales + math.log(64)), replace(
        view, viewmat=viewmat
    )


def _needles(scene, view):
    return scene.replace(
        scales=torch.tensor([0.0, -9.0, -9.0]).expand(len(scene), 3).contiguous()
    ), view


def _large_and_tiny(scene, view):
    scales = scene.scales + 4
    scales[::2] -= 12
    return scene.replace(scales=scales), view


def _meaningless(scene, view):
    tensors = [value.clone() for value in scene.tensors()]
    for i, wrong in enumerate((math.nan, math.inf, -math.inf)):
        for j, tensor in enumerate(tensors):
            rows = tensor[60 * i + 10 * j : 60 * i + 10 * j + 10].view(10, -1)
            rows[torch.arange(10), torch.arange(10) % rows.shape[1]] = wrong
    return type(scene)(*tensors), view


def _at_one_depth(scene, view):
    means = scene.means.clone()
    means[:, 2] = 2.0
    return scene.replace(means=means), view


CHANGES = [_far, _needles, _large_and_tiny, _meaningless, _at_one_depth]


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(
    "change", [None, *CHANGES], ids=lambda change: change.__name__ if change else "ordinary"
)
def test_pictures_and_pixels_are_those_of_torch(change, mode):
    scene = scene_of()
    view = view_of(mode)
    scene, view = change(scene, view) if change else (scene, view)
    assert pictures.can_draw(scene, None) and not pictures.can_draw(scene.to(torch.float64), None)
    image, alpha = drawing.render_with_alpha(scene, view)
    wanted, wanted_alpha = drawing.render_with_alpha(
        scene.to(torch.float64), view
    )  # which torch draws
    wanted_pixels = pixels_of(scene.to(torch.float64), view)
    assert wanted_alpha.any()
    # float32 against float64: a pixel at the threshold of 1/255 may fall either way, and then
    # differs by so much
    for ours, torchs in ((image, wanted), (alpha, wanted_alpha)):
        off = (ours - torchs).abs()
        assert off.max() < 1.5 / 255 and (off > 1e-4).float().mean() < 0.01
    for compiled in (None, False):
        pixels = pixels_of(scene, view, compiled)
        assert ((pixels - wanted_pixels).abs() > 1e-3 * (1 + wanted_pixels)).float().mean() < 0.02


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("quality", ["exact", "balanced", "fast"])
def test_pictures_are_those_of_the_general_way_to_rounding(degree, quality, monkeypatch):
    scene = scene_of(degree)
    view = view_of()
    at_once = drawing.render_with_alpha(scene, view, quality)
    pixels = pixels_of(scene, view)
    monkeypatch.setattr(pictures, "MOST_PAIRS", 10)  # as a picture of too many pairs is drawn
    for ours, others in zip(at_once, drawing.render_with_alpha(scene, view, quality), strict=True):
        torch.testing.assert_close(ours, others, rtol=0, atol=1e-6)
    torch.testing.assert_close(pixels_of(scene, view), pixels, rtol=1e-5, atol=1e-4)


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_pixels_of_each_view_are_those_of_one_view_at_a_time(mode, monkeypatch):
    scene = scene_of(count=3000)
    view = view_of(mode)
    viewmats = view.viewmat.repeat(5, 1, 1)
    viewmats[:, 2, 3] += torch.arange(5).to(viewmats)  # from farther and farther away
    sizes = [ImageSize(view.width, view.height), ImageSize(40, 72)]
    views = Views(
        viewmats,
        view.K.repeat(5, 1, 1),
        view.width,
        view.height,
        view.background,
        near_plane=view.near_plane,
        rasterize_mode=mode,
        images=[sizes[index % 2] for index in range(5)],
    )
    wanted = torch.stack([pixels_of(scene, one) for one in views])
    assert wanted.any(1).all() and torch.equal(pixels_of_each(scene, views), wanted)
    assert pixels_of_each(scene, views[:0]).shape == (0, 3000)
    monkeypatch.setattr(pictures, "MOST_PAIRS", 10)  # too many pairs: one view at a time
    torch.testing.assert_close(pixels_of_each(scene, views), wanted, rtol=1e-5, atol=1e-4)
    torchs = pixels_of_each(scene, views, compiled=False)
    assert ((torchs - wanted).abs() > 1e-3 * (1 + wanted)).float().mean() < 0.02


@needs_compiler
@torch.no_grad()
def test_pictures_are_the_same_on_any_threads():
    scene = scene_of(count=12_000)
    view = view_of()
    assert_same_on_any_threads(
        lambda: [*drawing.render_with_alpha(scene, view), pixels_of(scene, view)]
    )
    assert_same_on_any_threads(lambda: gradients(scene, view))


def gradients(scene, view, only=slice(None)):
    """Gradients of a fixed sum over a picture and its alpha by the parameters of a scene."""
    leaves = scene.map(lambda value: value.detach().clone().requires_grad_())
    with torch.enable_grad():
        image, alpha = drawing.render_with_alpha(leaves, view)
        slope = torch.linspace(0.2, 1, WIDTH)[None, :, None].to(image)
        total = (image * slope).sin().sum() + (alpha * slope).square().sum()
    return torch.autograd.grad(total, leaves.tensors()[only])


@needs_compiler
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize(
    "change", [None, *CHANGES], ids=lambda change: change.__name__ if change else "ordinary"
)
def test_gradients_are_those_of_torch_and_as_near_to_float64(change, mode, monkeypatch):
    scene = scene_of()
    view = view_of(mode)
    scene, view = change(scene, view) if change else (scene, view)
    ours = gradients(scene, view)
    exact = gradients(scene.to(torch.float64), view)
    monkeypatch.setattr(pictures, "can_draw", lambda *_: False)
    general = gradients(scene, view)
    for got, others, wanted in zip(ours, general, exact, strict=True):
        assert got.isfinite().all() and wanted.any()
        # norms, as a pixel at a threshold may fall either way
        assert (got - others).norm() <= 2e-5 * others.norm()
        assert (got - wanted).norm() <= 2 * (others - wanted).norm() + 1e-6 * wanted.norm()


@needs_compiler
@pytest.mark.parametrize("degree", range(4))
def test_a_gradient_alone_is_as_among_others_and_of_many_pairs_as_of_few(degree, monkeypatch):
    scene = scene_of(degree)
    view = view_of()
    found = gradients(scene, view)
    for which, wanted in enumerate(found):
        assert torch.equal(gradients(scene, view, slice(which, which + 1))[0], wanted)
    monkeypatch.setattr(pictures, "MOST_PAIRS", 10)
    for ours, others in zip(found, gradients(scene, view), strict=True):
        assert (ours - others).norm() <= 2e-5 * others.norm()


@needs_compiler
def test_a_camera_that_moves_has_gradients():
    view = view_of()
    view = replace(view, viewmat=view.viewmat.clone().requires_grad_())
    (grad,) = torch.autograd.grad(render(scene_of(), view).sum(), view.viewmat)
    assert grad[:3].abs().sum() > 0


@needs_compiler
def test_a_scene_that_changes_before_its_gradient_is_refused():
    leaves = scene_of(1, 50).map(lambda value: value.clone().requires_grad_())
    total = render(leaves, view_of()).sum()
    with torch.no_grad():
        leaves.means.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


@pytest.mark.parametrize("count", [0, 1])
def test_of_no_gaussians_the_background_is_drawn(count):
    scene = scene_of(1, 1)[:count]
    view = view_of()
    scene = scene.replace(means=scene.means - 50.0)  # behind the camera, if there is one
    assert torch.equal(render(scene, view), view.background.expand(HEIGHT, WIDTH, 3))
    assert pixels_of(scene, view).tolist() == [0.0] * count
