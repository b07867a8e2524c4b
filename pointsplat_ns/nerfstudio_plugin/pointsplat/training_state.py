"""What a training remembers beside weights and optimisers, and its checkpoints hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

Gradients = list[tuple[nn.Parameter, Tensor]]
"""Parameters and their gradients."""


class TrainingState:
    """Which scenes a network has been trained on, which steps were skipped, and gradients that wait for their update.

    Args:
        parts: the network's parameters, by part.
        trained_on: identities of the scenes that it is trained on from now on.
    """

    def __init__(self, parts: Mapping[str, list[nn.Parameter]], trained_on: Iterable[str] = ()):
        self._parts = parts
        self.trained_on = set(trained_on)
        """Identities of the scenes that the network has been trained on, resumed trainings included."""
        self.skipped: Counter[str] = Counter()
        """Steps that were left out because a loss or a gradient was not finite, by scene, over all processes."""
        self.counted: dict[str, int] = {}
        """Steps whose gradients have gathered for the next update, by part."""
        self.waiting: list[str] = []
        """Parts whose gradients wait for their update, after the latest step."""

    def set_gradients_aside(self, step: int, every: Mapping[str, int]) -> Gradients:
        """What earlier steps have gathered for an update, at the beginning of a step; the network is left without
        gradients.

        Args:
            step: that begins.
            every: steps from one update to the next, by part.
        """
        gathered: Gradients = []
        for name, parameters in self._parts.items():
            before = step % every[name]
            held = [(p, p.grad) for p in parameters if p.grad is not None] if before else []
            if before == 0:
                self.counted[name] = 0
            self.counted.setdefault(name, before if held else 0)  # a checkpoint of an earlier version
            gathered += held
            for parameter in parameters:
                parameter.grad = None
        return gathered

    @torch.no_grad()
    def gather(self, gathered: Gradients, step: int, every: Mapping[str, int], skipped: bool) -> list[str]:
        """Add what was set aside to the gradients of a step that ends.

        Args:
            gathered: from :meth:`set_gradients_aside`.
            step: that ends.
            every: as there.
            skipped: whether the step was left out, and has no gradients.

        Returns:
            The parts that are due to be updated.
        """
        for parameter, gradient in gathered:
            parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
        for name in self._parts:
            self.counted[name] += not skipped
        self.waiting = [name for name in self._parts if (step + 1) % every[name]]
        return [name for name in self._parts if name not in self.waiting and self.counted[name]]

    def to_dict(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        state: dict[str, Any] = {"trained_on": sorted(self.trained_on), "skipped": dict(self.skipped)}
        if self.waiting:
            state["gradients"] = {name: [p.grad for p in self._parts[name]] for name in self.waiting}
            state["counted"] = {name: self.counted[name] for name in self.waiting if name in self.counted}
        return state

    def load(self, state: Mapping[str, Any], scenes: Iterable[str]) -> None:
        """Take up what a checkpoint holds; those of earlier versions lack all but ``trained_on``.

        Args:
            state: from :meth:`to_dict`.
            scenes: names of the scenes that there are; skipped steps of others are forgotten.
        """
        for name, gradients in state.get("gradients", {}).items():
            for parameter, gradient in zip(self._parts[name], gradients, strict=True):
                parameter.grad = None if gradient is None else gradient.to(parameter)
        self.waiting = list(state.get("gradients", {}))
        self.counted.update(state.get("counted", {}))
        there = set(scenes)
        self.skipped = Counter({name: count for name, count in state.get("skipped", {}).items() if name in there})
        self.trained_on |= set(state["trained_on"])
