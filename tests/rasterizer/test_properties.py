"""What must not change the picture, over drawn scenes (hypothesis, always the same examples)."""

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from making import camera_askew, splats_in_view
from pointsplat_ns.rasterizer import rasterization

F64 = torch.float64
examples = settings(
    derandomize=True, max_examples=12, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
EXACT = 1e-9  # float64, another order of the same sums


@st.composite
def scenes(draw, max_std=1.0):
    """Means, quats, scales, opacities, SH (degree 3) in front of the camera: few or many, needles and balls."""
    seed, n = draw(st.integers(0, 2**31)), draw(st.integers(1, 60))
    scene = splats_in_view(n, seed, spread=draw(st.floats(0.0, 2.0)), scale=draw(st.floats(-4.0, -0.5)))
    scene[2].clamp_(max=max_std)
    return scene


def camera(width=31, height=26):
    view, K = camera_askew(angle=0.15, cx=0.52 * width, cy=0.47 * height, focal=34.0)
    return view, K, width, height


def render(scene, view, K, width, height, sh_degree=3, near=0.01, mode="classic"):
    image, alpha, _ = rasterization(
        *scene, view[None], K[None], width, height, near_plane=near, sh_degree=sh_degree, rasterize_mode=mode
    )
    return torch.cat([image, alpha], -1)[0]


def assert_same(got, want, tolerance=EXACT, flips=0.0):
    """Equal but for a share of pixels where an alpha at 1/255 or a transmittance at 1e-4 falls on the other side."""
    difference = (got - want).abs()
    assert difference.max() < 0.02
    assert (difference.amax(-1) > tolerance).double().mean() <= flips, difference.max()


@examples
@given(scenes(max_std=0.03), st.integers(1, 30), st.integers(1, 25))
def test_four_crops_make_the_whole(scene, column, row):
    """Where the frustum clamp does not bind. It reaches 0.15 times the width beyond the edges of the image, so of the
    crop: narrow crops clamp what stands 3 pixels outside of them. Gaussians this small reach no farther in than that.
    """
    view, K, width, height = camera()
    depth = scene[0] @ view[2, :3] + view[2, 3]
    scene = [t[depth > 1.5] for t in scene]  # 0.03 at 1.5 is 0.7 pixels, with eps2d a reach of 3.4 * 0.9 = 3 pixels
    whole = render(scene, view, K, width, height)
    parts = []
    for top, bottom in ((0, row), (row, height)):
        line = []
        for left, right in ((0, column), (column, width)):
            shifted = K.clone()
            shifted[0, 2] -= left
            shifted[1, 2] -= top
            line.append(render(scene, view, shifted, right - left, bottom - top))
        parts.append(torch.cat(line, dim=1))
    crops = torch.cat(parts)
    # a clamped Gaussian is seen on its flank alone, its Jacobian turned by 3 pixels of the focal length's 35
    assert_same(crops, whole, 1e-3, flips=0.02)
    # and the whole is the crop of something wider
    inner = K.clone()
    inner[0, 2] += 20
    wide = render(scene, view, inner, width + 20, height)[:, 20:]
    assert_same(wide, whole, 1e-3, flips=0.02)


@examples
@given(scenes(), st.integers(0, 1000))
def test_gaussians_at_one_depth_are_drawn_in_the_order_given(scene, seed):
    """The rule for ties: the rows that come first are in front, wherever other Gaussians stand in between."""
    order = torch.randperm(len(scene[0]), generator=torch.Generator().manual_seed(seed))
    view, K, width, height = camera()
    view[:3, :3] = torch.eye(3, dtype=F64)
    tied = [t.clone() for t in scene]
    tied[0][:, 2] = 3.0
    apart = [t.clone() for t in tied]
    # the same tie, broken by distances of no other consequence
    apart[0][:, 2] += 1e-9 * torch.arange(len(scene[0]), dtype=F64)
    assert_same(render(tied, view, K, width, height), render(apart, view, K, width, height), 1e-5)
    # rows before and after in another order, the tie itself kept: the same
    other = [t[order] for t in scene]
    other[0] = other[0] + torch.tensor([0, 0, 50.0], dtype=F64)
    before = render([torch.cat([o, t]) for o, t in zip(other, tied, strict=True)], view, K, width, height)
    after = render([torch.cat([t, o]) for o, t in zip(other, tied, strict=True)], view, K, width, height)
    assert_same(before, after)
