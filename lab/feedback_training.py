"""Trains the feedback network across scenes: it repairs merged pieces of scenes and maximises the
PSNR that they reach.

An update repairs a few pieces, each for a number of steps of :class:`FeedbackTrainingSettings`,
with the loss and the pairs of views of a repair. At the end, the PSNR in views that the repair does
not use is differentiated with respect to the parameters of the scene. The factors that the network
gave in all steps are then changed as if every step had added to the last scene directly: gradients
of renders and features of the network count as constants, as usual for learned optimisers
(Andrychowicz et al., arXiv 1606.04474), which avoids second derivatives. So only the features of a
share of the Gaussians are kept along a repair, and no graph of operations.
"""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

import torch
from torch import Tensor

from lab.feedback_inputs import Inputs, no_inputs
from lab.feedback_pieces import PIECES, Piece
from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline.feedback_features import REPAIR, Feedback
from pointsplat_ns.pipeline.optimiser import VIEWS_AT_ONCE, gradients_of
from pointsplat_ns.pipeline.repair import initial_rate_factor
from pointsplat_ns.refinement.feedback import FeedbackRefiner, save_feedback_refiner
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.system import processes
from pointsplat_ns.system.files import write_tensors
from pointsplat_ns.system.threads import one_thread_each


@dataclass(frozen=True)
class FeedbackTrainingSettings:
    """Settings of the training."""

    steps: tuple[int, ...] = (24, 48, 96, 192)
    """Numbers of steps of the repairs."""
    often: tuple[int, ...] = (4, 4, 2, 1)
    """How often each of them is taken, relative to the others."""
    row_share: float = 0.5
    """Share of the Gaussians whose features each step keeps."""
    measured: int = 8
    """Views that measure the last scene."""
    least_error: float = 1e-5
    """Added to mean squared errors (50 dB), so that nearly correct scenes do not dominate the
    loss."""
    rate: float = 3e-3
    """Learning rate of the network's Adam; it falls like the rates of repairs."""
    rate_of_trained: float = 3e-3
    """The same where training continues from a trained network."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decays of the network's Adam."""
    warm_up: int = 10
    """Updates until the learning rate is reached."""
    save_interval: float = 60.0
    """Seconds between intermediate saves."""
    backend: Literal["auto"] = "auto"
    """Rasterizer: gsplat where its CUDA kernels are installed, which are several times as fast."""


TRAINING = FeedbackTrainingSettings()


@dataclass(eq=False)
class Kept:
    """What the gradient of a repair needs of a share of the Gaussians in each step."""

    rows: list[Tensor]  # per step [m] int64
    features: list[Tensor]  # per step [m, F] float32
    moves: list[dict[str, Tensor]]  # per step [m, ...] Adam's steps by parameter

    @torch.no_grad()
    def slopes(self, gradients: dict[str, Tensor]) -> Tensor:
        """Derivatives (M, 6) of the last scene's loss by the factors of all steps, to first order,
        from its gradients by parameter."""
        found = []
        for rows, moves in zip(self.rows, self.moves, strict=True):
            along = [(gradients[name][rows] * moves[name]).flatten(1).sum(1) for name in PARAMETERS]
            found.append(torch.stack(along, dim=1))
        return torch.cat(found)

    def loss(self, network: torch.nn.Module, gradients: dict[str, Tensor], share: float) -> Tensor:
        """A number whose gradient in the network's parameters is that of the last scene's loss.

        Args:
            network: gives factors (M, 6) from features (M, F).
            gradients: of the loss in the last scene, by parameter.
            share: share of the Gaussians that were kept.
        """
        return (network(torch.cat(self.features)) * self.slopes(gradients)).sum() / share


