"""Repair by optimisation: what it gains, what it sees, how long it takes, and how it ends."""

import itertools
import math

import pytest
import torch

import pointsplat_ns.compression.repair as repair_module
from making import FewViews, same
from pointsplat_ns.api import example_room
from pointsplat_ns.compression.feedback import Feedback
from pointsplat_ns.compression.optimiser import Adam, AdamSettings, gradients_of, nonzero_rms, optimised
from pointsplat_ns.compression.repair import STEPS, RepairBudget, repair
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.pruning import prune
from pointsplat_ns.rasterizer import render


@pytest.fixture(autouse=True)
def quick_takes_steps(monkeypatch):
    """Other tests go without; fewer than ship, as these are many."""
    monkeypatch.setitem(STEPS, "quick", 32)


@pytest.fixture(scope="module")
def pruned(hollow_ball):
    return prune(hollow_ball, 300, "merge")


def test_repair_comes_closer_in_views_that_it_has_not_seen(hollow_ball, pruned, ball_views):
    before = [value.clone() for value in pruned.tensors()]
    shares = []
    repaired = repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick"), shares.append, network=None)
    reference = DenseReference(hollow_ball, ball_views)
    assert reference.psnr(repaired.scene)[0] > reference.psnr(pruned)[0] + 1
    assert len(repaired.scene) == 300 and bool(repaired.scene.usable().all())
    assert not any(value.requires_grad for value in repaired.scene.tensors())
    assert all(torch.equal(a, b) for a, b in zip(before, pruned.tensors(), strict=True)), "the input was changed"
    assert repaired.steps == STEPS["quick"] and not repaired.interrupted and repaired.seconds > 0
    assert shares == pytest.approx([(i + 1) / STEPS["quick"] for i in range(STEPS["quick"])])


def test_learned_steps_come_closer_than_those_of_adam(monkeypatch):
    """In a room that the network was not trained on, and in views that no step has seen."""
    monkeypatch.setitem(STEPS, "quick", 6)
    room = example_room()
    pruned = prune(room, 0.1, "merge")
    reference = DenseReference(room, sample_views(room, 6, 160, 120, seed=99))
    source = ViewSource(room, given=sample_views(room, 32, 160, 120, seed=98))
    learned, plain = (
        repair(pruned, room, source, RepairBudget("quick"), network=network).scene for network in ("shipped", None)
    )
    assert reference.psnr(learned)[0] > reference.psnr(plain)[0] + 0.05 > reference.psnr(pruned)[0] + 0.1


def test_how_many_steps_there_will_be_is_known_or_estimated():
    assert RepairBudget("quick").steps_in_all(0, 0.0) == STEPS["quick"]
    timed = RepairBudget(seconds=10.0)
    assert timed.steps_in_all(0, 0.0) is None and timed.steps_in_all(3, 0.25) == 12


def test_an_effort_gives_the_same_result_each_time(hollow_ball, pruned, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 5)
    first, second = (repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick")) for _ in range(2))
    assert same(first.scene, second.scene) and not same(first.scene, pruned)


def test_no_effort_takes_no_step_and_a_time_takes_that_long(hollow_ball, pruned, monkeypatch):
    for budget in (RepairBudget("instant"), RepairBudget("thorough", 0.0)):
        assert budget.empty
        repaired = repair(pruned, hollow_ball, FewViews(hollow_ball), budget)
        assert repaired.steps == 0 and same(repaired.scene, pruned)
    clock = itertools.count()  # a second each time that anybody looks
    monkeypatch.setattr(repair_module.time, "perf_counter", lambda: float(next(clock)))
    assert repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("thorough", 7.0)).steps == 7


def test_learning_rates_fall_to_nearly_nothing(hollow_ball, pruned, monkeypatch):
    shares = []

    def moves(self, share, *learned):
        shares.append(share)
        return {name: torch.zeros_like(value) for name, value in pruned.items()}

    monkeypatch.setattr(Feedback, "moves", moves)
    repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick"))
    assert shares[0] == 1 and shares == sorted(shares, reverse=True) and 0.02 <= shares[-1] < 0.03


def test_what_is_nearly_right_takes_steps_in_proportion_to_its_error(hollow_ball, pruned, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 1)
    shifts = []
    for psnr in (0.0, 35.0, 55.0, math.inf):
        after = repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick"), psnr=psnr).scene
        shifts.append(float((after.features_dc - pruned.features_dc).abs().max()))
    assert shifts[0] == shifts[1] > 0 == shifts[3]
    assert shifts[2] == pytest.approx(0.1 * shifts[0], rel=1e-3)


@pytest.mark.parametrize("far", [1e6, 1e30, 3e38])
def test_one_distant_gaussian_does_not_change_the_steps_of_the_others(hollow_ball, pruned, monkeypatch, far):
    monkeypatch.setitem(STEPS, "quick", 3)
    lone = pruned[:1].replace(means=torch.tensor([[far, 0.0, -far]]))
    joined = Gaussians(*(torch.cat(pair) for pair in zip(pruned.tensors(), lone.tensors(), strict=True)))
    alone, beside = (
        repair(s, hollow_ball, FewViews(hollow_ball), RepairBudget("quick")).scene for s in (pruned, joined)
    )
    assert bool(beside.usable().all())
    for name, value in alone.items():
        moved = (value - getattr(pruned, name)).norm()
        # 5 %: medians and the share that is kept change a little with one more Gaussian
        assert float((getattr(beside, name)[:-1] - value).norm()) < 0.05 * float(moved) + 1e-9, name


