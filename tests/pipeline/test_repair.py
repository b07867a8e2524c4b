"""Repair by optimisation: what it gains, what it sees, how long it takes, and how it ends."""

import functools
import itertools
import math
import sys

import pytest
import torch

import pointsplat_ns.pipeline.repair as repair_module
import pointsplat_ns.pipeline.repair_budget as repair_budget
from making import FewViews, ball, same
from pointsplat_ns.api import example_room
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.pipeline.optimiser import (
    Adam,
    AdamSettings,
    gradients_of,
    nonzero_rms,
    optimised,
)
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.pipeline.repair import repair
from pointsplat_ns.pipeline.repair_budget import STEPS, RepairBudget
from pointsplat_ns.pipeline.repair_state import RepairStateFile
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.pruning import prune
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.system.threads import fixed_threads
from pointsplat_ns.view_sampling.sampler import sample_views
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(autouse=True)
def quick_takes_steps(monkeypatch):
    """Other tests go without; fewer than ship, as these are many."""
    monkeypatch.setitem(STEPS, "quick", 32)


def place(viewmat):
    return tuple(viewmat.flatten().tolist())


@pytest.fixture(scope="module")
def pruned(hollow_ball):
    return prune(hollow_ball, 300, "merge")


def test_repair_comes_closer_in_views_that_it_has_not_seen(hollow_ball, pruned, ball_views):
    before = [value.clone() for value in pruned.tensors()]
    shares = []
    repaired = repair(
        pruned,
        hollow_ball,
        FewViews(hollow_ball),
        RepairBudget("quick"),
        shares.append,
        network=None,
    )
    reference = DenseReference(hollow_ball, ball_views)
    assert reference.psnr(repaired.scene)[0] > reference.psnr(pruned)[0] + 1
    assert len(repaired.scene) == 300 and bool(repaired.scene.usable().all())
    assert not any(value.requires_grad for value in repaired.scene.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, pruned.tensors(), strict=True)), (
        "the input was changed"
    )
    assert repaired.steps == STEPS["quick"] and not repaired.interrupted and repaired.seconds > 0
    assert shares == pytest.approx([(i + 1) / STEPS["quick"] for i in range(STEPS["quick"])])


def test_repairs_of_many_gaussians_take_more_steps_views_and_pixels_at_lower_rates(
    hollow_ball, pruned, monkeypatch
):
    monkeypatch.setitem(STEPS, "quick", 4)
    monkeypatch.setattr(repair_budget, "FEW_GAUSSIANS", 75)
    asked = []

    class Counted(FewViews):
        def others(self, seed=0, count=0, drawn_side=0):
            asked.append((count, drawn_side))
            return self.sampled(seed)

    repaired = repair(
        pruned, hollow_ball, Counted(hollow_ball), RepairBudget("quick"), network=None
    )
    assert repaired.steps == 8 and asked == [(2 * VIEW_COUNTS.stepped, 453)]
    monkeypatch.setattr(repair_budget, "FEW_GAUSSIANS", 1e-9)
    still = repair(
        pruned, hollow_ball, Counted(hollow_ball), RepairBudget("quick"), network=None
    ).scene
    assert torch.allclose(still.means, pruned.means, atol=1e-6), (
        "of very many, each moves very little"
    )


def test_learned_steps_come_closer_than_those_of_adam(monkeypatch):
    """In a room that the network was not trained on, and in views that no step has seen."""
    monkeypatch.setitem(STEPS, "quick", 6)
    room = example_room()[::2]
    with use_settings(DEFAULT_SETTINGS):
        pruned = prune(room, 0.1, "merge")
        reference = DenseReference(room, sample_views(room, 4, 160, 120, seed=99))
        source = ViewProvider(room, given=sample_views(room, 20, 160, 120, seed=98))
    learned, plain = (
        repair(pruned, room, source, RepairBudget("quick"), network=network).scene
        for network in ("shipped", None)
    )
    assert (
        reference.psnr(learned)[0]
        > reference.psnr(plain)[0] + 0.05
        > reference.psnr(pruned)[0] + 0.1
    )


