"""Packages that only a part of this one needs, and that an installation may be without."""

from __future__ import annotations

import importlib
from typing import Literal

from pointsplat_ns.errors import MissingPackageError

_REMEDIES = {
    # pip adds what an installed package asks for and lacks.
    "nerfstudio": "pip install pointsplat-ns adds it",
    "viser": "pip install viser==0.2.7 adds it",
}


def need(package: Literal["nerfstudio", "viser"], what: str) -> None:
    """Check that a package is installed, by importing it.

    Args:
        package: the package.
        what: what needs it.

    Raises:
        MissingPackageError: if it is missing.
    """
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:  # it is there, and something that it needs is not
            raise
        raise MissingPackageError(f"{what} needs {package}, which is not installed; {_REMEDIES[package]}") from None
