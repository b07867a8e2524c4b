"""Coverage: the share of a neighbourhood's mass, neighbourhoods along a curve, and no region emptied."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import METHODS, score_of, select
from pointsplat_ns.pruning.coverage import coverage_score, mass_shares


def scene_at(means, log_scales=-3.0, logits=1.0):
    n = len(means)
    return Gaussians(
        means=means,
        scales=torch.as_tensor(log_scales).expand(n).reshape(n, 1).repeat(1, 3).float(),
        quats=torch.ones(n, 4),
        opacities=torch.as_tensor(logits).expand(n).reshape(n, 1).clone().float(),
        features_dc=torch.zeros(n, 3),
        features_rest=torch.zeros(n, 0, 3),
    )


def shares_by_definition(masses, run, first):
    result = [0.0] * len(masses)
    edges = sorted({0, *range(first, len(masses), run), len(masses)})
    for begin, end in zip(edges, edges[1:], strict=False):
        part = list(range(begin, end))
        ranked = sorted(part, key=lambda i: (-masses[i], i))
        total = sum(masses[i] for i in part)
        for place, i in enumerate(ranked):
            if total == 0:
                result[i] = (len(part) - place) / len(part)
            else:
                result[i] = sum(masses[j] for j in ranked[place:]) / total
    return result


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0, 3.0, 700.0]), max_size=40), st.integers(1, 7), st.data())
def test_mass_shares_are_their_definition(masses, run, data):
    first = data.draw(st.integers(0, run - 1))
    found = mass_shares(torch.tensor(masses, dtype=torch.float64).log(), run, first)
    # 1e-12: sums of at most 7 numbers in float64, their logarithms included
    wanted = torch.tensor(shares_by_definition(masses, run, first), dtype=torch.float64)
    assert torch.allclose(found, wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("shift", [-1e5, -700.0, 700.0, 1e5])
def test_shares_do_not_depend_on_the_unit_of_mass_and_never_overflow(shift):
    masses = torch.linspace(-5, 5, 50, dtype=torch.float64)
    # 1e-9: a logarithm near 1e5 keeps eleven digits after the point
    assert torch.allclose(mass_shares(masses + shift, 12), mass_shares(masses, 12), atol=1e-9)


def test_no_region_is_emptied_at_ten_percent_where_other_scores_empty_one():
    # A wall of large opaque Gaussians, and a far larger number of faint and small ones that make up another.
    generator = torch.Generator().manual_seed(3)
    big = torch.rand(400, 3, generator=generator) * torch.tensor([0.0, 1.0, 1.0])
    small = torch.rand(1600, 3, generator=generator) * torch.tensor([0.0, 1.0, 1.0]) + torch.tensor([1.0, 0.0, 0.0])
    scales = torch.cat([torch.full((400,), -2.0), torch.full((1600,), -5.0)])
    logits = torch.cat([torch.full((400,), 2.0), torch.full((1600,), -1.0)]) + torch.randn(2000, generator=generator)
    scene = scene_at(torch.cat([big, small]), scales, logits)
    cell = (scene.means[:, 0] > 0.5) * 16 + (scene.means[:, 1] * 4).long().clamp_max(3) * 4
    cell = cell + (scene.means[:, 2] * 4).long().clamp_max(3)
    kept = {by: select(score_of(scene, METHODS[by]), 200) for by in ("coverage", "paper", "area", "opacity")}
    regions = {by: len(cell[indices].unique()) for by, indices in kept.items()}
    assert regions["coverage"] == 32 and max(regions["paper"], regions["area"]) < 20


def test_unusable_gaussians_leave_the_others_alone():
    generator = torch.Generator().manual_seed(5)
    scene = scene_at(torch.randn(100, 3, generator=generator), torch.randn(100, generator=generator))
    spoiled = scene.replace(means=scene.means.clone())
    spoiled.means[10:20] = math.nan
    rest = torch.cat([torch.arange(10), torch.arange(20, 100)])
    score = coverage_score(spoiled)
    assert score[10:20].isnan().all() and torch.equal(score[rest], coverage_score(scene[rest]))


def test_scale_and_place_of_the_scene_do_not_matter():
    generator = torch.Generator().manual_seed(6)
    scene = scene_at(torch.randn(500, 3, generator=generator), torch.randn(500, generator=generator)).to(torch.float64)
    moved = scene.replace(means=scene.means * 1024 + 4096, scales=scene.scales + math.log(1024))
    # 1e-5: masses are compared by logarithms in float32; none stands on the border of a cell here
    assert torch.allclose(coverage_score(moved), coverage_score(scene), atol=1e-5)
