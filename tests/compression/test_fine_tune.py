"""Fine-tuning: its optimiser, its quality, and the same on any number of threads."""

import json
import math
import os
import subprocess
import sys

import pytest
import torch

from making import ball, box_room
from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.compression.optimiser import gradients_of
from pointsplat_ns.compression.quality import FullSizeQuality, quality_of
from pointsplat_ns.errors import DataError
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.pruning import METHODS, score_of, select
from pointsplat_ns.rasterizer import render
from pointsplat_ns.rasterizer.compiled import blending


def test_fine_tuning_comes_closer_to_the_dense_scene_and_leaves_its_input_alone(hollow_ball, ball_views):
    kept = hollow_ball[select(score_of(hollow_ball, METHODS["coverage"]), 500)]
    before = [value.clone() for value in kept.tensors()]
    shares = []
    tuned = fine_tune(kept, ball_views, hollow_ball, 20, progress=shares.append)
    reference = DenseReference(hollow_ball, ball_views)
    assert reference.psnr(tuned)[0] > reference.psnr(kept)[0] + 1
    assert len(tuned) == 500 and not any(value.requires_grad for value in tuned.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, kept.tensors(), strict=True))
    assert shares == pytest.approx([(i + 1) / 20 for i in range(20)])


def test_fine_tuning_takes_pictures_too_and_no_steps_change_nothing(hollow_ball, ball_views):
    pictures = DenseReference(hollow_ball, ball_views).renders
    a, b = (
        fine_tune(hollow_ball[:300], ball_views, pictures, 3),
        fine_tune(hollow_ball[:300], ball_views, hollow_ball, 3),
    )
    assert all(torch.equal(x, y) for x, y in zip(a.tensors(), b.tensors(), strict=True))
    same = fine_tune(hollow_ball[:300], ball_views, hollow_ball, 0)
    assert all(torch.equal(x, y) for x, y in zip(same.tensors(), hollow_ball[:300].tensors(), strict=True))


def test_fine_tuning_leaves_infinite_parameters_where_they_are(hollow_ball, ball_views):
    spoiled = hollow_ball[:300].map(torch.clone)
    spoiled.opacities[3], spoiled.opacities[4], spoiled.scales[5, 1] = math.inf, -math.inf, -math.inf
    tuned = fine_tune(spoiled, ball_views, hollow_ball, 4)
    assert tuned.opacities[3] == math.inf and tuned.opacities[4] == -math.inf and tuned.scales[5, 1] == -math.inf
    assert bool(tuned.usable().all()) and not torch.equal(tuned.features_dc, spoiled.features_dc)


def test_fine_tuning_says_what_does_not_fit(hollow_ball, ball_views):
    with pytest.raises(DataError, match="no view"):
        fine_tune(hollow_ball, ball_views[:0], hollow_ball, 1)
    with pytest.raises(DataError, match="1 pictures for 4 views"):
        fine_tune(hollow_ball, ball_views, [torch.zeros(48, 64, 3)], 1)
    with pytest.raises(DataError, match="picture . has shape"):
        fine_tune(hollow_ball, ball_views, [torch.zeros(8, 8, 3)] * 4, 1)


@pytest.mark.parametrize(("width", "height"), [(16, 12), (16, SSIM_WINDOW), (16, SSIM_WINDOW - 1)])
def test_the_loss_is_that_of_3dgs_and_without_ssim_where_no_window_fits(width, height):
    scene = ball(40)
    view = sample_views(scene, 1, width, height)[0]
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    leaves = scene.map(lambda value: value.clone().requires_grad_())
    image = render(leaves, view)
    loss = (image - target).abs().mean()
    if height >= SSIM_WINDOW:
        similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
        loss = 0.8 * loss + 0.2 * (1 - similarity)
    loss.backward()
    found = gradients_of(scene, view, target)
    assert float(found["features_dc"].abs().max()) > 0
    for name, value in leaves.items():
        torch.testing.assert_close(found[name], value.grad, msg=name)
    assert not any(value.requires_grad for value in scene.tensors())


@pytest.fixture(scope="module")
def dense():
    return box_room(0, 400)


def test_the_figure_is_that_of_whole_pictures_over_covered_pixels(dense):
    small = dense[::3]
    views = sample_views(dense, 3, 64, 48)
    assert quality_of(dense, small, views).psnr == DenseReference(dense, views).psnr(small)[0]
    large = sample_views(dense, 3, 1280, 960)
    subsampled = quality_of(dense, small, large)
    assert subsampled.psnr == pytest.approx(DenseReference(dense, large).psnr(small)[0], abs=0.1)
    assert (subsampled.views, subsampled.width, subsampled.height) == (3, 1280, 960)


