"""What must not change the picture, over drawn scenes (hypothesis, always the same examples)."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pointsplat_ns.rasterizer import rasterization

F64 = torch.float64
examples = settings(
    derandomize=True, max_examples=12, deadline=None, database=None, suppress_health_check=list(HealthCheck)
)
EXACT = 1e-9  # float64, another order of the same sums


@st.composite
def scenes(draw, max_std=1.0):
    """Means, quats, scales, opacities, SH (degree 3) in front of the camera: few or many, needles and balls."""
    g = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    n = draw(st.integers(1, 60))
    spread = draw(st.floats(0.0, 2.0))
    size = draw(st.floats(-4.0, -0.5))

    def randn(*shape):
        return torch.randn(*shape, generator=g, dtype=F64)

    means = randn(n, 3) * torch.tensor([1.0, 1.0, 0.5], dtype=F64) + torch.tensor([0, 0, 3.0], dtype=F64)
    scales = torch.exp(size + spread * randn(n, 3)).clamp_max(max_std)
    return [means, randn(n, 4), scales, torch.rand(n, generator=g, dtype=F64), 0.3 * randn(n, 16, 3)]


@st.composite
def rotations(draw):
    w, x, y, z = (draw(st.floats(-1, 1)) for _ in range(4))
    generator = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=F64)
    return torch.linalg.matrix_exp((1 + w) * generator)


def camera(width=31, height=26):
    K = torch.tensor([[35.0, 0, 0.52 * width], [0, 33.0, 0.47 * height], [0, 0, 1]], dtype=F64)
    view = torch.eye(4, dtype=F64)
    c, s = math.cos(0.15), math.sin(0.15)
    view[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=F64)
    view[:3, 3] = torch.tensor([0.1, -0.1, 0.2], dtype=F64)
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
@given(scenes(), st.integers(0, 1000), st.sampled_from(["classic", "antialiased"]))
def test_the_order_of_the_gaussians_does_not_matter(scene, seed, mode):
    order = torch.randperm(len(scene[0]), generator=torch.Generator().manual_seed(seed))
    assert_same(render([t[order] for t in scene], *camera(), mode=mode), render(scene, *camera(), mode=mode))


@examples
@given(scenes(), st.tuples(*[st.floats(-1e4, 1e4)] * 3))
def test_the_place_of_the_world_does_not_matter(scene, shift):
    view, *rest = camera()
    shift = torch.tensor(shift, dtype=F64)
    moved = view.clone()
    moved[:3, 3] -= view[:3, :3] @ shift
    # positions near 1e4 are held to 1e-12, and the slope of a needle's edge is up to 1e4 a unit
    assert_same(render([scene[0] + shift, *scene[1:]], moved, *rest), render(scene, view, *rest), 1e-7)


@examples
@given(scenes(), rotations(), st.sampled_from(["classic", "antialiased"]))
def test_the_heading_of_the_world_does_not_matter(scene, turn, mode):
    """At SH degree 0: the coefficients of higher degrees would have to be turned too."""
    view, *rest = camera()
    turned = view.clone()
    turned[:3, :3] = view[:3, :3] @ turn.T
    quats = torch.stack([_turn(turn, q) for q in scene[1]])
    got = render([scene[0] @ turn.T, quats, *scene[2:]], turned, *rest, sh_degree=0, mode=mode)
    assert_same(got, render(scene, view, *rest, sh_degree=0, mode=mode))


def _turn(turn, quat):
    """The quaternion of the rotation ``turn`` times that of ``quat``."""
    values, vectors = torch.linalg.eigh((turn + turn.T) / 2)
    axis = vectors[:, -1]  # of eigenvalue 1
    sine = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) @ axis / 2
    angle = torch.atan2(sine, (torch.trace(turn) - 1) / 2)
    w, v = torch.cos(angle / 2), torch.sin(angle / 2) * axis
    return torch.cat([(w * quat[0] - v @ quat[1:])[None], w * quat[1:] + quat[0] * v + torch.linalg.cross(v, quat[1:])])


@examples
@given(scenes(), st.floats(-6, 6))
def test_the_unit_of_length_does_not_matter(scene, exponent):
    factor = 10.0**exponent
    view, *rest = camera()
    scaled = view.clone()
    scaled[:3, 3] *= factor
    got = render([scene[0] * factor, scene[1], scene[2] * factor, *scene[3:]], scaled, *rest, near=0.01 * factor)
    assert_same(got, render(scene, view, *rest))


@examples
@given(scenes(), st.floats(1e-6, 1e6))
def test_the_length_of_quaternions_and_their_sign_do_not_matter(scene, length):
    want = render(scene, *camera())
    assert_same(render([scene[0], -length * scene[1], *scene[2:]], *camera()), want)


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


@examples
@given(scenes())
def test_a_gaussian_and_its_two_halves_at_one_depth_are_the_same(scene):
    """Doubling all Gaussians: each becomes two that tie and together let through what the one did.

    With alpha = o exp(-sigma) that holds where sigma is 0, so for Gaussians that are flat over the image: huge ones.
    There, the weights of the two halves times one colour add up to the weight of the one.
    """
    scene = [t.clone() for t in scene]
    scene[2][:] = 1e7
    scene[3] = 0.05 + 0.2 * scene[3]
    half = 1 - (1 - scene[3]).sqrt()
    doubled = [t.repeat_interleave(2, 0) for t in (*scene[:3], half, scene[4])]
    # a pixel stops before the Gaussian that brings it to 1e-4, here before its second half: at most 1e-4 of light
    assert_same(render(doubled, *camera()), render(scene, *camera()), 3e-4)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("packed", [False, True])
def test_the_same_input_gives_the_same_bits_forward_and_backward(mode, packed):
    g = torch.Generator().manual_seed(5)
    n = 3000
    means = torch.randn(n, 3, generator=g) * torch.tensor([1, 1, 0.5]) + torch.tensor([0, 0, 3.0])
    means[::7] = means[0]  # ties
    scene = [means, torch.randn(n, 4, generator=g), torch.exp(torch.randn(n, 3, generator=g) - 3.5),
             torch.rand(n, generator=g), 0.3 * torch.randn(n, 16, 3, generator=g)]  # fmt: skip
    view, K, width, height = camera(97, 83)
    runs = []
    for _ in range(3):
        leaves = [t.clone().requires_grad_() for t in scene]
        image, alpha, meta = rasterization(
            *leaves, view[None].float(), K[None].float(), width, height, sh_degree=3, absgrad=True,
            packed=packed, rasterize_mode=mode, render_mode="RGB+ED",
        )  # fmt: skip
        grads = torch.autograd.grad(image.square().sum() + alpha.sum(), [*leaves, meta["means2d"]])
        runs.append((image, alpha, *grads, meta["means2d"].absgrad))
    for other in runs[1:]:
        for one, two in zip(runs[0], other, strict=True):
            assert torch.equal(one, two)