def test_no_effort_takes_no_step_and_a_time_takes_that_long(hollow_ball, pruned, monkeypatch):
    for budget in (RepairBudget("instant"), RepairBudget("thorough", 0.0)):
        assert budget.empty
        repaired = repair(pruned, hollow_ball, FewViews(hollow_ball), budget)
        assert repaired.steps == 0 and same(repaired.scene, pruned)
    clock = itertools.count()  # a second each time that anybody looks
    monkeypatch.setattr(repair_module.time, "perf_counter", lambda: float(next(clock)))
    assert (
        repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("thorough", 7.0)).steps == 7
    )


def test_an_interruption_loses_nothing(hollow_ball, pruned):
    def stop(share: float) -> None:
        if share > 0.2:
            raise KeyboardInterrupt

    repaired = repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick"), stop)
    assert repaired.interrupted and repaired.steps == 7  # 7/32 is the first share above 0.2
    assert bool(repaired.scene.usable().all()) and not same(repaired.scene, pruned)


def test_a_killed_repair_continues_to_the_same_bits(hollow_ball, pruned, tmp_path, monkeypatch):
    monkeypatch.setattr(RepairStateFile, "SECONDS", 0.0)
    file = tmp_path / "unfinished"

    def repaired(killed_at=99.0, start=pruned):
        done = []
        try:
            report = lambda share: done.append(share) or (share > killed_at and sys.exit())  # noqa: E731
            last = repair(
                start,
                hollow_ball,
                FewViews(hollow_ball),
                RepairBudget("quick"),
                report,
                unfinished=file,
            )
        except SystemExit:
            return None, done
        return last.scene, done

    whole, _ = repaired()
    file.unlink()
    assert repaired(0.32)[0] is None and repaired(0.64)[1][0] == 11 / 32  # killed after 11 and 21
    rest, done = repaired()
    assert same(rest, whole) and done[0] == 21 / 32
    assert len(repaired(start=pruned.replace(means=pruned.means + 0.1))[1]) == 32, (
        "another scene starts anew"
    )
    file.write_bytes(file.read_bytes()[:-9])
    assert len(repaired()[1]) == 32, "so does a damaged file"


@pytest.mark.parametrize(
    "budget", [("slow",), ("quick", -1.0), ("quick", math.nan), ("quick", math.inf)]
)
def test_a_budget_that_means_nothing_is_refused(budget):
    with pytest.raises(
        PointSplatError, match="is 'slow'; expected one of instant, quick, th|the time to repair is"
    ):
        RepairBudget(*budget)


def test_views_to_optimise_on_are_none_of_those_compared(hollow_ball):
    many = sample_views(hollow_ball, 40, 48, 36)
    source = ViewProvider(hollow_ball, given=many)
    compared = {place(m) for m in source.compared().viewmats}
    first, second = (
        [place(view.viewmat) for view in itertools.islice(source.others(seed), 56)]
        for seed in (0, 1)
    )
    assert len(compared) == VIEW_COUNTS.compared and not compared & set(first)
    assert len(set(first[:28])) == 28 and set(first[:28]) == set(first[28:]), (
        "each once before any is repeated"
    )
    assert first != second


def test_each_lap_has_the_views_in_another_order(hollow_ball):
    source = ViewProvider(hollow_ball, given=sample_views(hollow_ball, 40, 48, 36))
    taken = [place(view.viewmat) for view in itertools.islice(source.others(), 28 * 3)]
    laps = [tuple(taken[start : start + 28]) for start in (0, 28, 56)]
    assert len(set(laps)) == 3


def test_steps_draw_few_pixels_of_each_view_as_of_several_sizes(hollow_ball):
    source = ViewProvider(hollow_ball, given=sample_views(hollow_ball, 40, 640, 480))
    taken = list(itertools.islice(source.others(), 84))
    assert {(view.width, view.height) for view in taken} == {(320, 240)}
    widened: dict[tuple[float, ...], set[float]] = {}
    for view in taken:
        widened.setdefault(place(view.viewmat), set()).add(round(view.eps2d, 4))
    of_all = {round(0.3 * (320 / side) ** 2, 4) for side in (453, 640, 2560)}
    assert len(widened) == 28 and all(found == of_all for found in widened.values())


