"""What is computed where, by a GPU that is pretended: nothing on it from several threads, no linear
algebra of a few numbers, and the same results as on the CPU."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, dense_config, same, small_refiner
from pointsplat_ns.pipeline import trained_refiner
from pointsplat_ns.pipeline.repair_budget import STEPS
from pointsplat_ns.pruning.merging import MERGING, Merger, merge, merge_levels, rounds
from pointsplat_ns.pruning.merging.rounds import one_round
from pointsplat_ns.pruning.methods import METHODS
from pointsplat_ns.refinement import save_refiner
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.each_view import each_view
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.system.threads import fixed_threads
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings
from pretend_gpu import GPU, pretend_gpu

NEAR = 1e-4
"""Difference of colours in [0, 1] in float32 between compiled kernels, which the CPU uses, and
torch."""


@pytest.fixture(scope="module", autouse=True)
def several_threads():
    """More than one thread for pieces of work, whatever the environment says; views are sampled
    from few."""
    with (
        fixed_threads(4),
        use_settings(
            replace(DEFAULT_SETTINGS, candidates_per_view=1, min_candidates=4, evidence_count=100)
        ),
    ):
        yield


@pytest.fixture(scope="module")
def room():
    return box_room(0, count=200, size=0.14)


@pytest.fixture(scope="module")
def views(room, several_threads):
    return ps.sample_views(room, 3, width=32, height=24)


def check(gpu) -> None:
    """Fail if a GPU would have been called from several threads, or its linear algebra loaded."""
    assert gpu.operations and not gpu.from_other_threads() and not gpu.linear_algebra()


def test_the_pretended_gpu_notices_other_threads_and_mixed_devices(room):
    with pretend_gpu() as gpu:
        means = room.means.to(GPU)
        with pytest.raises(RuntimeError, match="expected one device"):
            means @ torch.eye(3)
        torch.linalg.det(means[:9].view(3, 3, 3))
        assert gpu.linear_algebra()
        assert not gpu.from_other_threads()
        with ThreadPoolExecutor(1) as pool:
            pool.submit(means.square).result()
        assert gpu.from_other_threads() == {"aten.pow.Tensor_Scalar"}


def test_views_on_a_gpu_are_drawn_in_the_thread_that_asks(room, views):
    on_cpu = ps.render(room, views)
    with pretend_gpu() as gpu:
        drawn = torch.stack(list(each_view(room.to(GPU), views, ps.render))).cpu()
    check(gpu)
    torch.testing.assert_close(drawn, on_cpu, atol=NEAR, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cameras_on", ["cpu", GPU])
def test_gradients_reach_a_viewmat_on_any_device(room, views, cameras_on, dtype):
    def gradients(device, cameras_on):
        scene = room.to(device=device, dtype=dtype)
        leaves = [
            value.requires_grad_()
            for value in (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh)
        ]
        viewmats = views.viewmats.to(device=cameras_on, dtype=dtype).requires_grad_()
        image, _, _ = ps.rasterization(
            *leaves,
            viewmats,
            views.Ks.to(device=cameras_on, dtype=dtype),
            views.width,
            views.height,
            sh_degree=scene.sh_degree,
            compiled=False,
        )
        found = torch.autograd.grad(image.square().mean(), [*leaves, viewmats])
        assert found[-1].device == viewmats.device and found[-1].dtype == dtype
        return [value.cpu() for value in found]

    wanted = gradients("cpu", "cpu")
    with pretend_gpu() as gpu:
        found = gradients(GPU, cameras_on)
    check(gpu)
    assert all(bool(value.any()) for value in wanted)
    for ours, right in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, right, atol=1e-6 * float(right.abs().max()), rtol=1e-4)


@pytest.mark.parametrize("by", [by for by in METHODS if by != "merge"])
def test_every_method_keeps_the_same_gaussians_on_a_gpu(by, room, views):
    given = views if METHODS[by].needs_views else None
    wanted = ps.prune(room, 0.3, by=by, views=given)
    with pretend_gpu() as gpu:
        kept = ps.prune(room.to(GPU), 0.3, by=by, views=given)
        assert kept.device == GPU
        kept = kept.to("cpu")
    check(gpu)
    assert same(kept, wanted)


def test_merging_on_a_gpu_loses_as_much_as_on_the_cpu_in_the_views_that_are_sampled(views):
    dense = box_room(1, count=2500, size=0.05)
    counts = (900, 250)
    settings = replace(MERGING, sampled_views=3, finish_views=1)
    wanted = [merge(dense, k, settings=settings).scene for k in counts]
    with pretend_gpu() as gpu:
        merger = Merger(dense.to(GPU), settings=settings)
        found = [merger.merged(k).scene.to("cpu") for k in counts]
    check(gpu)
    assert [len(scene) for scene in found] == [*counts]
    reference = DenseReference(dense, views)
    for ours, right in zip(found, wanted, strict=True):
        assert (
            abs(reference.psnr(ours)[0] - reference.psnr(right)[0]) < 0.05
        )  # dB, by rounding of costs


def test_the_cpu_merges_what_is_too_large_for_a_gpu(room, views, monkeypatch, caplog):
    def full(step, *rest):
        if step.participants.scene.device == GPU:
            raise torch.OutOfMemoryError
        return one_round(step, *rest)

    monkeypatch.setattr(rounds, "one_round", full)
    with pretend_gpu():
        merger = Merger(room.to(GPU), views)
        found = [
            *merge_levels(room.to(GPU), [60, 50], views=views),
            merger.merged(60),
            merger.merged(50),
        ]
        assert {merged.scene.device for merged in found} == {
            GPU
        } and "too little memory" in caplog.text
        found = [merged.to("cpu").scene for merged in found]
    wanted = [
        *merge_levels(room, [60, 50], views=views),
        *(merge(room, k, views=views) for k in (60, 50)),
    ]
    assert all(same(ours, right.scene) for ours, right in zip(found, wanted, strict=True))


def test_compact_on_a_gpu_draws_from_one_thread_and_loses_as_much(
    room, views, tmp_path, monkeypatch
):
    """What chooses a GPU where there is one chooses the pretended one."""
    monkeypatch.setitem(STEPS, "quick", 3)
    save_refiner(small_refiner(sh_degree=1), tmp_path / "small.safetensors")
    wanted = ps.compact(room, 0.3, views=views)
    monkeypatch.setattr("pointsplat_ns.pipeline.options.default_device", lambda: GPU)
    monkeypatch.setattr(trained_refiner, "default_device", lambda: GPU)
    with pretend_gpu() as gpu:
        found = ps.compact(room, 0.3, views=views)
        refined = ps.compact(
            room,
            0.5,
            ps.load_refiner(tmp_path / "small.safetensors"),
            effort="instant",
            views=views,
        )
    check(gpu)
    assert len(gpu.operations) > 1000, "renders, and steps of the repair"
    assert len(refined.scene) == 100
    assert len(found.scene) == len(wanted.scene) and {
        stage.scene.device for stage in found.stages
    } == {room.device}
    for ours, right in zip(found.stages, wanted.stages, strict=True):
        assert ours.stage == right.stage and abs(ours.after.psnr - right.after.psnr) < 0.1  # dB


@pytest.mark.parametrize("method", ["splatfacto-cpu", "pointsplat"])
def test_trainings_take_the_same_steps_on_a_gpu_from_one_thread(
    method, wall_scene, wall_config, run_training, tmp_path
):
    def losses_on(device: torch.device) -> list[float]:
        folder = tmp_path / device.type
        if method == "pointsplat":  # scenes are sampled, pruned and drawn
            config = dense_config(rooms, folder, steps=2)
            config.pipeline.datamanager.sampled_poses = 2
            config.pipeline.model.by = "merge"
            config.steps_per_eval_image = 0
        else:
            config = wall_config(wall_scene, folder, 12)  # densification is in them
        config.machine.device_type = device.type
        for group in config.optimizers.values():
            group["optimizer"].fused = False  # torch has no such kernels for the pretended device
        return run_training(config)[1]

    rooms = tmp_path / "rooms"
    write_ply(box_room(0, count=150, size=0.16), rooms / "room.ply")
    wanted = losses_on(torch.device("cpu"))
    with pretend_gpu() as gpu:
        found = losses_on(GPU)
    check(gpu)
    # rounding grows from step to step
    torch.testing.assert_close(torch.tensor(found), torch.tensor(wanted), rtol=0.02, atol=0)
