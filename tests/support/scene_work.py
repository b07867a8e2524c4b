"""What tests do in other processes, also to scenes of a folder."""

import os
import signal
import time
from pathlib import Path

import torch

from pointsplat_ns.compression.quality import Judge
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.scene_folder import SmallerScene


class OfThirty(Judge):
    """Judges each scene alike."""

    def __init__(self, dense: Gaussians, source: ViewSource):
        """Nothing is drawn."""

    def psnr(self, scene: Gaussians, progress: object = None) -> tuple[float, float]:
        return 30.0, 30.0


def halve(scene: Gaussians, path: Path, journal: Path) -> SmallerScene:
    """Every other Gaussian. A line of the journal says that it was made.

    A scene called ``bad...`` fails; at one called ``killed...`` its process is killed the first time, at one called
    ``deadly...`` each time.
    """
    with journal.open("a") as stream:
        stream.write(f"{path.stem}\n")
    seen = journal.read_text().split().count(path.stem)
    if path.stem.startswith("bad"):
        raise SceneError(f"{path}: is bad")
    if path.stem.startswith("deadly") or (path.stem.startswith("killed") and seen == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return SmallerScene(scene[::2], OfThirty(scene, ViewSource(scene)))


def where(seconds: float) -> tuple[int, int]:
    """The process, and its number of threads, after some seconds."""
    time.sleep(seconds)
    if seconds < 0.1:
        raise DataError("too short")
    return os.getpid(), torch.get_num_threads()
