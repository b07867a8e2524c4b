"""How likely views are, and which of them complete each other."""

import math
from dataclasses import replace

import pytest
import torch

from making import ball, splats
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.candidates import EVIDENCE_WEIGHT, MIN_EMPTY, Candidates
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.poses import look_at, views_of
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.looking.traces import PhotoEvidence
from pointsplat_ns.rasterizer import pixels_of

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def wall(count: int = 3000, size: float = 0.06) -> Gaussians:
    """A wall of flat Gaussians at y = 2, without SH, 8 x 8 units."""
    at = 8 * torch.rand(count, 2, generator=torch.Generator().manual_seed(3)) - 4
    means = torch.stack([at[:, 0], torch.full((count,), 2.0), at[:, 1]], dim=1)
    return splats(means, [math.log(size), math.log(1e-3), math.log(size)], 8.0)


def candidates(scene: Gaussians, step: int = 1) -> Candidates:
    generator = torch.Generator().manual_seed(0)
    evidence = PhotoEvidence.of(scene, generator)
    return Candidates.of(scene, step, evidence, None, UP, (640, 360))


def seen_from(*eyes: tuple[float, float, float]):
    at = torch.tensor(eyes, dtype=torch.float64)
    return views_of(look_at(at, at + torch.tensor([0.0, 1.0, 0.0]), UP), 640, 360, UNITS)


def test_the_likelihood_is_that_of_its_formula():
    scene = wall()
    found, views = candidates(scene), seen_from((0, 0, 0), (0, -1, 0))
    likelihoods, shown = found.judged(views)
    small = replace(views.resized(LOOKING.candidate_side), rasterize_mode="antialiased")
    for row, view in enumerate(small):
        pixels = pixels_of(found.few, view).double()
        away = (found.few.means.double() - torch.tensor([0.0, -row, 0.0])).norm(dim=1)
        blur = float((pixels * 0.06 / away).sum() / pixels.sum())
        empty = 1 - float(pixels.sum()) / (view.width * view.height)
        share = (float((pixels > LOOKING.min_candidate_pixels).sum()) + 1) / len(scene)
        expected = math.log(share / (empty + MIN_EMPTY) / blur**2) - 0.5 * (15 / 25) ** 2  # they look level
        assert float(likelihoods[row]) == pytest.approx(expected, abs=1e-4)  # float32
        assert float(shown[row].sum()) + 1 == pytest.approx(share * len(scene))


def test_evidence_of_sh_counts_where_there_are_sh():
    scene = ball(500, 1, opacity=5.0)
    without = scene.replace(features_rest=torch.zeros_like(scene.features_rest))
    views = seen_from((0, -4, 0), (0, -5, 0))
    found = candidates(scene)
    eyes = torch.tensor([[0.0, -4.0, 0.0], [0.0, -5.0, 0.0]], dtype=torch.float64)
    added = found.judged(views)[0] - candidates(without).judged(views)[0]
    torch.testing.assert_close(added, EVIDENCE_WEIGHT * found.evidence.at(eyes).double())


def test_the_next_view_shows_what_earlier_ones_do_not():
    found = candidates(wall(300))
    shown = torch.zeros(4, 300, dtype=torch.bool)
    shown[0, :150] = shown[1, :149] = True
    shown[2, 150:250] = shown[3, 250:] = True
    likelihoods = torch.tensor([0.0, 0.0, 0.0, -9.0], dtype=torch.float64)
    assert found.completing(likelihoods, shown, 4) == [0, 2, 1, 3]
    assert found.completing(likelihoods, shown, 9) == [0, 2, 1, 3] and found.completing(likelihoods, shown, 0) == []


@pytest.mark.parametrize("size", [-1e4, -80.0, 80.0, 1e4])
def test_gaussians_of_any_size_have_views_of_finite_likelihood(size):
    scene = wall(400)
    scales = scene.scales.clone()
    scales[::2] = size
    found = candidates(scene.replace(scales=scales))
    viewmats = found.views(5, torch.Generator().manual_seed(0))
    assert bool(viewmats.isfinite().all())
    assert bool(found.judged(views_of(viewmats, 640, 360, UNITS))[0].isfinite().all())
