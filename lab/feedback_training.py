"""Trains the feedback network across scenes: it repairs pruned scenes and maximises the PSNR that
they reach.

An update repairs a few pruned scenes for some steps each in sampled views, and then renders them in
other views. The mean PSNR of these renders is differentiated with respect to the network through
all steps. The features of the network count as constants, as usual for learned optimisers
(Andrychowicz et al., arXiv 1606.04474), which avoids second derivatives.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline.feedback_features import REPAIR, Feedback
from pointsplat_ns.pipeline.optimiser import gradients_of
from pointsplat_ns.pipeline.repair import initial_rate_factor
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.pruning import prune
from pointsplat_ns.refinement.feedback import FeedbackRefiner, save_feedback_refiner
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.sizes import RESOLUTION, middle_sized, several_sizes
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system import processes
from pointsplat_ns.system.threads import one_thread_each
from pointsplat_ns.view_sampling.sampler import sample_views


@dataclass(frozen=True)
class FeedbackTrainingSettings:
    """Settings of the training."""

    steps: tuple[int, ...] = (REPAIR.fewest_steps, 12, 24, REPAIR.most_steps)
    """Numbers of steps of the repairs."""
    batch_views: int = 32
    """Views of a scene in a batch of the sampler."""
    view_batches: int = 3
    """Batches of views of a scene."""
    least_error: float = 1e-5
    """Added to mean squared errors (50 dB), so that nearly correct scenes do not dominate the
    loss."""
    rate: float = 3e-3
    """Learning rate of the network's Adam; it falls like the rates of repairs."""
    rate_of_trained: float = 1e-3
    """The same where training continues from a trained network."""
    warm_up: int = 20
    """Updates until the learning rate is reached."""
    save_interval: float = 60.0
    """Seconds between intermediate saves."""
    backend: Literal["auto"] = "auto"
    """Rasterizer: gsplat where its CUDA kernels are installed, which are several times as fast."""


TRAINING = FeedbackTrainingSettings()


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """A dense scene, its pruned scenes, and views of it."""

    name: str
    dense: Gaussians
    pruned: dict[str, Gaussians]
    """Pruned scenes by budget."""
    psnr: dict[str, float]
    """PSNR of each pruned scene by budget, over the pixels that the dense scene covers, dB."""
    views: tuple[Views, ...]
    """The same views of several sizes, which take turns."""
    _renders: dict[int, Tensor] = field(default_factory=dict)
    """Renders of the dense scene, 8 bits per channel, by the index of the view."""

    @classmethod
    def of(
        cls, name: str, dense: Gaussians, keep: Sequence[str], view_batches: int | None = None
    ) -> TrainingScene:
        """Merge a scene to each budget, and sample views of it."""
        batches = TRAINING.view_batches if view_batches is None else view_batches
        sampled = [
            sample_views(dense, TRAINING.batch_views, *RESOLUTION, seed=100 + n)
            for n in range(batches)
        ]
        viewmats, Ks = (
            torch.cat([getattr(v, field) for v in sampled]) for field in ("viewmats", "Ks")
        )
        first = sampled[0]
        views = Views(
            viewmats, Ks, first.width, first.height, first.background, near_plane=first.near_plane
        )
        pruned = {budget: prune(dense, budget, "merge") for budget in keep}
        reference = DenseReference(dense, middle_sized(views).spread(VIEW_COUNTS.compared))
        psnr = {budget: reference.psnr(scene)[0] for budget, scene in pruned.items()}
        return cls(name, dense, pruned, psnr, several_sizes(views))

    def view(self, index: int) -> View:
        """A view of the size for its index."""
        return self.views[index % len(self.views)][index]

    @torch.no_grad()
    def target(self, index: int) -> Tensor:
        """Render of the dense scene in a view, (H, W, 3); drawn once."""
        if index not in self._renders:
            self._renders[index] = (
                _drawn(self.dense, self, index).clamp(0, 1).mul(255).round().byte()
            )
        return self._renders[index] / 255


