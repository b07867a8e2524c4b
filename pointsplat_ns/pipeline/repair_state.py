"""State file of a long repair: the same command resumes from it after it was killed."""

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


class RepairStateFile:
    """File with the state of an unfinished repair.

    Args:
        path: the file; None for none. The name is automatic, so a symbolic link there is not
            followed.
        scene: K Gaussians before the first step.
        work: everything else that the steps depend on. Its text identifies the repair, together
            with the versions of this package and of torch.
    """

    SECONDS = 60.0
    """Time between two writes. A shorter repair writes nothing."""

    def __init__(self, path: Path | None, scene: Gaussians, work: object):
        self._path = path
        self._written = time.monotonic()
        if path is not None:
            # Steps of another version may differ; a mixed repair would belong to neither.
            versions = pointsplat_ns.__version__, torch.__version__
            digest = hashlib.sha256(repr((versions, work)).encode())
            for value in scene.tensors():
                digest.update(value.detach().cpu().numpy().tobytes())
            self._key = digest.hexdigest()

    def state(self, like: Mapping[str, Tensor]) -> tuple[int, dict[str, Tensor]] | None:
        """Number of steps, and tensors with the names, shapes, dtypes and devices of ``like``; None
        if there is no file of this repair."""
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
            logger.warning("%s: damaged (%s); the repair starts over", self._path, one_line(error))
            return None
        fits = all(
            (tensors[name].shape, tensors[name].dtype) == (own.shape, own.dtype)
            for name, own in like.items()
        )
        if count < 1 or not fits:
            return None
        logger.info("%s: the repair resumes after %d steps", self._path, count)
        return count, {name: value.to(like[name].device) for name, value in tensors.items()}

    def save(self, count: int, tensors: Callable[[], Mapping[str, Tensor]]) -> None:
        """Write the tensors after ``count`` steps, unless the last write is recent. A failed write
        is logged as a warning, and is the last attempt."""
        if self._path is None or time.monotonic() - self._written < self.SECONDS:
            return
        try:
            header = {"repair": self._key, "steps": str(count)}
            write_tensors(self._path, tensors(), header, named=False)
        except (OSError, SceneError) as error:
            logger.warning(
                "%s: not written (%s); a killed repair cannot resume",
                self._path,
                one_line(error),
            )
            self._path = None
        self._written = time.monotonic()
