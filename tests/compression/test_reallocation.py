"""Splitting Gaussians where a loss pulls, and merging elsewhere: the number stays, and pull chooses what is split."""

import math

import pytest
import torch

from making import FewViews
from pointsplat_ns.compression.photo_repair import reallocated, split
from pointsplat_ns.geometry.transforms import rotation_matrices


def test_halves_lie_on_both_sides_along_the_longest_axis(hollow_ball):
    scene = hollow_ball[:5].replace(scales=torch.tensor([[-3.0, -1.0, -2.0]] * 4 + [[-math.inf, -4.0, 0.0]]))
    halves = split(scene, torch.tensor([4, 1]))
    assert len(halves) == 7
    for name, value in scene.items():
        assert torch.equal(dict(halves.items())[name][:3], value[[0, 2, 3]]), name
        if name not in ("means", "scales"):
            assert torch.equal(dict(halves.items())[name][3:], value[[4, 1, 4, 1]]), name
    matrices = rotation_matrices(scene.quats)
    for whole, axis in ((4, 2), (1, 1)):
        first, second = (3 + (whole == 1), 5 + (whole == 1))
        apart = (halves.means[first] - halves.means[second]) / 2
        size = scene.scales[whole, axis].exp()
        assert torch.allclose(apart, 0.5 * size * matrices[whole, :, axis], atol=1e-6)
        assert torch.allclose((halves.means[first] + halves.means[second]) / 2, scene.means[whole], atol=1e-6)
        change = halves.scales[first] - scene.scales[whole]
        assert float(change[axis]) == pytest.approx(math.log(math.sqrt(1 - 0.5**2)), abs=1e-6)
        assert torch.equal(halves.scales[first], halves.scales[second])
        assert halves.scales[first].isfinite().tolist() == scene.scales[whole].isfinite().tolist()


def test_what_pulls_becomes_two_and_the_number_stays(hollow_ball):
    scene = hollow_ball[:200]
    left = scene.means[:, 0] < scene.means[:, 0].median()
    moved = reallocated(scene, left.float(), 0.2, FewViews(hollow_ball).for_merging())
    assert len(moved) == 200 and bool(moved.usable().all())
    assert int((moved.means[:, 0] < scene.means[:, 0].median()).sum()) > int(left.sum())
    nothing = reallocated(scene, left.float(), 0.0, FewViews(hollow_ball).for_merging())
    assert all(torch.equal(a, b) for a, b in zip(nothing.tensors(), scene.tensors(), strict=True))


def test_scenes_of_too_few_finite_gaussians_stay(hollow_ball):
    scene = hollow_ball[:50]
    broken = scene.replace(means=scene.means.masked_fill(torch.arange(50)[:, None] < 20, math.nan))
    views = FewViews(hollow_ball).for_merging()
    assert reallocated(broken, torch.arange(50.0), 0.2, views) is broken
    mended = reallocated(broken, torch.arange(50.0), 0.6, views)
    assert len(mended) == 50 and bool(mended.usable().all())