def roll_out(
    network: FeedbackRefiner,
    scene: TrainingScene,
    budget: str,
    steps: int,
    generator: random.Random,
) -> Tensor:
    """Repair a pruned scene, and measure its PSNR in views that the repair does not use.

    Args:
        network: sets the steps; the result is differentiable in its parameters.
        scene: the scene.
        budget: key of its pruned scene.
        steps: number of steps.
        generator: chooses views, and the step of the first measurement.

    Returns:
        PSNR in dB: half of it from one view between a quarter and all of the steps, half from two
        views at the end.
    """
    chosen = generator.sample(range(len(scene.views[0])), steps + 3)
    measured = {
        generator.randrange(max(1, steps // 4), steps): chosen[steps : steps + 1],
        steps: chosen[steps + 1 :],
    }
    now = scene.pruned[budget]
    factor = initial_rate_factor(scene.psnr[budget])
    feedback = Feedback(now, len(scene.dense))
    reached: list[Tensor] = []
    for step in range(steps):
        view = scene.view(chosen[step])
        feedback.observe(
            gradients_of(now.detach(), view, scene.target(chosen[step]), backend=TRAINING.backend)
        )
        factors = network(feedback.features(now.detach(), step / steps, steps))
        now = feedback.moved(now, factor * cosine_factor(step / steps, REPAIR.last_factor), factors)
        if step + 1 in measured:
            psnrs = [
                _decibels(_drawn(now, scene, index), scene.target(index))
                for index in measured[step + 1]
            ]
            reached.append(torch.stack(psnrs).mean())
    return 0.5 * torch.stack(reached).sum()


def train_feedback(
    scenes: Sequence[TrainingScene],
    updates: int,
    at_once: int = 4,
    seed: int = 0,
    output: Path | None = None,
    progress: Callable[[float], None] | None = None,
    seconds: float = math.inf,
    start: FeedbackRefiner | None = None,
) -> FeedbackRefiner:
    """Train a feedback network.

    Connected processes (:mod:`pointsplat_ns.system.processes`) share the repairs of each update.
    The result is the same up to rounding. Updates with gradients that are not finite are skipped.

    Args:
        scenes: scenes on one device, which computes everything; the same in every process.
        updates: number of steps of the network's optimiser.
        at_once: repairs whose gradients are averaged in an update.
        seed: seed of the initial weights and of all choices.
        output: file for the network; the first process saves it at intervals and at the end.
        progress: called with the share done, in [0, 1].
        seconds: time limit; training may end with fewer updates, and the learning rate falls with
            the time.
        start: a trained network to continue from; not changed. By default training starts from a
            network with zero steps.

    Returns:
        The network, in evaluation mode.

    Raises:
        DataError: if there is no scene, a scene has too few views for a repair, or an update has
            fewer repairs than there are processes.
    """
    size = processes.world_size()
    rank = processes.rank()
    if not scenes:
        raise DataError("no scene to train on; expected at least one")
    if at_once < size:
        raise DataError(
            f"{at_once} repairs in an update; expected at least as many as processes, {size}"
        )
    needed_views = max(TRAINING.steps) + 3
    for scene in scenes:
        if len(scene.views[0]) < needed_views:
            raise DataError(
                f"{scene.name}: {len(scene.views[0])} views; expected at least {needed_views}"
            )
    generator = random.Random(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = FeedbackRefiner().to(scenes[0].dense.device)
    if start is not None:
        network.load_state_dict(start.state_dict())
    rate = TRAINING.rate if start is None else TRAINING.rate_of_trained
    adam = torch.optim.Adam(network.parameters(), lr=rate, betas=(0.9, 0.99))
    metadata = {
        "scenes": [scene.name for scene in scenes],
        "keep": [*scenes[0].pruned],
        "repairs_per_update": at_once,
    }
    began = time.monotonic()
    saved = began
    update = 0
    done = 0.0
    while done < 1:
        adam.param_groups[0]["lr"] = (
            rate * min(1, (update + 1) / TRAINING.warm_up) * cosine_factor(done, REPAIR.last_factor)
        )
        adam.zero_grad()
        for number in range(at_once):
            scene = generator.choice(scenes)
            budget = generator.choice(list(scene.pruned))
            steps = generator.choice(TRAINING.steps)
            own_generator = random.Random(generator.getrandbits(64))
            if number % size == rank:
                with one_thread_each():
                    (
                        -roll_out(network, scene, budget, steps, own_generator) * (size / at_once)
                    ).backward()
        processes.average_gradients(network.parameters())
        if torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0).isfinite():
            adam.step()
        update += 1
        now = time.monotonic()
        done = processes.gathered([max(update / updates, (now - began) / seconds)])[
            0
        ]  # the clock of the first process
        if output is not None and rank == 0 and (now - saved > TRAINING.save_interval or done >= 1):
            save_feedback_refiner(network, output, {**metadata, "updates": update})
            saved = now
        if progress is not None:
            progress(min(done, 1.0))
    return network.eval()


def _drawn(gaussians: Gaussians, scene: TrainingScene, index: int) -> Tensor:
    return render(gaussians, scene.view(index), backend=TRAINING.backend)


def _decibels(image: Tensor, target: Tensor) -> Tensor:
    return -10 * torch.log10((image - target).square().mean() + TRAINING.least_error)