def test_few_views_beside_the_compared_ones_take_turns_with_sampled_ones(hollow_ball):
    given = sample_views(hollow_ball, 20, 48, 36)
    source = ViewProvider(hollow_ball, given=given)
    compared = {place(m) for m in source.compared().viewmats}
    left = {place(m) for m in given.viewmats} - compared
    taken = [place(view.viewmat) for view in itertools.islice(source.others(), 32)]
    assert len(left) == 8 and set(taken[::2]) == left
    assert len(set(taken[1::2])) == 16 and not set(taken[1::2]) & (left | compared)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_that_are_not_finite_and_values_that_are_not_stay_out(
    pruned, ball_views, dtype, monkeypatch
):
    scene = pruned.map(torch.clone).to(dtype)
    scene.opacities[0] = math.inf
    scene.scales[1, 2] = -math.inf

    def spoiled(scene, view, **options):
        weight = torch.ones_like(scene.means)
        weight[2] = math.nan
        return render(scene, view) + 0.0 * (weight * scene.means).sum().nan_to_num()

    monkeypatch.setattr("pointsplat_ns.pipeline.optimiser.render", spoiled)
    example = ball_views[0], torch.zeros(48, 64, 3, dtype=dtype)
    after = next(optimised(scene, Adam(scene, AdamSettings()), itertools.repeat(lambda: example)))
    assert after.opacities[0] == math.inf and after.scales[1, 2] == -math.inf
    assert bool(after.usable().all()) and after.dtype == dtype
    assert torch.equal(after.means[2], scene.means[2]), "a NaN gradient moves nothing"
    assert not torch.equal(after.features_dc, scene.features_dc)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("together", [1, 2, 3])
def test_steps_take_gradients_of_one_scene_together(pruned, ball_views, together, threads):
    examples = [
        Example(view, torch.full((48, 64, 3), 0.1 * i)) for i, view in enumerate(ball_views[:6])
    ]
    adam = Adam(pruned, AdamSettings())
    scene = pruned
    wanted = []
    for first in range(0, 6, together):
        gradients = [
            gradients_of(scene, *example) for example in examples[first : first + together]
        ]
        for each in gradients:
            scene = adam.stepped(scene, each, lambda scene: (1.0, None))
            wanted.append(scene)
    makers = (functools.partial(Example, *example) for example in examples)
    with fixed_threads(threads):
        found = optimised(pruned, Adam(pruned, AdamSettings()), makers, together=together)
        assert all(same(next(found), each) for each in wanted)


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-20, 1.0, 1e18])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_size_of_gradients_is_right_at_the_extremes(size, dtype):
    gradient = torch.zeros(6, 2, dtype=dtype)
    gradient[:3] = torch.tensor([1.0, -2.0, 2.0], dtype=dtype)[:, None] * size
    assert nonzero_rms(gradient) == pytest.approx(size * 3**0.5, rel=1e-6)
    assert nonzero_rms(gradient[:0]) == 0


@pytest.mark.parametrize("pixel_loss", ["l1", "rmse"])
@pytest.mark.parametrize(("width", "height"), [(16, 12), (16, SSIM_WINDOW), (16, SSIM_WINDOW - 1)])
def test_the_loss_has_no_ssim_where_no_window_fits(width, height, pixel_loss):
    scene = ball(40)
    view = sample_views(scene, 1, width, height)[0]
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
    leaves = scene.map(lambda value: value.clone().requires_grad_())
    image = render(leaves, view)
    error = image - target
    loss = error.abs().mean() if pixel_loss == "l1" else error.square().mean().sqrt()
    if height >= SSIM_WINDOW:
        similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
        loss = 0.8 * loss + 0.2 * (1 - similarity)
    loss.backward()
    found = gradients_of(scene, view, target, pixel_loss=pixel_loss)
    assert float(found["features_dc"].abs().max()) > 0
    for name, value in leaves.items():
        torch.testing.assert_close(found[name], value.grad, msg=name)
    assert not any(value.requires_grad for value in scene.tensors())
