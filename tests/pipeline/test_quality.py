"""The one judgement of a written scene, and its text."""

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import pointsplat_ns as ps
from making import box_room, cloud, views_from_within
from pointsplat_ns.pipeline.quality import (
    Judge,
    judge_of,
    quality_of_file,
    through_file,
)
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.reading import save
from pointsplat_ns.scene.views import Views
from pointsplat_ns.tools.wording import quality_details, quality_text
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def dense():
    return box_room(0, 400)


def test_the_figures_are_those_of_whole_pictures_over_covered_pixels(dense):
    small = dense[::3]
    views = sample_views(dense, 3, 64, 48)
    found = Judge(dense, ViewProvider(dense, views)).quality(small)
    whole = DenseReference(dense, views)
    assert (found.psnr, found.worst) == whole.psnr(small)
    assert found.ssim == pytest.approx(whole.ssim(small), abs=1e-6)
    assert (found.fill_before, found.fill) == (fill(dense, views), fill(small, views))


def test_few_pixels_of_large_pictures_stand_for_all(dense):
    small = dense[torch.arange(len(dense)) % 5 > 0]
    views = views_from_within((0.2, 0.1, 0.0), 4, 960, 720)
    found = Judge(dense, ViewProvider(dense, views)).quality(small)
    whole = DenseReference(dense, views)
    assert found.psnr == pytest.approx(whole.psnr(small)[0], abs=0.1)
    assert found.ssim == pytest.approx(whole.ssim(small), abs=0.05)
    assert (found.views, found.width, found.height) == (4, 960, 720)


def test_a_file_that_loses_is_judged_as_it_is_read(dense, tmp_path):
    source = ViewProvider(dense, views_from_within((0.2, 0.1, 0.0), 2, 64, 48))
    save(dense, tmp_path / "same.splat")
    read = through_file(dense, format_to_write(".splat"))[1]
    wanted = Judge(dense, source).quality(read)
    assert 10 < wanted.psnr < 60 and "looks the same" not in quality_text(wanted)
    assert quality_of_file(Judge(dense, source), dense, tmp_path / "same.splat") == wanted
    exact = quality_of_file(Judge(dense, source), dense, tmp_path / "same.ply")
    assert quality_text(exact) == "more than 60 dB, SSIM 1.00: looks the same"
    assert "inf" not in quality_details(exact)


def test_where_nothing_is_visible_nothing_is_judged(dense):
    unseen = dense.replace(opacities=dense.opacities - 100)
    assert (
        quality_of_file(judge_of(unseen, ViewProvider(unseen)), unseen, Path("unseen.ply")) is None
    )


def test_a_scene_that_is_translucent_from_everywhere_is_said_to_be(dense):
    views = sample_views(dense, 3, 64, 48)
    reset = dense.replace(opacities=torch.full_like(dense.opacities, -5.0))
    found = Judge(reset, ViewProvider(reset, views)).quality(reset[::3])
    assert 0 < found.opacity < 0.5 and "translucent in all views (mean opacity " in quality_text(
        found
    )
    opaque = Judge(dense, ViewProvider(dense, views)).quality(dense[::3])
    assert opaque.opacity > 0.5 and "translucent" not in quality_text(opaque)


@settings(max_examples=40, deadline=None)
@given(
    opacity=st.floats(-8, 10),
    other=st.floats(-8, 10),
    distance=st.floats(0.5, 300),
    shift=st.floats(-3, 3),
    seed=st.integers(0, 9),
)
def test_ssim_and_psnr_stay_in_their_range_at_any_coverage(opacity, other, distance, shift, seed):
    """From a scene that fills the picture to one that is a faint dot, against one that is moved,
    and as opaque or as faint."""
    scene = cloud(30, seed=seed)
    dense = scene.replace(opacities=torch.full_like(scene.opacities, opacity))
    beside = scene.replace(
        means=scene.means + shift, opacities=torch.full_like(scene.opacities, other)
    )
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-0.5, -0.5, distance])
    K = torch.tensor([[40.0, 0.0, 12.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]])
    views = Views(viewmat[None], K[None], 24, 24, torch.zeros(3))
    for judged in (beside, dense):
        found = Judge(dense, ViewProvider(dense, views)).quality(judged)
        assert -1 <= found.ssim <= 1 and 0 <= found.opacity <= 1
        assert math.isfinite(found.psnr) or found.psnr == math.inf
        assert found.psnr > -40  # 576 pixels: one covered pixel, and an error of all others
    assert found.psnr == math.inf and found.ssim == 1


def test_a_translucent_scene_is_judged_as_its_pictures_differ():
    """Behind an opacity reset, errors are not divided by the little that is opaque."""
    scene = cloud(400)
    dense = scene.replace(opacities=torch.full_like(scene.opacities, -4.5))
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-0.5, -0.5, 1.2])
    K = torch.tensor([[96.0, 0.0, 32.0], [0.0, 96.0, 32.0], [0.0, 0.0, 1.0]])
    views = Views(viewmat[None], K[None], 64, 64, torch.zeros(3))
    reference = DenseReference(dense, views)
    image = render(dense[:40], views[0])
    plain = float(ps.ssim(image, reference.renders[0]))
    assert reference.drawn[0] > 0.9 and reference.opacity < 0.5
    assert reference.ssim(dense[:40]) == pytest.approx(
        1 - (1 - plain) / reference.drawn[0], abs=1e-4
    )
    error = float((image - reference.renders[0]).square().mean())
    assert reference.psnr(dense[:40])[0] == pytest.approx(
        -10 * math.log10(error / (0.5 * reference.drawn[0])), abs=1e-3
    )
