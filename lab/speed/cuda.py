"""Whether everything works on a GPU as on the CPU, and how fast the rasterizer is there beside
gsplat.

    python -m lab.speed.cuda

Checks say pass or fail, and the status is 0 if all pass. They need no other data than what ships:
golden pictures, the room, and photos of a room that are made. It takes at most four minutes, and
gsplat, if it is installed, as long as its kernels take to compile when first used, which is why it
comes last.
"""

from __future__ import annotations

import contextlib
import io
import math
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.common import scenes
from lab.common.printing import start
from lab.common.timing import seconds_of
from lab.rooms import write_room
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.rendering.rasterize import gsplat_works
from pointsplat_ns.system.threads import now

SUPPORT = Path(__file__).parents[2] / "tests" / "support"
"""Where the golden pictures are made and compared."""

NEAR_DB = 0.1
"""Largest difference of PSNR between two devices, dB: a repair rounds in another way on each."""

NEAR_GSPLAT = 4e-3, 2e-3
"""Largest difference from gsplat, of colours in [0, 1] and of a gradient's norm: gsplat counts
alpha up to 0.999 and clamps the Jacobian elsewhere."""

Check = Callable[[], str]
"""A check gives what it found in words, or raises: AssertionError with what is wrong."""


def scenes_of(every: int) -> dict[str, ps.Gaussians]:
    """The two scenes, every so many-th Gaussian of each."""
    return {
        "the room that ships": ps.example_room()[::every],
        "bare walls": scenes.room(20_000 // every),
    }


def golden_pictures(device: torch.device) -> str:
    """Pictures and gradients of small scenes are those of the float64 reference, in both
    precisions."""
    sys.path.insert(0, str(SUPPORT))
    import golden

    for name in golden.SCENES:
        for dtype, tolerances in golden.TOLERANCES.items():
            try:
                golden.compare(
                    golden.drawn(name, dtype, device), golden.drawn_by_reference(name), *tolerances
                )
            except AssertionError as error:
                raise AssertionError(f"{name}, {dtype}: {error}") from None
    return f"{len(golden.SCENES)} scenes in {len(golden.TOLERANCES)} precisions"


def pruned(scene: ps.Gaussians, device: torch.device) -> str:
    """Merging keeps as many Gaussians as on the CPU, and as good; and its time, after a part that
    warms up."""
    views = ps.sample_views(scene, 4)
    dense = ps.render(scene, views)
    found = []
    seconds = []
    for each in (torch.device("cpu"), device):
        there = scene.to(each)
        ps.prune(there[::9], 0.1)
        begun = now(each)
        small = ps.prune(there, 0.1)
        seconds.append(now(each) - begun)
        assert small.device.type == each.type, f"the result is on {small.device}; expected {each}"
        found.append((len(small), float(ps.psnr(ps.render(small.to("cpu"), views), dense).mean())))
    return f"{compared(found)}; {seconds[1]:.1f} s, on the CPU {seconds[0]:.1f} s"


def compacted(scene: ps.Gaussians, device: torch.device, resolution: tuple[int, int]) -> str:
    """The same of a compact scene. What draws is the default device, which is changed."""
    found = []
    for each in (torch.device("cpu"), device):
        with mock.patch("pointsplat_ns.pipeline.options.default_device", lambda each=each: each):
            result = ps.compact(scene, 0.1, resolution=resolution)
        found.append((len(result.scene), result.stages[-1].after.psnr))
    return compared(found)


def compared(found: list[tuple[int, float]]) -> str:
    """A line of text on numbers of Gaussians and PSNR, on the CPU and on the other device."""
    (count, right), (other, ours) = found
    assert count == other, f"{other:,} Gaussians; expected {count:,}, as on the CPU"
    assert abs(ours - right) <= NEAR_DB, f"{ours:.2f} dB; expected {right:.2f}, as on the CPU"
    return f"{count:,} Gaussians, {ours:.2f} dB, on the CPU {right:.2f}"


class Trainings:
    """Trainings of a few steps of both methods, each resumed once from the middle, in a folder.

    Args:
        folder: where everything is written.
        device: of the trainings.
        steps: number of steps, even.
        every: of the second scene of refiners, every so many-th Gaussian is taken.
    """

    def __init__(self, folder: Path, device: torch.device, steps: int, every: int):
        self.folder = folder
        self.device = device
        self.steps = steps
        self.every = every

    def of_a_scene(self) -> str:
        """splatfacto-cpu, of photos of a room that are made."""
        from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
        from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

        photos = write_room(
            self.folder / "photos" / "room0", seed=0, frames=12, width=160, height=120
        )

        def config() -> Any:
            made = splatfacto_cpu_config()
            made.pipeline.datamanager.dataparser = ReplicaDataParserConfig(num_seed_points=2000)
            made.pipeline.datamanager.data = made.data = photos
            return made

        return self._resumed(config, "room0")

    def of_a_refiner(self) -> str:
        """pointsplat, of that run and a file; ``of_a_scene`` comes before."""
        from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config

        ps.save(ps.example_room()[:: self.every], self.folder / "runs" / "room.ply", overwrite=True)

        def config() -> Any:
            made = pointsplat_config()
            made.pipeline.datamanager.data = made.data = self.folder / "runs"
            made.pipeline.datamanager.sampled_poses = 10
            made.pipeline.datamanager.sampled_size = (160, 120)
            # whose weights may be missing
            made.pipeline.model.size = "tiny"
            made.pipeline.model.lpips_weight = 0.0
            return made

        return self._resumed(config, "refiner")

    def _resumed(self, config: Callable[[], Any], name: str) -> str:
        """Train half of the steps, resume from the checkpoint for the others, and compare with one
        training of all."""
        half = self.steps // 2
        first, losses = self._trained(config(), f"{name} half", half)
        rest, others = self._trained(config(), name, self.steps - half, first.checkpoint_dir)
        last = rest.checkpoint_dir / f"step-{self.steps - 1:09d}.ckpt"
        assert last.is_file(), f"{last} is missing; there are {[*rest.checkpoint_dir.iterdir()]}"
        losses += others
        assert len(losses) == self.steps and all(map(math.isfinite, losses)), f"losses are {losses}"
        few = max(1, self.steps // 5)
        before = sum(losses[:few]) / few
        after = sum(losses[-few:]) / few
        return f"{len(losses)} steps, loss {before:.4f} to {after:.4f}"

    def _trained(
        self, config: Any, name: str, steps: int, load: Path | None = None
    ) -> tuple[Any, list[float]]:
        """The trainer after some steps, and their losses. Runs that are whole are in ``runs``, and
        others not."""
        from nerfstudio.utils import writer

        config.output_dir = self.folder / ("halves" if load is None else "runs")
        config.experiment_name = name
        config.max_num_iterations = steps
        config.load_dir = load
        config.machine.device_type = self.device.type
        config.vis = "tensorboard"
        config.pipeline.model.backend = "torch"  # gsplat's kernels may have to be compiled
        config.steps_per_eval_image = config.steps_per_eval_all_images = 0
        config.set_timestamp()
        config.save_config()
        torch.manual_seed(0)
        trainer = config.setup(local_rank=0, world_size=1)
        losses = []
        trainer.setup()
        step_of = trainer.train_iteration

        def recorded(step: int) -> Any:
            result = step_of(step)
            losses.append(float(result[0].detach()))
            return result

        trainer.train_iteration = recorded
        try:
            trainer.train()
        finally:  # nerfstudio keeps them for the process, but the folder is removed
            for each in writer.EVENT_WRITERS:
                if isinstance(each, writer.TensorboardWriter):
                    each.tb_writer.close()
            writer.EVENT_WRITERS.clear()
        return trainer, losses


def drawn(
    scene: ps.Gaussians, view: ps.View, factor: float, backend: str, grads: bool
) -> tuple[Tensor, list[Tensor]]:
    """An image (1, H, W, 3) and the gradients of its mean square, if wanted, for means, quats,
    scales, opacities and SH."""
    leaves = [
        t.detach().clone().requires_grad_(grads)
        for t in (scene.means, scene.quats, scene.stds, scene.alphas, scene.sh)
    ]
    K = view.K.clone()
    K[:2] *= factor
    image, _, _ = rasterization(
        *leaves,
        viewmats=view.viewmat[None],
        Ks=K[None],
        width=round(view.width * factor),
        height=round(view.height * factor),
        sh_degree=scene.sh_degree,
        backend=backend,
    )
    return image.detach(), [*torch.autograd.grad(image.square().mean(), leaves)] if grads else []


def times(scene: ps.Gaussians, device: torch.device, backend: str, rounds: int = 3) -> str:
    """Milliseconds of pictures of 320 and 640 pixels: medians over views and rounds, after a round
    that warms up."""
    views = ps.sample_views(scene, 4)
    scene = scene.to(device)
    found = []
    for factor in (1.0, 2.0):
        for grads in (False, True):
            call = partial(drawn, scene, factor=factor, backend=backend, grads=grads)
            milliseconds = [
                [1e3 * seconds_of(partial(call, view=view)) for view in views]
                for _ in range(rounds + 1)
            ]
            what = f"{round(views[0].width * factor)} pixels{' with gradients' * grads}"
            found.append(f"{what} {median(sum(milliseconds[1:], [])):.2f} ms")
    return f"{len(scene):,} Gaussians: {', '.join(found)}"


def beside_gsplat(scene: ps.Gaussians, device: torch.device) -> str:
    """Pictures and gradients agree with gsplat's."""
    scene = scene.to(device)
    image = 0.0
    gradient = 0.0
    for view in ps.sample_views(scene, 4):
        (ours, ours_by), (theirs, theirs_by) = (
            drawn(scene, view, 1.0, name, True) for name in ("torch", "gsplat")
        )
        image = max(image, float((ours - theirs).abs().max()))
        relative = (
            float((a - b).norm() / b.norm()) for a, b in zip(ours_by, theirs_by, strict=True)
        )
        gradient = max(gradient, *relative)
    text = f"largest difference: image {image:.1e}, gradients {gradient:.1e} of their norm"
    assert image <= NEAR_GSPLAT[0] and gradient <= NEAR_GSPLAT[1], text
    return text


def passes(name: str, check: Check) -> bool:
    """Run a check and print a line about it; whether it passed. What it prints itself is shown only
    if it failed."""
    begun = time.monotonic()
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            text = check()
    except Exception as error:  # any: the others are still worth running
        print(
            f"FAIL  {name} ({time.monotonic() - begun:.0f} s): {type(error).__name__}: {error}",
            flush=True,
        )
        print(said.getvalue()[-2000:] + traceback.format_exc(), file=sys.stderr, flush=True)
        return False
    print(f"pass  {name} ({time.monotonic() - begun:.0f} s): {text}", flush=True)
    return True


def main(
    device: str = "cuda",
    steps: int = 50,
    every: int = 1,
    resolution: tuple[int, int] = (1920, 1080),
    gsplat: bool = True,
) -> None:
    """Run all checks.

    Args:
        device: the device that is compared with the CPU. "cpu" tries the program itself.
        steps: number of steps of each training, half of which are taken after it was resumed; at
            least 2.
        every: of scenes, every so many-th Gaussian is taken.
        resolution: pixels of the pictures that compact compares.
        gsplat: compare with gsplat, if it is installed and the device is a GPU.
    """
    place = torch.device(device)
    if steps < 2 or every < 1:
        raise PointSplatError(
            f"{steps} steps, every {every}; expected at least 2 steps, every 1 or more"
        )
    if place.type == "cuda" and not torch.cuda.is_available():
        raise PointSplatError("no CUDA device; expected one, or --device cpu")
    begun = time.monotonic()
    what = torch.cuda.get_device_name(place) if place.type == "cuda" else place.type
    print(f"{what}, torch {torch.__version__}, {torch.get_num_threads()} threads", flush=True)
    results = [passes("golden pictures", partial(golden_pictures, place))]
    small = scenes_of(every)
    for name, scene in small.items():
        results.append(passes(f"prune, {name}", partial(pruned, scene, place)))
        results.append(passes(f"compact, {name}", partial(compacted, scene, place, resolution)))
    with tempfile.TemporaryDirectory() as folder:
        trainings = Trainings(Path(folder), place, steps, every)
        results.append(passes("training of a scene, resumed", trainings.of_a_scene))
        results.append(passes("training of a refiner, resumed", trainings.of_a_refiner))
    room = small["the room that ships"]
    results.append(passes("times of torch", partial(times, room, place, "torch")))
    if gsplat and place.type == "cuda" and gsplat_works():
        results.append(passes("agreement with gsplat", partial(beside_gsplat, room, place)))
        results.append(passes("times of gsplat", partial(times, room, place, "gsplat")))
    else:
        print("gsplat: not compared (it needs CUDA, and to be installed and compiled)")
    print(f"{results.count(True)} of {len(results)} passed, in {time.monotonic() - begun:.0f} s")
    sys.exit(0 if all(results) else 1)


if __name__ == "__main__":
    start(main)