def test_the_quality_is_said_with_the_views_and_their_size(dense):
    close, drawn = str(FullSizeQuality(31.249, 8, 1920, 1080, 33.84, 12.06)).splitlines()
    assert close == "31.2 dB PSNR against the dense scene (8 views, 1920 x 1080)"
    assert drawn == "fill: 33.8 -> 12.1 Gaussians drawn per pixel"
    same = quality_of(dense, dense, sample_views(dense, 1, 64, 48))
    assert str(same).startswith("no difference from the dense scene (1 view, 64 x 48)\n")


def test_fill_is_that_of_both_scenes_in_the_compared_views(dense):
    views = sample_views(dense, 2, 64, 48)
    found = quality_of(dense, dense[::3], views[1:])
    assert (found.fill_before, found.fill) == (fill(dense, views[1:]), fill(dense[::3], views[1:]))
    assert 0 < found.fill < found.fill_before


def test_views_that_the_finish_of_merging_compared_are_left_out(dense):
    views, small = sample_views(dense, 6, 64, 48), dense[::3]
    assert len(views) == 6
    assert quality_of(dense, small, views).psnr == quality_of(dense, small, views[torch.tensor([1, 4])]).psnr


COMPUTE = """
import dataclasses, json
import torch
import pointsplat_ns as ps
from pointsplat_ns.compression.optimiser import gradients_of
from pointsplat_ns.compression.repair import RepairBudget, repair
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning.merging import MERGING, merge
from pointsplat_ns.system.threads import fixed_threads

quick = dataclasses.replace(MERGING, finish_views=1)

room = ps.example_room()
both = torch.cat([torch.arange(len(room)), torch.arange(5001)])  # more than torch shares between threads, and odd
generator = torch.Generator().manual_seed(0)
scene = room[both].map(lambda value: value + 1e-3 * torch.randn(value.shape, generator=generator))
small = scene[::8]
views = ps.sample_views(scene, 2, width=160, height=120)
target = torch.rand(120, 160, 3, generator=generator)
refiner = ps.load_refiner()

def results():
    yield "image", {"image": ps.render(scene, views[0])}
    yield "gradients", gradients_of(scene, views[0], target)
    yield "merged", dict(merge(scene, 20_000, settings=quick).scene.items())
    yield "refined", dict(refiner(small).items())
    source = ViewSource(scene, given=ps.sample_views(scene, 30, width=160, height=120))
    yield "repaired", dict(repair(small, scene, source, Steps()).scene.items())

class Steps(RepairBudget):
    empty = False
    share_done = lambda self, steps, seconds: steps / 3
    steps_in_all = lambda self, steps, done: 3

with fixed_threads(1):
    one = dict(results())
apart = {}
for threads in (2, 3):
    with fixed_threads(threads):
        for what, values in results():
            for name, value in values.items():
                same, first = torch.equal(value, one[what][name]), one[what][name].double()
                off = float((value.double() - first).norm() / first.norm().clamp_min(1e-30))
                apart.setdefault(f"{what} {threads}", {})[name] = 0.0 if same else max(off, 1e-30)
print(json.dumps(apart))
"""


@pytest.fixture(scope="module")
def apart() -> dict[str, dict[str, float]]:
    """How far results on two and three threads are from those on one, by name: the norm of the difference, relative; 0
    where all bits agree."""
    environment = {**os.environ, "GOMP_SPINCOUNT": "1000", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", COMPUTE], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("what", ["image", "gradients", "merged", "refined", "repaired"])
def test_one_thread_and_two_give_the_same_bits(apart, what):
    in_order = not blending.KERNELS.why_missing or what not in ("gradients", "repaired")
    # torch adds up gradients in another order on another number of threads; kernels do not
    assert max(apart[f"{what} 2"].values()) <= (0.0 if in_order else 1e-5)


def test_merging_gives_the_same_bits_on_any_number_of_threads(apart):
    assert set(apart["merged 3"].values()) == {0.0}


@pytest.mark.parametrize("what", ["image", "gradients", "refined", "repaired"])
def test_three_threads_are_within_the_tolerance(apart, what):
    # float32: some exponentials are rounded in another way where the shares of threads end, 6e-8 each
    assert max(apart[f"{what} 3"].values()) < 1e-5
