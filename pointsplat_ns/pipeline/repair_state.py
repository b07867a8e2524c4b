"""The state of a long repair in a file, from which the same command continues after it was
killed."""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

import pointsplat_ns
from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import one_line, write_tensors
from pointsplat_ns.system.outputs import is_own_file

logger = logging.getLogger("pointsplat_ns")


class Unfinished:
    """A file with the state after some of the steps of one repair.

    Args:
        path: the file; None for none. Nobody named it: a symbolic link there is not followed.
        scene: K Gaussians before the first step.
        work: all else that the steps depend on; its text tells repairs apart. So do the versions of
            this package and of torch.
    """

    SECONDS = 60.0
    """Time between two states that are written. A shorter repair writes none."""

    def __init__(self, path: Path | None, scene: Gaussians, work: object):
        self._path = path
        self._written = time.monotonic()
        if path is not None:
            # Steps of another version may differ: the repair would be of neither.
            versions = pointsplat_ns.__version__, torch.__version__
            digest = hashlib.sha256(repr((versions, work)).encode())
            for value in scene.tensors():
                digest.update(value.detach().cpu().numpy().tobytes())
            self._key = digest.hexdigest()

    def state(self, like: Mapping[str, Tensor]) -> tuple[int, dict[str, Tensor]] | None:
        """Number of steps and tensors, on the devices of those in ``like``, which have the same
        names, shapes and dtypes; None if there is no file, or it is of another repair."""
        if self._path is None or not is_own_file(self._path):
            return None
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(self._path, "pt") as file:
                header = file.metadata() or {}
                if header.get("repair") != self._key or {*file.keys()} != {*like}:
                    return None
                tensors = {name: file.get_tensor(name) for name in like}
            count = int(header["steps"])
        except (OSError, KeyError, ValueError, SafetensorError) as error:
            logger.warning("%s: damaged (%s); the repair starts again", self._path, one_line(error))
            return None
        fits = all(
            (tensors[name].shape, tensors[name].dtype) == (own.shape, own.dtype)
            for name, own in like.items()
        )
        if count < 1 or not fits:
            return None
        logger.info("%s: the repair continues after %d steps", self._path, count)
        return count, {name: value.to(like[name].device) for name, value in tensors.items()}

    def save(self, count: int, tensors: Callable[[], Mapping[str, Tensor]]) -> None:
        """Write the tensors after ``count`` steps, if the last time is long ago. If they cannot be
        written, a warning says so, and no more are."""
        if self._path is None or time.monotonic() - self._written < self.SECONDS:
            return
        try:
            header = {"repair": self._key, "steps": str(count)}
            write_tensors(self._path, tensors(), header, named=False)
        except (OSError, SceneError) as error:
            logger.warning(
                "%s: not written (%s); if this is killed, the repair is lost",
                self._path,
                one_line(error),
            )
            self._path = None
        self._written = time.monotonic()
