"""Warnings of nerfstudio and torch that every command would print and that the user can do nothing about.

Each is identified by its text, its category and its module, so that no other warning is hidden. :data:`JIT_SCRIPT` is
raised before nerfstudio loads any plugin, so nothing here can silence it in a ``ns-*`` command. The environment
variable PYTHONWARNINGS can (:attr:`KnownWarning.option`).
"""

from __future__ import annotations

import importlib
import re
import warnings
from dataclasses import dataclass


@dataclass(frozen=True)
class KnownWarning:
    """A warning that is expected of another package."""

    text: str
    """The beginning of its message."""
    category: type[Warning]
    module: str
    """Full name of the module that it is reported for."""

    @property
    def option(self) -> str:
        """Value of the environment variable PYTHONWARNINGS with which a command does not print this warning."""
        return f"ignore:{self.text}:{self.category.__name__}:{self.module}"

    def ignore(self) -> None:
        """Ignore this warning and no other. Calling this again changes nothing."""
        warnings.filterwarnings("ignore", re.escape(self.text), self.category, re.escape(self.module) + r"\Z")


JIT_SCRIPT = KnownWarning("`torch.jit.script` is deprecated", FutureWarning, "torch.jit._script")
"""nerfstudio.cameras.camera_utils scripts a function when it is imported."""

NERFSTUDIO = (
    # Decorators of nerfstudio's NeRF methods, at import.
    KnownWarning(
        "`torch.cuda.amp.custom_fwd(args...)` is deprecated", FutureWarning, "nerfstudio.field_components.activations"
    ),
    KnownWarning(
        "`torch.cuda.amp.custom_bwd(args...)` is deprecated", FutureWarning, "nerfstudio.field_components.activations"
    ),
    # The trainer's constructor.
    KnownWarning("`torch.cuda.amp.GradScaler(args...)` is deprecated", FutureWarning, "nerfstudio.engine.trainer"),
    # Losses are written to the log with their graph.
    KnownWarning(
        "Converting a tensor with requires_grad=True to a scalar may lead to unexpected behavior",
        UserWarning,
        "nerfstudio.utils.writer",
    ),
    # The standard deviation over a single held-out photo, which the evaluation then reports as None.
    KnownWarning("std_mean(): degrees of freedom is <= 0", UserWarning, "nerfstudio.pipelines.base_pipeline"),
)
"""All are reported for modules of nerfstudio, so that ignoring them affects no other code."""


def quiet_nerfstudio() -> None:
    """Ignore the warnings in :data:`NERFSTUDIO` from now on in this process."""
    for warning in NERFSTUDIO:
        warning.ignore()


def import_nerfstudio() -> None:
    """Import the first modules of nerfstudio without the warnings that come with it.

    Call it in code that nerfstudio does not run itself, before importing any module that needs nerfstudio. nerfstudio
    loads plugins while it is itself only half imported; after this call its modules can be imported in any order.
    """
    quiet_nerfstudio()
    with warnings.catch_warnings():  # raised for a module of torch: ignored during this import only
        JIT_SCRIPT.ignore()
        importlib.import_module("nerfstudio.cameras.camera_utils")
