"""Trains the feedback refiner across scenes: it repairs pruned scenes, and learns from how close they have come.

An update repairs a few pruned scenes for some steps each, from sampled views, and then renders them from others. The
mean PSNR of these renders is differentiated with respect to the network through all steps. What the network sees counts
as constant, as usual for learned optimisers (Andrychowicz et al., arXiv 1606.04474): no second derivatives are needed.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.compression.feedback import REPAIR, Feedback
from pointsplat_ns.compression.optimiser import gradients_of
from pointsplat_ns.compression.repair import share_of_rates, share_of_start
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.view_source import COMPARED_VIEWS
from pointsplat_ns.pruning import prune
from pointsplat_ns.rasterizer import render
from pointsplat_ns.refiner.feedback import FeedbackRefiner, save_feedback_refiner
from pointsplat_ns.system import processes
from pointsplat_ns.system.threads import suitable_threads
from pointsplat_ns.views import Views

STEPS = (REPAIR.fewest_steps, 12, 24, REPAIR.most_steps)
"""Lengths of the repairs that the network learns from."""

AT_ONCE, TIMES = 32, 6
"""Views of a scene: so many sampled at once, so many times."""

SIDE = 400
"""Their longer side, pixels, as in repairs."""

FLOOR = 1e-5
"""Added to mean squared errors, so that scenes that are nearly right do not rule: 50 dB."""

RATE, WARM_UP = 3e-3, 20
"""Learning rate of Adam, and updates until it is reached; then it falls as those of repairs do."""

RATE_GOING_ON = 1e-3
"""The same where training goes on from a trained network."""

BACKEND: Literal["auto"] = "auto"
"""What draws: gsplat where there are its CUDA kernels, which are several times as fast there."""

SAVED_EVERY = 60.0
"""Seconds between intermediate saves."""


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """A dense scene, what was made of it, and views of it."""

    name: str
    dense: Gaussians
    pruned: dict[str, Gaussians]
    """By budget."""
    psnr: dict[str, float]
    """Of what was made of it, by budget, against the dense scene's renders, over what that covers, dB."""
    views: Views

    @classmethod
    def of(cls, name: str, dense: Gaussians, keep: Sequence[str], times: int = TIMES) -> TrainingScene:
        """Merge a scene to each budget, and sample views of it."""
        sampled = [sample_views(dense, AT_ONCE, seed=100 + number) for number in range(times)]
        viewmats, Ks = (torch.cat([getattr(v, field) for v in sampled]) for field in ("viewmats", "Ks"))
        first = sampled[0]
        views = Views(viewmats, Ks, first.width, first.height, first.background, near_plane=first.near_plane)
        views = views.resized(SIDE)
        pruned = {budget: prune(dense, budget, "merge") for budget in keep}
        reference = DenseReference(dense, views.spread(COMPARED_VIEWS))
        psnr = {budget: reference.psnr_of_covered(reference.psnr(scene)[0]) for budget, scene in pruned.items()}
        return cls(name, dense, pruned, psnr, views)


def roll_out(
    network: FeedbackRefiner, scene: TrainingScene, budget: str, steps: int, generator: random.Random
) -> Tensor:
    """How close a repair comes in views that it has not seen: the PSNR half-way or so and the mean of two views at the
    end, each with half the weight, dB. Differentiable in the network."""
    chosen = generator.sample(range(len(scene.views)), steps + 3)
    looked_at = {generator.randrange(max(1, steps // 4), steps): chosen[steps : steps + 1], steps: chosen[steps + 1 :]}
    now, share = scene.pruned[budget], share_of_start(scene.psnr[budget])
    feedback = Feedback(now, len(scene.dense))
    reached: list[Tensor] = []
    for step in range(steps):
        view = scene.views[chosen[step]]
        feedback.observe(gradients_of(now.detach(), view, _target(scene, chosen[step]), BACKEND))
        factors = network(feedback.features(now.detach(), step / steps, steps))
        now = feedback.moved(now, share * share_of_rates(step / steps), factors)
        if step + 1 in looked_at:
            seen = [_decibels(_drawn(now, scene, index), _target(scene, index)) for index in looked_at[step + 1]]
            reached.append(torch.stack(seen).mean())
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
    """Train a network.

    Processes that are connected (:mod:`pointsplat_ns.system.processes`) share the repairs of each update among them.
    What is learned is the same, to rounding. Updates whose gradients are not finite are left out.

    Args:
        scenes: on one device, where all is computed; the same in every process.
        updates: number of steps of the network's optimiser.
        at_once: repairs whose gradients are averaged in an update.
        seed: of the network's initial weights and of all choices.
        output: file that the network is saved to now and then, and at the end, by the first process.
        progress: called with the share done, in [0, 1].
        seconds: after which training ends with fewer updates; the rates fall with the time then.
        start: a trained network to go on from, which is not changed; by default one that changes nothing yet.

    Returns:
        The network, in evaluation mode.

    Raises:
        DataError: if there is no scene, one has too few views for a repair, or there are fewer repairs in an update
            than processes.
    """
    size, rank = processes.world_size(), processes.rank()
    if not scenes:
        raise DataError("no scene to train on; expected at least one")
    if at_once < size:
        raise DataError(f"{at_once} repairs in an update; expected at least as many as processes, {size}")
    for scene in scenes:
        if len(scene.views) < max(STEPS) + 3:
            raise DataError(f"{scene.name}: {len(scene.views)} views; expected at least {max(STEPS) + 3}")
    generator = random.Random(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = FeedbackRefiner().to(scenes[0].dense.device)
    if start is not None:
        network.load_state_dict(start.state_dict())
    rate = RATE if start is None else RATE_GOING_ON
    adam = torch.optim.Adam(network.parameters(), lr=rate, betas=(0.9, 0.99))
    metadata = {"scenes": [scene.name for scene in scenes], "keep": [*scenes[0].pruned], "repairs_per_update": at_once}
    began = time.monotonic()
    saved, update, done = began, 0, 0.0
    while done < 1:
        adam.param_groups[0]["lr"] = rate * min(1, (update + 1) / WARM_UP) * share_of_rates(done)
        adam.zero_grad()
        for number in range(at_once):
            scene = generator.choice(scenes)
            budget = generator.choice(list(scene.pruned))
            steps = generator.choice(STEPS)
            its_own = random.Random(generator.getrandbits(64))
            if number % size == rank:
                with suitable_threads(scene.dense.device):
                    (-roll_out(network, scene, budget, steps, its_own) * (size / at_once)).backward()
        processes.average_gradients(network.parameters())
        if torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0).isfinite():
            adam.step()
        update += 1
        now = time.monotonic()
        done = processes.gathered([max(update / updates, (now - began) / seconds)])[0]  # by the first one's clock
        if output is not None and rank == 0 and (now - saved > SAVED_EVERY or done >= 1):
            save_feedback_refiner(network, output, {**metadata, "updates": update})
            saved = now
        if progress is not None:
            progress(min(done, 1.0))
    return network.eval()


def _drawn(gaussians: Gaussians, scene: TrainingScene, index: int) -> Tensor:
    return render(gaussians, scene.views[index], backend=BACKEND)


@torch.no_grad()
def _target(scene: TrainingScene, index: int) -> Tensor:
    return _drawn(scene.dense, scene, index)


def _decibels(image: Tensor, target: Tensor) -> Tensor:
    return -10 * torch.log10((image - target).square().mean() + FLOOR)
