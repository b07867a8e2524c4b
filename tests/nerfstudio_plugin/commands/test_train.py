"""``ns-train`` with the viewer and tensorboard, and what goes on from a checkpoint."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.scripts import train
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ns_commands import STEPS, Run, started


def test_page_is_served_and_shows_what_the_model_draws_while_it_is_trained(run: Run):
    run.seen.check()


def test_tensorboard_has_the_loss_of_every_step(run: Run):
    (path,) = run.folder.glob("events.out.tfevents.*")
    events = EventAccumulator(str(path)).Reload()
    losses = events.Scalars("Train Loss")
    assert [event.step for event in losses] == list(range(STEPS[run.method]))
    assert all(np.isfinite(event.value) for event in losses)


def test_both_options_go_on_from_the_checkpoint_alike(run: Run, tmp_path):
    states = []
    for option, value in (("--load-dir", run.checkpoint.parent), ("--load-checkpoint", run.checkpoint)):
        words = list(run.words)
        words[words.index("--output-dir") + 1] = str(tmp_path / option)
        started(train, *words, option, value, "--vis", "tensorboard", "--max-num-iterations", "2", *run.data)
        (path,) = (tmp_path / option).rglob("*.ckpt")
        states.append(torch.load(path, weights_only=True))
    assert [state["step"] for state in states] == [STEPS[run.method] + 1] * 2
    first = torch.load(run.checkpoint, weights_only=True)["pipeline"]
    ours, other = (state["pipeline"] for state in states)
    values = [name for name, value in ours.items() if isinstance(value, torch.Tensor)]
    assert all(torch.equal(ours[name], other[name]) for name in values)
    assert any(not torch.equal(ours[name], first[name]) for name in values), "it went on without learning"
