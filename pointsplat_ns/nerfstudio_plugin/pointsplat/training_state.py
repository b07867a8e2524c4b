"""The state of a training that checkpoints hold beside weights and optimisers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

Gradients = list[tuple[nn.Parameter, Tensor]]
"""Parameters and their gradients."""


class TrainingState:
    """The scenes that a network has been trained on, the time, the skipped steps, and accumulated gradients, by part of
    the network."""

    def __init__(self, parts: Mapping[str, list[nn.Parameter]], trained_on: Iterable[str] = ()):
        self._parts = parts
        self.trained_on = set(trained_on)
        """Identities of the scenes that the network has been trained on, also before it was resumed."""
        self.seconds = 0.0
        """Duration of the training so far, also before it was resumed."""
        self.skipped: Counter[str] = Counter()
        """Number of steps skipped because a loss or a gradient was not finite, by scene, over all processes."""
        self.counted: Counter[str] = Counter()
        """Number of steps accumulated for the next update, by part."""
        self.waiting: list[str] = []
        """Parts with accumulated gradients that were not due for an update at the latest step."""

    def set_gradients_aside(self, step: int, every: Mapping[str, int]) -> Gradients:
        """At the beginning of a step: take the gradients that earlier steps accumulated off the parameters, and return
        them. ``every`` is the number of steps from one update to the next, by part."""
        gathered: Gradients = []
        for name, parameters in self._parts.items():
            before = step % every[name]
            held = [(p, p.grad) for p in parameters if p.grad is not None] if before else []
            if before == 0:
                self.counted[name] = 0
            gathered += held
            for parameter in parameters:
                parameter.grad = None
        return gathered

    @torch.no_grad()
    def gather(self, gathered: Gradients, step: int, every: Mapping[str, int], skipped: bool) -> list[str]:
        """At the end of a step: add the accumulated gradients, ``gathered``, to those of the step, unless it was
        skipped and has none. Returns the parts that are due for an update."""
        for parameter, gradient in gathered:
            parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
        for name in self._parts:
            self.counted[name] += not skipped
        self.waiting = [name for name in self._parts if (step + 1) % every[name]]
        return [name for name in self._parts if name not in self.waiting and self.counted[name]]

    def to_dict(self) -> dict[str, Any]:
        """The state as a dictionary, for a checkpoint."""
        state: dict[str, Any] = {"trained_on": sorted(self.trained_on), "skipped": dict(self.skipped)}
        state["seconds"] = self.seconds
        if self.waiting:
            state["gradients"] = {name: [p.grad for p in self._parts[name]] for name in self.waiting}
            state["counted"] = {name: self.counted[name] for name in self.waiting}
        return state

    def load(self, state: Mapping[str, Any], scenes: Iterable[str]) -> None:
        """Load the result of :meth:`to_dict`. The counts of skipped steps of other scenes than the present ones are
        dropped."""
        for name, gradients in state.get("gradients", {}).items():
            for parameter, gradient in zip(self._parts[name], gradients, strict=True):
                parameter.grad = None if gradient is None else gradient.to(parameter)
        self.waiting = list(state.get("gradients", {}))
        self.counted.clear()  # and not another one, as the trainer holds it
        self.counted.update(state.get("counted", {}))
        self.seconds = state.get("seconds", 0.0)
        there = set(scenes)
        self.skipped = Counter({name: count for name, count in state["skipped"].items() if name in there})
        self.trained_on |= set(state["trained_on"])
