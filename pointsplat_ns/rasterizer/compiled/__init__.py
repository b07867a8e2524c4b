"""The rasterizer's inner loops in C++, for float32 on a CPU where they were built; elsewhere torch does the same.

Each module calls the C++ file of its name. They are loaded, and compared with torch, together:
``rasterizer/pictures.py`` says how.
"""

from pathlib import Path

from pointsplat_ns.system.kernels import Kernels

KERNELS = Kernels("the rasterizer", Path(__file__).parent)
