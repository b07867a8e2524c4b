"""Builds the library of C++ kernels (see ``pointsplat_ns/system/native.py``) where there is a
compiler. All else is in ``pyproject.toml``."""

from __future__ import annotations

import runpy
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

NATIVE = runpy.run_path("pointsplat_ns/system/native.py")
LIBRARY: Path = NATIVE["library_path"]()


class BuildKernels(build_ext):
    """Builds a library that ctypes loads: no module of Python, so its name is its own."""

    def get_ext_filename(self, fullname: str) -> str:
        return str(Path(*fullname.split(".")[:-1], LIBRARY.name))

    def run(self) -> None:
        for folder in (LIBRARY.parent, Path(self.build_lib, LIBRARY.parent)):
            for old in folder.glob("kernels.*.so"):
                if old.name != LIBRARY.name:
                    old.unlink()  # of other sources
        super().run()


setup(
    cmdclass={"build_ext": BuildKernels},
    ext_modules=[
        Extension(
            "pointsplat_ns.system.kernels",
            sources=[path.as_posix() for path in NATIVE["cpp_files"]()],
            depends=[path.as_posix() for path in NATIVE["cpp_files"]("*.h")],
            include_dirs=[NATIVE["INCLUDE"].as_posix()],
            extra_compile_args=[*NATIVE["FLAGS"]],
            language="c++",
            optional=True,  # without a compiler torch computes everything
        )
    ],
)
