"""Rasterization, and properties that hold for any scene."""

import inspect
import math
import re

import pytest
import torch

from making import REPOSITORY, camera_askew, splats_in_view
from pointsplat_ns.rendering import rasterization

F64 = torch.float64


def leaves(tensors):
    return [t.detach().clone().requires_grad_() for t in tensors]


def test_gradcheck():
    scene = splats_in_view(3, seed=5, scale=0.3, spread=0.3)
    scene[3], scene[4] = 0.3 + 0.5 * scene[3], scene[4][:, :9]
    scene = leaves(scene)
    view, K, w, h = *camera_askew(cx=3.0, cy=2.5), 6, 5
    K = K * torch.tensor([[0.15], [0.15], [1.0]], dtype=F64)
    K[0, 2] = 3.0
    K[1, 2] = 2.5
    background = torch.rand(1, 3, dtype=F64, requires_grad=True)

    def render(*args):
        *scene, background = args
        image, alpha, _ = rasterization(
            *scene,
            view[None],
            K[None],
            w,
            h,
            sh_degree=2,
            backgrounds=background,
            render_mode="RGB+ED",
        )
        return image, alpha

    # all pixels see all Gaussians far above the 1/255 threshold, where the image is smooth
    assert (render(*scene, background)[1] > 0.05).all()
    assert torch.autograd.gradcheck(
        render, (*scene, background), eps=1e-6, atol=1e-5, fast_mode=True
    )


def test_batched_cameras_equal_one_at_a_time_packed_or_not():
    scene = leaves(splats_in_view(120, seed=8))
    cameras = [camera_askew(angle=a) for a in (-0.3, 0.2, 3.0)]  # the last looks away
    views = torch.stack([c[0] for c in cameras])
    Ks = torch.stack([c[1] for c in cameras])
    w = 37
    h = 29
    for packed in (False, True):
        options = {"sh_degree": 1, "packed": packed, "absgrad": True}
        image, alpha, meta = rasterization(*scene, views, Ks, w, h, **options)
        grads = torch.autograd.grad(image.square().sum(), scene)
        absolute = []
        total = [torch.zeros_like(value) for value in scene]
        for c in range(3):
            one, one_alpha, of_one = rasterization(
                *scene, views[c : c + 1], Ks[c : c + 1], w, h, **options
            )
            assert torch.equal(image[c], one[0]) and torch.equal(alpha[c], one_alpha[0])
            total = list(map(torch.add, total, torch.autograd.grad(one.square().sum(), scene)))
            absolute.append(of_one["means2d"].absgrad)
        torch.testing.assert_close(list(grads), total, rtol=1e-12, atol=1e-12)
        assert torch.equal(meta["means2d"].absgrad, torch.cat(absolute)) and absolute[0].any()
        rows = meta["radii"].shape
        assert rows == ((len(meta["gaussian_ids"]),) if packed else (3, 120))
        assert meta["means2d"].shape == (*rows, 2) and meta["conics"].shape == (*rows, 3)


@pytest.mark.parametrize("packed", [False, True])
def test_absgrad_is_the_sum_over_pixels_of_absolute_gradients(packed):
    scene = leaves(splats_in_view(30, seed=2, scale=-2.0))
    view, K, w, h = *camera_askew(cx=3.0, cy=2.5), 7, 6
    image, _, meta = rasterization(
        *scene, view[None], K[None], w, h, sh_degree=0, absgrad=True, packed=packed
    )
    meta["means2d"].retain_grad()
    g = torch.Generator().manual_seed(0)
    weights = torch.randn(image.shape, generator=g, dtype=F64)
    (image * weights).sum().backward(retain_graph=True)
    got = meta["means2d"].absgrad.clone()
    signed = meta["means2d"].grad.clone()
    want = torch.zeros_like(got)
    total = torch.zeros_like(got)
    for y in range(h):
        for x in range(w):
            (grad,) = torch.autograd.grad(
                (image * weights)[0, y, x].sum(), meta["means2d"], retain_graph=True
            )
            want += grad.abs()
            total += grad
    torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(signed, total, rtol=1e-9, atol=1e-12)
    assert (got > signed.abs() + 1e-6).any()


