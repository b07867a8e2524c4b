"""Kills programs in the middle of their work."""

import os
import signal
import time

import torch

from pointsplat_ns.errors import DataError


def where(seconds: float) -> tuple[int, int]:
    """The process, and its number of threads, after some seconds; killed after as many below zero."""
    time.sleep(abs(seconds))
    if seconds < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if seconds < 0.1:
        raise DataError("too short")
    return os.getpid(), torch.get_num_threads()