def test_an_interruption_loses_nothing(hollow_ball, pruned):
    def stop(share: float) -> None:
        if share > 0.2:
            raise KeyboardInterrupt

    repaired = repair(pruned, hollow_ball, FewViews(hollow_ball), RepairBudget("quick"), stop)
    assert repaired.interrupted and repaired.steps == 7  # 7/32 is the first share above 0.2
    assert bool(repaired.scene.usable().all()) and not same(repaired.scene, pruned)


@pytest.mark.parametrize(
    ("effort", "seconds", "message"),
    [("slow", None, "effort is 'slow'; expected one of instant, quick, thorough"), *(
        ("quick", seconds, "the time to repair is") for seconds in (-1.0, math.nan, math.inf)
    )],
)  # fmt: skip
def test_a_budget_that_means_nothing_is_refused(effort, seconds, message):
    with pytest.raises(PointSplatError, match=message):
        RepairBudget(effort, seconds)


def test_views_to_optimise_on_are_none_of_those_compared(hollow_ball):
    many = sample_views(hollow_ball, 40, 48, 36)
    source = ViewSource(hollow_ball, given=many)
    compared = {tuple(m.flatten().tolist()) for m in source.compared().viewmats}
    first, second = (
        [tuple(view.viewmat.flatten().tolist()) for view in itertools.islice(source.others(seed), 56)]
        for seed in (0, 1)
    )
    assert len(compared) == VIEW_COUNTS.compared and not compared & set(first)
    assert len(set(first[:28])) == 28 and set(first[:28]) == set(first[28:]), "each once before any is repeated"
    assert first != second


def test_where_few_views_are_given_others_are_sampled_with_what_lies_behind(hollow_ball):
    few = sample_views(hollow_ball, 3, 48, 36)
    white = type(few)(few.viewmats, few.Ks, few.width, few.height, torch.ones(3))
    taken = list(itertools.islice(ViewSource(hollow_ball, given=white).others(), 40))
    places = {tuple(view.viewmat.flatten().tolist()) for view in taken}
    assert len(places) == 40 and not places & {tuple(m.flatten().tolist()) for m in few.viewmats}
    assert all(view.background.tolist() == [1, 1, 1] for view in taken)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_that_are_not_finite_and_values_that_are_not_stay_out(pruned, ball_views, dtype, monkeypatch):
    scene = pruned.map(torch.clone).to(dtype)
    scene.opacities[0], scene.scales[1, 2] = math.inf, -math.inf

    def spoiled(scene, view, **options):
        weight = torch.ones_like(scene.means)
        weight[2] = math.nan
        return render(scene, view) + 0.0 * (weight * scene.means).sum().nan_to_num()

    monkeypatch.setattr("pointsplat_ns.compression.optimiser.render", spoiled)
    example = ball_views[0], torch.zeros(48, 64, 3, dtype=dtype)
    after = next(optimised(scene, Adam(scene, AdamSettings()), itertools.repeat(example)))
    assert after.opacities[0] == math.inf and after.scales[1, 2] == -math.inf
    assert bool(after.usable().all()) and after.dtype == dtype
    assert torch.equal(after.means[2], scene.means[2]), "a NaN gradient moves nothing"
    assert not torch.equal(after.features_dc, scene.features_dc)


def test_rates_of_the_means_follow_the_size_of_the_scene(pruned, ball_views):
    """A scene a thousand times as large moves a thousand times as far."""
    target = torch.zeros(48, 64, 3, dtype=torch.float64)
    exact = pruned.map(torch.Tensor.double)  # one step is some thirty spacings of float32 positions
    moved = []
    for size in (1e-3, 1.0, 1e3):
        scene = exact.replace(means=exact.means * size, scales=exact.scales + math.log(size))
        views = sample_views(scene, 2, 64, 48)
        after = next(optimised(scene, Adam(scene, AdamSettings()), itertools.repeat((views[0], target))))
        moved.append(float((after.means - scene.means).abs().max()) / size)
    assert moved[0] == pytest.approx(moved[1], rel=1e-2) and moved[2] == pytest.approx(moved[1], rel=1e-2)


def test_what_is_right_already_hardly_moves_where_steps_are_damped(pruned, ball_views):
    """Adam alone moves it as far as everything else."""
    view = ball_views[0]
    target = render(pruned, view).detach()
    target[:, : view.width // 2] = (target[:, : view.width // 2] + 0.3).clamp(max=1)
    noise = torch.randn(target[:, view.width // 2 :].shape, generator=torch.Generator().manual_seed(0))
    target[:, view.width // 2 :] += 1e-4 * noise
    moved = []
    for damping in (0.0, 0.5):
        adam, scene = Adam(pruned, AdamSettings(damping=damping)), pruned
        for _ in range(3):
            adam.observe(gradients_of(scene, view, target))
            scene = adam.moved(scene)
        shift = (scene.features_dc - pruned.features_dc).abs().amax(1)
        points = (pruned.means.double() @ view.viewmat[:3, :3].T.double() + view.viewmat[:3, 3].double()).float()
        column = points[:, 0] / points[:, 2] * view.K[0, 0] + view.K[0, 2]
        ahead = (points[:, 2] > 0.1) & (shift > 0)
        wrong, right = ahead & (column < 0.3 * view.width), ahead & (column > 0.75 * view.width)
        assert bool(wrong.any()) and bool(right.any())
        moved.append(float(shift[right].median() / shift[wrong].median()))
    assert moved[0] > 2 * moved[1] > 0


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-20, 1.0, 1e18])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_size_of_gradients_is_right_at_the_extremes(size, dtype):
    gradient = torch.zeros(6, 2, dtype=dtype)
    gradient[:3] = torch.tensor([1.0, -2.0, 2.0], dtype=dtype)[:, None] * size
    assert nonzero_rms(gradient) == pytest.approx(size * 3**0.5, rel=1e-6)
    assert nonzero_rms(gradient[:0]) == 0