@torch.no_grad()
def roll_out(
    network: Callable[[Tensor], Tensor],
    piece: Piece,
    steps: int,
    seed: int | str,
    inputs: Inputs = no_inputs,
    kept: Kept | None = None,
) -> Gaussians:
    """The merged piece after a repair of a number of steps.

    Args:
        network: sets the steps.
        piece: the piece.
        steps: number of steps.
        seed: determines the views and what is kept.
        inputs: further inputs of the network.
        kept: filled for :meth:`Kept.loss`; None for nothing.
    """
    generator = random.Random(seed)
    chooser = torch.Generator().manual_seed(generator.getrandbits(62))
    now = piece.merged
    feedback = Feedback(now, len(piece.dense))
    # as in the whole scene: Gaussians of the same size move equally far
    feedback.rates["means"] *= piece.reach / feedback.reach
    further = inputs(piece)
    rate_factor = initial_rate_factor(piece.psnr)
    examples = _step_views(generator)
    gradients: list[dict[str, Tensor]] = []
    for step in range(steps):
        if not gradients:
            for index, size in (next(examples) for _ in range(VIEWS_AT_ONCE)):
                target = piece.target(index, size, TRAINING.backend)
                view = piece.view(index, size)
                gradients.append(gradients_of(now, view, target, backend=TRAINING.backend))
        feedback.observe(gradients.pop(0))
        done = step / steps
        features = further(feedback.features(now, done, steps))
        factors = network(features)
        moves = feedback.moves(rate_factor * cosine_factor(done, REPAIR.last_factor))
        if kept is not None:
            count = max(1, round(TRAINING.row_share * len(now)))
            rows = torch.randperm(len(now), generator=chooser)[:count].to(now.device)
            kept.rows.append(rows)
            kept.features.append(features[rows])
            kept.moves.append({name: move[rows] for name, move in moves.items()})
        now = now.replace(
            **{
                name: value + moves[name] * factors[:, kind].view(-1, *[1] * (value.dim() - 1))
                for kind, (name, value) in enumerate(now.items())
            }
        )
    return now


def _step_views(generator: random.Random) -> Iterator[tuple[int, int]]:
    """Indices of views and of their sizes, endless, as a repair takes them: all views in random
    order, in the next round in another size."""
    lap = 0
    while True:
        indices = [*range(PIECES.held_out, PIECES.views)]
        for index in generator.sample(indices, len(indices)):
            yield index, (lap + index) % 3
        lap += 1


def measured_loss(
    scene: Gaussians, piece: Piece, views: Sequence[tuple[int, int]]
) -> tuple[float, dict[str, Tensor]]:
    """Mean PSNR of a scene in held-out views (index, size) of its piece, dB, and the gradients of
    its negative by parameter."""
    leaves = scene.map(lambda value: value.detach().requires_grad_())
    total = 0.0
    for index, size in views:
        with torch.enable_grad():
            image = render(leaves, piece.view(index, size), backend=TRAINING.backend)
            target = piece.target(index, size, TRAINING.backend)
            error = (image - target).square().mean()
            loss = 10 * torch.log10(error + TRAINING.least_error) / len(views)
            loss.backward()
        total -= float(loss.detach())
    gradients = {
        name: torch.zeros_like(value)
        if value.grad is None
        else value.grad.nan_to_num(0.0, 0.0, 0.0)
        for name, value in leaves.items()
    }
    return total, gradients


def reached(
    network: Callable[[Tensor], Tensor],
    piece: Piece,
    steps: int,
    seed: int | str,
    inputs: Inputs = no_inputs,
) -> float:
    """Mean PSNR in all held-out views of a piece after a repair, dB."""
    views = [(index, size) for index in range(PIECES.held_out) for size in range(3)]
    scene = roll_out(network, piece, steps, seed, inputs) if steps else piece.merged
    return measured_loss(scene, piece, views)[0]


def repair_loss(
    network: FeedbackRefiner, piece: Piece, steps: int, seed: int | str
) -> tuple[float, Tensor]:
    """PSNR that a repair reaches, dB, and a number whose gradient in the network's parameters is
    that of its negative to first order."""
    kept = Kept([], [], [])
    last = roll_out(network, piece, steps, seed, kept=kept)
    generator = random.Random(f"{seed} measured")
    indices = generator.sample(range(PIECES.held_out), TRAINING.measured)
    psnr, gradients = measured_loss(
        last, piece, [(index, generator.randrange(3)) for index in indices]
    )
    share = len(kept.rows[0]) / len(piece.merged)
    return psnr, kept.loss(network, gradients, share)


