"""Fine-tunes the scenes of LightGaussian and PUP-3DGS as their authors' programs do: densification
off, one training photo a step, 0.8 L1 + 0.2 (1 - SSIM)."""

from __future__ import annotations

import functools
import itertools
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from lab.tables.scenes import OpenedScene
from lab.tables.ways import PROTOCOL
from pointsplat_ns.metrics import finite_psnr
from pointsplat_ns.pipeline.optimiser import RATES, Adam, AdamSettings, optimised
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians

PUBLISHED_STEPS = 5_000
"""Steps after each pruning. LightGaussian: ``scripts/run_prune_finetune.sh`` goes from 30,000 to
35,000. PUP-3DGS: ``scripts/full_pruning_pipeline.sh``, the same in each of two rounds."""

PUBLISHED_RATES = RATES | {"opacities": 5e-2}
"""Learning rates of both programs (``arguments/__init__.py``), those of 3DGS; that of the means
follows :func:`means_rate`."""

REDUCED = {"pup": 4}
"""Factors by which training pictures are reduced for a method's scores: PUP-3DGS takes
``--fisher_resolution 4`` (``scripts/full_pruning_pipeline.sh``)."""

MEANS_RATES = 1.6e-4, 1.6e-6
"""First and last learning rate of the means in 3DGS's schedule, times the extent of the scene."""

SCHEDULE = 30_000, 35_000
"""Steps of that schedule before fine-tuning, and in all (``--position_lr_max_steps 35000``)."""

CURVE = 6
"""Number of times that the steps of a curve double, up to the last."""

Curve = list[tuple[int, float]]
"""Steps so far in all rounds, and PSNR in the held-out views, dB."""


@dataclass(frozen=True)
class FineTuning:
    """How a baseline is pruned and fine-tuned. Both continue from the dense scene with fresh
    averages of Adam."""

    decay: float = 1.0
    """Factor on all rates but the means' after every ``decay_every`` steps."""
    decay_every: int = 400
    """Steps."""
    rounds: tuple[float, ...] = ()
    """Shares of the dense scene that are kept in rounds before the last, if they are larger than
    its share. Each round prunes by scores of its own, then fine-tunes."""

    def shares(self, share: float) -> tuple[float, ...]:
        """Shares of the dense scene after each round, for a share of the last.

        Example:
            >>> FINE_TUNING["pup"].shares(0.1), FINE_TUNING["pup"].shares(0.3)
            ((0.2, 0.1), (0.3,))
        """
        return (*(kept for kept in self.rounds if kept > 1.01 * share), share)

    def words(self, share: float, steps: int) -> str:
        """The steps that are taken, and those of the publication.

        Example:
            >>> FINE_TUNING["pup"].words(0.1, 300), FINE_TUNING["lightgaussian"].words(0.1, 5000)
            ('2 x 300 of 5,000 steps', '5,000 steps')
        """
        rounds = len(self.shares(share))
        times = f"{rounds} x " if rounds > 1 else ""
        of = "" if steps == PUBLISHED_STEPS else f" of {PUBLISHED_STEPS:,}"
        return f"{times}{steps:,}{of} steps"

    def rates(self, step: int, reach: float) -> dict[str, float]:
        """Learning rates of a step, counted from 0, by parameter, for the extent of the scene."""
        factor = self.decay ** ((step + 1) // self.decay_every)
        rates = {name: factor * rate for name, rate in PUBLISHED_RATES.items()}
        return rates | {"means": means_rate(step) * reach}


FINE_TUNING = {
    # prune_finetune.py: ExponentialLR with 0.95, stepped every 400 iterations
    "lightgaussian": FineTuning(decay=0.95),
    # README.md and scripts/full_pruning_pipeline.sh: 80 % pruned, then 50 % of what is left
    "pup": FineTuning(rounds=(0.2,)),
}
"""By the method of pruning."""


def means_rate(step: int) -> float:
    """3DGS's learning rate of the means in a step of fine-tuning, counted from 0, for a scene of
    extent 1: log-linear over the steps of :data:`SCHEDULE`.

    Example:
        >>> f"{means_rate(0):.2g} {means_rate(4999):.2g}"
        '3.1e-06 1.6e-06'
    """
    first, last = MEANS_RATES
    done = min(1.0, (SCHEDULE[0] + step + 1) / SCHEDULE[1])
    return float(first ** (1 - done) * last**done)


def curve_steps(steps: int) -> set[int]:
    """Steps after which a curve has a point: the last, half of it, a quarter and so on, and 0.

    Example:
        >>> sorted(curve_steps(300))
        [0, 4, 9, 18, 37, 75, 150, 300]
    """
    return {0, *(steps >> halved for halved in range(CURVE + 1))}


def fine_tuned(
    small: Gaussians, scene: OpenedScene, settings: FineTuning, steps: int
) -> tuple[Gaussians, Curve, float]:
    """A pruned scene after some steps against training photos, or against renders of the dense
    scene where there are no photos; PSNR in the held-out views along the way; and the CPU
    seconds of the steps. Fewer steps than published are the first of as many."""
    adam = Adam(small, AdamSettings(), PUBLISHED_RATES)
    done = itertools.count()

    def choose(_: Gaussians) -> tuple[float, None]:
        adam.rates.update(settings.rates(next(done), adam.reach))
        return 1.0, None

    scenes = optimised(small, adam, examples(scene), choose, pixel_loss="l1", together=1)
    shown = curve_steps(steps)
    curve: Curve = [(0, held_out_psnr(scene, small))]
    seconds = 0.0
    last = small
    for step in range(1, steps + 1):
        start = time.process_time()
        last = next(scenes)
        seconds += time.process_time() - start
        if step in shown:
            curve.append((step, held_out_psnr(scene, last)))
    return last, curve, seconds


def examples(scene: OpenedScene) -> Iterator[Callable[[], Example]]:
    """Training views and photos, endlessly; each comes once before any is repeated, in an order
    that the seed decides. Without photos, renders of the dense scene."""
    views, photos = scene.training.views, scene.training.photos
    order = random.Random(PROTOCOL.seed)
    with torch.no_grad():
        targets = photos or [render(scene.dense, view) for view in views]
    while True:
        for index in order.sample(range(len(views)), len(views)):
            yield functools.partial(Example, views[index], targets[index].to(scene.dense.means))


@torch.no_grad()
def held_out_psnr(scene: OpenedScene, small: Gaussians) -> float:
    """Mean PSNR in the held-out views, dB, against photos, or renders of the dense scene."""
    views, photos = scene.held_out.views, scene.held_out.photos
    found = 0.0
    for index, view in enumerate(views):
        target = render(scene.dense, view) if photos is None else photos[index]
        image = render(small, view)
        found += finite_psnr(image, target.to(image)) / len(views)
    return found