@pytest.mark.parametrize(
    "change,message",
    [
        (dict(means=torch.zeros(3, 2)), r"means has shape \(3, 2\)"),
        (dict(opacities=torch.zeros(4)), r"opacities has shape \(4,\); expected \(3,\)"),
        (dict(width=7.5), "7.5 x 8 pixels; expected whole numbers"),
        (dict(eps2d=-1.0), "eps2d is -1.0; expected a number from 0"),
        (dict(near_plane=2.0, far_plane=1.0), "near_plane is 2.0 and far_plane 1.0"),
        (dict(memory_budget=0), "memory_budget is 0"),
        (dict(viewmats=torch.eye(4)), r"viewmats has shape \(4, 4\); expected \(4, 4, 4\)"),
        (
            dict(colors=torch.ones(3, 16, 3)),
            r"colors has shape \(3, 16, 3\).*SH coefficients need sh_degree",
        ),
        (dict(colors=torch.ones(3, 25, 3), sh_degree=4), "sh_degree is 4; expected 0 to 3"),
        (dict(backgrounds=torch.zeros(1, 5)), r"backgrounds has shape \(1, 5\); expected \(1, 3\)"),
        (
            dict(Ks=torch.tensor([[[9.0, 0.5, 4], [0, 9, 4], [0, 0, 1]]])),
            "K is .*0.5.*expected no skew",
        ),
        (
            dict(viewmats=torch.diag(torch.tensor([1.0, 1, 1, 2]))[None]),
            "viewmat has the last row .*2.0",
        ),
        (dict(viewmats=torch.diag(torch.tensor([0.0, 0, 0, 1]))[None]), "viewmat is .*a rotation"),
        (dict(viewmats=torch.full((1, 4, 4), math.inf)), "viewmat is .*inf.*expected finite"),
        (
            dict(Ks=torch.tensor([[[0.0, 0, 4], [0, 9, 4], [0, 0, 1]]])),
            "fx 0.0.*focal lengths other than 0",
        ),
        (dict(Ks=torch.tensor([[[9.0, 0, 4], [0, 9, math.nan], [0, 0, 1]]])), "cy nan"),
        (
            dict(colors=(torch.zeros(3, 3), torch.zeros(3, 3, 3)), sh_degree=3),
            "4 SH coefficients given",
        ),
        (
            dict(colors=(torch.zeros(3, 3), torch.zeros(2, 3, 3)), sh_degree=1),
            r"shapes \(3, 3\), \(2, 3, 3\); expected",
        ),
    ],
)
def test_wrong_arguments_say_what_was_got_and_wanted(change, message):
    view, K = camera_askew(torch.float32)
    args = dict(
        means=torch.tensor([[0.0, 0, 3]] * 3),
        quats=torch.ones(3, 4),
        scales=torch.ones(3, 3),
        opacities=torch.ones(3),
        colors=torch.ones(3, 3),
        viewmats=view[None],
        Ks=K[None],
        width=8,
        height=8,
    )
    with pytest.raises(ValueError, match=message):
        rasterization(**{**args, **change})


GSPLAT_TAKES = """
means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree packed
tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed camera_model covars
""".split()

GSPLAT_RETURNS = """camera_ids gaussian_ids radii means2d depths conics opacities tile_width tile_height tiles_per_gauss
isect_ids flatten_ids isect_offsets width height tile_size n_cameras
""".split()


def test_the_differences_from_gsplat_are_those_that_the_page_lists():
    section = (
        (REPOSITORY / "docs" / "rasterizer.md")
        .read_text("utf-8")
        .split("## Differences from gsplat")[1]
    )
    section = section.split("\n## ")[0]
    assert "gsplat 1.4.0" in section
    lists = re.findall(r"^- \*\*(.+?)\*\*(.+?)(?=\n- |\n\n)", section, flags=re.M | re.S)
    listed = {title: re.findall(r"`(\w+)`", names) for title, names in lists}
    ours = inspect.signature(rasterization).parameters
    by_keyword = [
        name for name, parameter in ours.items() if parameter.kind is parameter.KEYWORD_ONLY
    ]
    assert by_keyword == listed.pop("Additional arguments")
    assert [*ours][: -len(by_keyword)] + listed.pop("Arguments not taken") == GSPLAT_TAKES

    view, K = camera_askew()
    scene = *splats_in_view(30, 0), view[None], K[None], 37, 29
    image, _, meta = rasterization(*scene, sh_degree=1)
    assert set(GSPLAT_RETURNS) - {*meta} == set(listed.pop("Not in meta"))
    assert {*meta} - set(GSPLAT_RETURNS) == set(listed.pop("Additionally in meta"))
    given = dict(tile_size=32, sparse_grad=True, channel_chunk=1)
    again, *_ = rasterization(*scene, sh_degree=1, **given)
    assert image.any() and torch.equal(image, again)
    assert [*given] == listed.pop("Arguments without effect") and not listed
