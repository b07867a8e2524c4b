"""Kills programs in the middle of their work."""

import os
import signal
import time

import torch

from pointsplat_ns.errors import DataError

KILLED_AFTER_STEPS = """
import os, signal, sys
def killed_after_steps(count):
    left = [count]
    def heard(event, args):
        if event == "os.rename" and "cells" in str(args[1]):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(heard)
"""
"""The start of a program: a function that kills it once it has kept so many steps of merging by
cells; 0 never does."""


def where(seconds: float) -> tuple[int, int]:
    """The process, and its number of threads, after some seconds; killed after as many below
    zero."""
    time.sleep(abs(seconds))
    if seconds < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if seconds < 0.1:
        raise DataError("too short")
    return os.getpid(), torch.get_num_threads()
