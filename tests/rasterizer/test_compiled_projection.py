"""Compiled kernels project what torch projects, with the same gradients."""

import math

import pytest
import torch

from making import camera_askew, splats_in_view
from pointsplat_ns.rasterizer.projection import project
from pointsplat_ns.system.kernels import KERNELS

WIDTH, HEIGHT = 37, 29
F32, F64 = torch.float32, torch.float64
NAMES = ("means", "quats", "scales", "opacities", "viewmat")
OUTPUTS = ("means2d", "depths", "cov2d", "det", "opacities", "directions")

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def scene_of(n=400, scale=-2.0, **options):
    """Means, quaternions, scales, opacities, view and intrinsics, float64 numbers that float32 holds; but for some of
    the view, which stays in float64."""
    *scene, _ = splats_in_view(n, seed=7, scale=scale, **options)
    return [t.float().double() for t in (*scene, *camera_askew())]


def _meaningless(means, quats, scales, opacities, *_):
    for i, wrong in enumerate((math.nan, math.inf, -math.inf)):
        for j, tensor in enumerate((means, quats, scales, opacities)):
            tensor[20 * i + 4 * j : 20 * i + 4 * j + 4].view(4, -1)[:, 0] = wrong
    scales[60:70, 1] = -1e-3
    opacities[70:80] = -0.5


def _at_the_near_plane(means, quats, scales, opacities, view, K):
    view.copy_(torch.eye(4, dtype=F64))
    near = torch.tensor(0.25)
    means[:200, 2] = near.double()
    means[:50, 2] = torch.nextafter(near, torch.tensor(1.0)).double()
    means[50:100, 2] = torch.nextafter(near, torch.tensor(0.0)).double()
    means[:200, :2] *= 0.03
    means.copy_(means.float())


def _behind_and_inside(means, quats, scales, opacities, view, K):
    means[::2, 2] *= -1
    means[1::4] = means[1::4] * 1e-3
    scales[::3] *= 1e3


def _nothing(*_):
    pass


# What changes a scene, in place, and options of the projection. Whole pictures at more extremes: test_extremes.py.
CASES = {
    "ordinary": (_nothing, {}),
    "points, antialiased": (lambda m, q, s, o, *_: (s.mul_(1e-3), o.mul_(300)), {"antialiased": True}),
    "large, antialiased": (lambda m, q, s, *_: s.mul_(300), {"antialiased": True}),
    "without meaning": (_meaningless, {}),
    "behind, and around the camera": (_behind_and_inside, {}),
    "at the near plane": (_at_the_near_plane, {"near_plane": 0.25}),
    "a mirror": (lambda m, q, s, o, view, K: K[0, 0].neg_(), {}),
    "small ones left out": (_nothing, {"radius_clip": 6.0}),
    "far ones left out": (_nothing, {"far_plane": 3.0}),
    "no low-pass": (_nothing, {"eps2d": 0.0}),
}


def made(name):
    scene = scene_of()
    change, options = CASES[name]
    change(*scene)
    return scene, options


def projected(scene, options, dtype, compiled):
    """Leaves (N, ...) and what is seen; the view stays in float64."""
    leaves = [*(t.to(dtype, copy=True).requires_grad_() for t in scene[:4]), scene[4].clone().requires_grad_()]
    return leaves, project(*leaves, scene[5], WIDTH, HEIGHT, compiled=compiled, **options)


def values_and_gradients(leaves, seen, common, exact=None):
    """Of the Gaussians ``common``: outputs, and gradients of a sum in which each output weighs the same, in float64."""
    rows = torch.searchsorted(seen.ids, common)
    values = [getattr(seen, name)[rows] for name in OUTPUTS]
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros(())
    for value, size in zip(values, exact or values, strict=True):
        weights = torch.randn(size.shape, generator=generator, dtype=F64) / (1e-30 + size.detach().double().abs())
        total = total + (value * weights.to(value.dtype)).sum()
    grads = torch.autograd.grad(total, leaves)
    return [value.detach().double() for value in values], [grad.double() for grad in grads]


def off(ours, right):
    """How far rows are off: the norm of all, and the median of each one's."""
    one = ours.shape[0]
    difference, size = ((t.reshape(one, -1)) for t in (ours - right, right))
    rows = difference.norm(dim=1) / size.norm(dim=1)
    rows = rows[size.norm(dim=1) > 0]
    return float(difference.norm() / size.norm().clamp_min(1e-300)), float(rows.median()) if len(rows) else 0.0


def at_a_bound(scene, options):
    """Gaussians that some bound, moved by a thousandth of a pixel or the rounding of float32, keeps or drops."""
    seen = []
    for step in (-1, 1):
        for axis in (0, 1):
            moved = scene[5].clone()
            moved[axis, 2] += step * 1e-3
            seen.append(projected([*scene[:5], moved], options, F64, False)[1].ids)
        nudge = 1 + step * 1e-6
        bounds = {name: options[name] * nudge for name in ("near_plane", "far_plane", "radius_clip") if name in options}
        seen.append(projected([*scene[:3], scene[3] * nudge, *scene[4:]], {**options, **bounds}, F64, False)[1].ids)
    every = torch.cat(seen).bincount(minlength=len(scene[0]))
    return ((every > 0) & (every < len(seen))).nonzero()[:, 0]


@needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_projections_and_gradients_are_those_of_torch(name):
    scene, options = made(name)
    ours, torchs, exact = (projected(scene, options, *how) for how in ((F32, True), (F32, False), (F64, False)))
    ids, torchs_ids = (set(seen.ids.tolist()) for _, seen in (ours, torchs))
    assert len(ids) >= 50 and ours[1].ids.tolist() == sorted(ids)
    if ids != torchs_ids:
        assert ids ^ torchs_ids <= set(at_a_bound(scene, options).tolist())
    common = torch.tensor(sorted(ids & torchs_ids & set(exact[1].ids.tolist())))
    sizes = [getattr(exact[1], output)[torch.searchsorted(exact[1].ids, common)] for output in OUTPUTS]
    results = [values_and_gradients(leaves, seen, common, sizes) for leaves, seen in (ours, torchs, exact)]

    names = [*OUTPUTS, *(f"gradient of {part}" for part in NAMES)]
    for what, mine, theirs, right in zip(names, *([*values, *grads] for values, grads in results), strict=True):
        assert mine.isfinite().all(), what
        # ten times what was seen: float32 in another order
        assert off(mine, theirs)[0] <= 5e-6 and off(mine, theirs)[1] <= 5e-6, (what, off(mine, theirs))
        for error, torchs_error in zip(off(mine, right), off(theirs, right), strict=True):
            assert error <= 2 * torchs_error + 1e-6, (what, error, torchs_error)
    one, other = (seen.select(torch.searchsorted(seen.ids, common)) for _, seen in (ours, torchs))
    assert ((one.radii - other.radii).abs() <= 1 + 1e-6 * other.radii).all()  # rounded up
    assert off(one.depth_keys, other.depth_keys)[0] <= 1e-6
    dropped = torch.ones(len(scene[0]), dtype=torch.bool).index_fill_(0, common, False)
    assert not any(grad[dropped].any() for grad in results[0][1][:4])
