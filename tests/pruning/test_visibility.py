"""What stands in front hides the rest, and is kept rather."""

from __future__ import annotations

import math

import pytest
import torch

from making import ball, normal_scene
from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.pruning import merge as merging
from pointsplat_ns.pruning.merge import merge
from pointsplat_ns.pruning.regrouping import masses_of, moments
from pointsplat_ns.pruning.visibility import LEAST, LEAST_EACH, POWER, Shown
from pointsplat_ns.views import Views


def views_from(*eyes: tuple[float, float, float], width: int = 64, height: int = 48) -> Views:
    """Views of the origin."""
    at = torch.tensor(eyes).double()
    K = torch.tensor([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]).double()
    return Views(look_at(at, torch.zeros_like(at)), K.repeat(len(eyes), 1, 1), width, height, torch.zeros(3))


def two_walls(rows: int = 32) -> Gaussians:
    """Two walls of flat, opaque Gaussians, one behind the other, alike to the last digit in all else."""
    line = torch.linspace(-1, 1, rows)
    across = torch.cartesian_prod(line, line)
    means = torch.cat([torch.cat([across, torch.full((len(across), 1), z)], dim=1) for z in (-0.5, 0.5)])
    scene = ball(len(means), 0)
    scales = torch.tensor([2 / rows, 2 / rows, 0.01]).log().expand(len(means), 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
    return scene.replace(means=means, scales=scales, quats=quats, opacities=torch.full((len(means), 1), 4.0))


def test_what_is_hidden_has_a_small_share():
    scene = two_walls()
    shown = Shown.of(scene, torch.arange(len(scene)), torch.ones(len(scene)), views_from((0, 0, -4)))
    for shares, least in ((shown.around(), LEAST), (shown.each(), LEAST_EACH)):
        front, back = shares.chunk(2)
        assert shares.dtype == torch.float32
        assert float(front.median()) > 0.9 and float(back.median()) < max(0.15, least**POWER * 1.001)


def test_merging_keeps_what_views_show_rather_than_what_is_hidden():
    scene = two_walls()
    kept = merge(scene, 600, views=views_from((0, 0, -4), (1, 0, -4), (0, 1, -4))).scene
    front = int((kept.means[:, 2] < 0).sum())
    assert len(kept) == 600 and front > 1.5 * (600 - front)


def test_of_a_large_scene_some_tell_what_is_hidden(monkeypatch):
    monkeypatch.setattr(merging, "MOST_DRAWN", 700)
    scene = two_walls()
    merge_of = merging.Merging(scene, torch.arange(len(scene)), views_from((0, 0, -4)))
    front = scene.means[merge_of.members, 2] < 0
    assert float(merge_of.seen[front].mean()) > 1.5 * float(merge_of.seen[~front].mean())


def test_a_group_looks_like_those_of_its_members_that_are_seen():
    scene = two_walls()
    front, back = scene.features_dc.chunk(2)
    scene = scene.replace(features_dc=torch.cat([torch.ones_like(front), -torch.ones_like(back)]))
    members, place = torch.arange(len(scene)), torch.arange(len(scene)) % len(front)  # each with the one behind it
    masses = masses_of(scene, members)
    shown = Shown.of(scene, members, torch.ones(len(scene)), views_from((0, 0, -4)))
    for weights, redness in ((torch.ones(len(scene)), 0.0), (shown.each(), (1 - 0.4) / (1 + 0.4))):
        colours = moments(scene, members, masses * weights, place, len(front)).colours
        assert float(colours.median()) / SH_C0 == pytest.approx(redness, abs=0.06)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_shares_are_bounded_whatever_the_scene(dtype):
    scene = Gaussians(*(value.to(dtype) for value in normal_scene(400, degree=0).tensors()))
    wild = scene.scales.clone()
    wild[:100], wild[100:200, 0], wild[200:300] = -math.inf, math.inf, torch.finfo(dtype).max
    for some, views in (
        (scene, views_from((0, -6, 1))),
        (scene.replace(scales=wild), views_from((0, -6, 1))),
        (scene.replace(opacities=torch.full_like(scene.opacities, -math.inf)), views_from((0, -6, 1))),
        (scene, views_from((0, -6, 1))[[]]),
    ):
        for weights in (torch.ones(400), torch.zeros(400), torch.full((400,), 3e38)):
            shown = Shown.of(some, torch.arange(400), weights, views)
            for shares, least in ((shown.around(), LEAST), (shown.each(), LEAST_EACH)):
                assert shares.shape == (400,)
                assert bool(((shares >= least**POWER * 0.999) & (shares <= 1)).all())


def test_what_no_view_shows_is_told_by_nothing():
    scene = normal_scene(50, degree=0)
    shown = Shown.of(scene, torch.arange(50), torch.ones(50), views_from((0, -6, 1))[[]])
    assert shown.around().tolist() == shown.each().tolist() == [1.0] * 50