@dataclass(eq=False)
class TrainingState:
    """A network, its optimiser and the number of updates done; what a training resumes from."""

    network: FeedbackRefiner
    adam: torch.optim.Adam
    update: int = 0

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name: weights, and the averages of the optimiser."""
        found = dict(self.network.state_dict())
        for name, parameter in self.network.named_parameters():
            for kind, value in self.adam.state.get(parameter, {}).items():
                found[f"adam.{kind}.{name}"] = value
        return found

    def write(self, path: Path, key: str) -> None:
        """Write the state of a training; ``key`` tells it from others."""
        write_tensors(path, self.tensors(), {"training": key, "update": str(self.update)})

    def restore(self, path: Path, key: str) -> bool:
        """Restore the state of the same training. Returns whether there is one.

        Raises:
            DataError: if the file is of another training, or damaged.
        """
        from safetensors import SafetensorError, safe_open

        if not path.exists():
            return False
        try:
            with safe_open(path, "pt") as file:
                header = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if header.get("training") != key:
                raise DataError(
                    f"{path}: the state of another training; expected the same scenes and options, "
                    "or another --output"
                )
            weights = {name: tensors[name] for name in self.network.state_dict()}
            self.network.load_state_dict(weights)
            for name, parameter in self.network.named_parameters():
                self.adam.state[parameter] = {
                    kind: tensors[f"adam.{kind}.{name}"].to(
                        parameter.device if kind != "step" else "cpu"
                    )
                    for kind in ("step", "exp_avg", "exp_avg_sq")
                }
            self.update = int(header["update"])
        except (OSError, KeyError, ValueError, RuntimeError, SafetensorError) as error:
            raise DataError(f"{path}: damaged; delete it to start again") from error
        return True


def train_feedback(
    pieces: Sequence[Piece],
    updates: int,
    at_once: int = 4,
    seed: int = 0,
    output: Path | None = None,
    progress: Callable[[float], None] | None = None,
    start: FeedbackRefiner | None = None,
    log: Callable[[int, float], None] | None = None,
) -> FeedbackRefiner:
    """Train a feedback network.

    Connected processes (:mod:`pointsplat_ns.system.processes`) share the repairs of each update.
    The result is the same up to rounding. Updates with gradients that are not finite are skipped.
    With ``output``, the state is written beside it at intervals; the same call resumes from it, and
    ends with the same bits as one that was not interrupted.

    Args:
        pieces: pieces on one device, which computes everything; the same in every process.
        updates: number of steps of the network's optimiser.
        at_once: repairs whose gradients are averaged in an update.
        seed: seed of the initial weights and of all choices.
        output: file for the network; written by the first process.
        progress: called with the share done, in [0, 1].
        start: a trained network to continue from; not changed. By default training starts from a
            network that gives plain Adam.
        log: called with the number of the update and the mean PSNR that its repairs gain, dB.

    Returns:
        The network, in evaluation mode.

    Raises:
        DataError: if there is no piece, an update has fewer repairs than there are processes, or
            the state is of another training.
    """
    size = processes.world_size()
    rank = processes.rank()
    if not pieces:
        raise DataError("no piece to train on; expected at least one")
    if at_once < size:
        raise DataError(
            f"{at_once} repairs in an update; expected at least as many as processes, {size}"
        )
    network = _initial(start, seed, pieces[0].dense.device)
    rate = TRAINING.rate if start is None else TRAINING.rate_of_trained
    adam = torch.optim.Adam(network.parameters(), lr=rate, betas=TRAINING.betas)
    state = TrainingState(network, adam)
    names = [piece.name for piece in pieces]
    work = [names, updates, at_once, seed, repr(TRAINING), repr(PIECES), start is not None]
    key = json.dumps(work)
    state_path = None if output is None else output.with_name(f"{output.stem}.state.safetensors")
    if state_path is not None:
        state.restore(state_path, key)
    saved = time.monotonic()
    while state.update < updates:
        done = state.update / updates
        warm = min(1, (state.update + 1) / TRAINING.warm_up)
        adam.param_groups[0]["lr"] = rate * warm * cosine_factor(done, REPAIR.last_factor)
        adam.zero_grad()
        generator = random.Random(f"{seed} {state.update}")
        gains = []
        for number in range(at_once):
            piece = generator.choice(pieces)
            steps = generator.choices(TRAINING.steps, TRAINING.often)[0]
            if number % size == rank:
                with one_thread_each():
                    own = f"{seed} {state.update} {number}"
                    psnr, loss = repair_loss(network, piece, steps, own)
                    (loss * (size / at_once)).backward()
                gains.append(psnr - piece.psnr)
        processes.average_gradients(network.parameters())
        if torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0).isfinite():
            adam.step()
        state.update += 1
        if log is not None:
            log(state.update, fmean(processes.gathered(gains)))
        ended = state.update == updates
        if output is not None and state_path is not None and rank == 0:
            if ended or time.monotonic() - saved > TRAINING.save_interval:
                state.write(state_path, key)
                metadata = {
                    "pieces": names,
                    "updates": state.update,
                    "repairs_per_update": at_once,
                    "steps": TRAINING.steps,
                }
                save_feedback_refiner(network, output, metadata)
                saved = time.monotonic()
        if progress is not None:
            progress(state.update / updates)
    return network.eval()


def _initial(start: FeedbackRefiner | None, seed: int, device: torch.device) -> FeedbackRefiner:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = FeedbackRefiner(most_steps=max(TRAINING.steps)).to(device)
    if start is not None:
        network.load_state_dict(start.state_dict())
    return network
