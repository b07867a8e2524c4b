"""What a training remembers beside weights and optimisers."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from pointsplat_ns.nerfstudio_plugin.pointsplat.training_state import TrainingState

EVERY = {"encoder": 3, "heads": 1}


@pytest.fixture
def parts() -> dict[str, list[nn.Parameter]]:
    return {"encoder": [nn.Parameter(torch.zeros(2))], "heads": [nn.Parameter(torch.zeros(1))]}


def step(state: TrainingState, parts, number: int, gradient: float, skipped: bool = False) -> list[str]:
    """One step whose gradients are all of one value; gives the parts that are due."""
    gathered = state.set_gradients_aside(number, EVERY)
    if not skipped:
        for parameter in (p for part in parts.values() for p in part):
            parameter.grad = torch.full_like(parameter, gradient)
    return state.gather(gathered, number, EVERY, skipped)


def test_a_part_is_due_after_its_own_number_of_steps(parts):
    state = TrainingState(parts)
    assert [step(state, parts, i, 1.0) for i in range(3)] == [["heads"], ["heads"], ["encoder", "heads"]]


def test_gradients_of_steps_add_up_and_are_counted_until_the_update(parts):
    state = TrainingState(parts)
    for i in range(3):
        step(state, parts, i, 1.0 + i)
    assert parts["encoder"][0].grad.tolist() == [6.0, 6.0] and parts["heads"][0].grad.tolist() == [3.0]
    assert state.counted == {"encoder": 3, "heads": 1}


def test_a_skipped_step_is_neither_counted_nor_due(parts):
    state = TrainingState(parts)
    assert step(state, parts, 0, 1.0, skipped=True) == [] and state.counted == {"encoder": 0, "heads": 0}
    step(state, parts, 1, 1.0)
    assert step(state, parts, 2, 1.0) == ["encoder", "heads"] and state.counted["encoder"] == 2


def test_only_gradients_that_wait_are_saved(parts):
    state = TrainingState(parts)
    step(state, parts, 0, 1.0)
    saved = state.to_dict()
    assert list(saved["gradients"]) == ["encoder"] and saved["counted"] == {"encoder": 1}
    step(state, parts, 1, 1.0), step(state, parts, 2, 1.0)
    assert "gradients" not in state.to_dict()


def test_what_is_saved_is_taken_up_by_another_training(parts):
    state = TrainingState(parts, ["a/1"])
    state.skipped["a"] += 2
    step(state, parts, 0, 5.0)
    others = {name: [nn.Parameter(torch.zeros_like(p)) for p in part] for name, part in parts.items()}
    resumed = TrainingState(others, ["b/1"])
    resumed.load(state.to_dict(), ["a", "b"])
    assert resumed.trained_on == {"a/1", "b/1"} and resumed.skipped == {"a": 2}
    assert resumed.waiting == ["encoder"] and resumed.counted == {"encoder": 1}
    assert others["encoder"][0].grad.tolist() == [5.0, 5.0] and others["heads"][0].grad is None
