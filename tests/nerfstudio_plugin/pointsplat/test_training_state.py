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


def test_a_part_is_due_after_its_own_number_of_steps_with_the_gradients_of_those_that_count(parts):
    state = TrainingState(parts)
    assert step(state, parts, 0, 7.0, skipped=True) == [] and state.counted == {"encoder": 0, "heads": 0}
    assert [step(state, parts, i, 1.0 + i) for i in (1, 2)] == [["heads"], ["encoder", "heads"]]
    assert parts["encoder"][0].grad.tolist() == [5.0, 5.0] and parts["heads"][0].grad.tolist() == [3.0]
    assert state.counted == {"encoder": 2, "heads": 1} and "gradients" not in state.to_dict()


def test_what_is_saved_is_taken_up_by_another_training(parts):
    state = TrainingState(parts, ["a/1"])
    state.skipped["a"] += 2
    step(state, parts, 0, 5.0)
    assert list(state.to_dict()["gradients"]) == ["encoder"], "only those that wait"
    others = {name: [nn.Parameter(torch.zeros_like(p)) for p in part] for name, part in parts.items()}
    resumed = TrainingState(others, ["b/1"])
    resumed.load(state.to_dict(), ["a", "b"])
    assert resumed.trained_on == {"a/1", "b/1"} and resumed.skipped == {"a": 2}
    assert resumed.waiting == ["encoder"] and resumed.counted == {"encoder": 1}
    assert others["encoder"][0].grad.tolist() == [5.0, 5.0] and others["heads"][0].grad is None
