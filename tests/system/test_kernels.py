"""Functions of a C++ file are called on threads of the process, and are compared with torch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pointsplat_ns.system import kernels
from pointsplat_ns.system.kernels import agreement


@pytest.mark.parametrize("wrong", [2.0, float("nan"), float("inf")])
def test_tensors_agree_up_to_a_share_of_numbers_that_are_off_or_not_finite(wrong):
    right = torch.linspace(-1, 1, 100)
    off = right.clone()
    off[:2] = wrong
    assert agreement([right, right + 9e-4], [right, right], off=1e-3, share=0.01)
    assert agreement([off], [right], off=1e-3, share=0.03)
    assert not agreement([off], [right], off=1e-3, share=0.02)
    assert not agreement([right, right + 2e-3], [right, right], off=1e-3, share=0.01)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_process_that_was_forked_has_threads_of_its_own():
    code = """
import os, sys
from pointsplat_ns.system import kernels
kernels._pool(os.getpid()).submit(int).result()
child = os.fork()
if child == 0:
    os._exit(kernels._pool(os.getpid()).submit(int, 7).result(10))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 7)
"""
    root = Path(kernels.__file__).parents[2]
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], cwd=root, timeout=120, check=True)
