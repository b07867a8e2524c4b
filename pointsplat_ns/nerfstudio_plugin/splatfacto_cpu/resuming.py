"""What a training of Splatfacto depends on beside its weights and optimisers, so that it goes on as if unbroken."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from nerfstudio.pipelines.base_pipeline import Pipeline

_LISTS = ("train_unseen_cameras", "eval_unseen_cameras")
"""Attributes of the datamanager: the frames that are still to come before any is repeated."""


def training_state(pipeline: Pipeline) -> dict[str, Any]:
    """Random numbers to come, the order of the frames, and what densification has gathered, as plain values and tensors
    that torch loads with ``weights_only``."""
    manager: Any = pipeline.datamanager
    kind, keys, *rest = np.random.get_state()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "python": random.getstate(),
        "numpy": [kind, torch.from_numpy(np.asarray(keys, np.int64)), *rest],
        "densification": dict(pipeline.model.strategy_state),
        **{name: list(getattr(manager, name)) for name in _LISTS},
    }
    if hasattr(manager, "random_generator"):  # of the order of the training frames
        state["frames"] = manager.random_generator.getstate()
    return state


def restore_training_state(pipeline: Pipeline, state: Mapping[str, Any]) -> None:
    """Put back what :func:`training_state` gave. Of another number of photos, their order is left alone."""
    manager: Any = pipeline.datamanager
    torch.set_rng_state(state["torch"])
    random.setstate(state["python"])
    kind, keys, *rest = state["numpy"]
    np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
    model = pipeline.model
    for name, value in state["densification"].items():
        model.strategy_state[name] = value.clone().to(model.device) if isinstance(value, torch.Tensor) else value
    numbers = (len(manager.train_dataset), len(manager.eval_dataset))
    lists = [state[name] for name in _LISTS]
    if all(0 <= index < number for number, indices in zip(numbers, lists, strict=True) for index in indices):
        for name, indices in zip(_LISTS, lists, strict=True):
            setattr(manager, name, list(indices))
        if "frames" in state and hasattr(manager, "random_generator"):
            manager.random_generator.setstate(state["frames"])
