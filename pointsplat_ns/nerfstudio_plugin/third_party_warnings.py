"""Warnings of nerfstudio and torch that every command would print and that its user can do nothing about.

Each is named by its text, its category and the module that it is raised for, so that no other is lost. One,
:data:`JIT_SCRIPT`, comes before nerfstudio loads any plugin: nothing here can quiet it in a ``ns-*`` command. Who
starts such a command can, with :data:`PYTHONWARNINGS`.
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
    """How its message begins."""
    category: type[Warning]
    module: str
    """For which it is raised, in full."""

    def ignore(self) -> None:
        """Ignore this warning and no other. Doing it again changes nothing."""
        warnings.filterwarnings("ignore", re.escape(self.text), self.category, re.escape(self.module) + r"\Z")


JIT_SCRIPT = KnownWarning("`torch.jit.script` is deprecated", FutureWarning, "torch.jit._script")
"""nerfstudio.cameras.camera_utils scripts a function when it is imported."""

PYTHONWARNINGS = f"ignore:{JIT_SCRIPT.text}:{JIT_SCRIPT.category.__name__}:{JIT_SCRIPT.module}"
"""Value of the environment variable of that name with which a ``ns-*`` command does not print :data:`JIT_SCRIPT`."""

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
    # The standard deviation over a single held-out photo, which is then reported as unknown.
    KnownWarning("std_mean(): degrees of freedom is <= 0", UserWarning, "nerfstudio.pipelines.base_pipeline"),
)
"""All of them are raised for modules of nerfstudio, so that ignoring them touches no other program."""


def quiet_nerfstudio() -> None:
    """Ignore :data:`NERFSTUDIO`'s warnings from now on in this process."""
    for warning in NERFSTUDIO:
        warning.ignore()


def import_nerfstudio() -> None:
    """Import the first modules of nerfstudio without the warnings that come with it.

    For code that is not run by nerfstudio, before it imports any module that needs it. nerfstudio loads plugins while
    it is itself half imported; after this, all may be imported in any order.
    """
    quiet_nerfstudio()
    with warnings.catch_warnings():  # torch's own module, so for this import alone
        JIT_SCRIPT.ignore()
        importlib.import_module("nerfstudio.cameras.camera_utils")
