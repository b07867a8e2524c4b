"""Packages that only a part of this one needs, and that an installation may be without."""

from __future__ import annotations

import importlib
from typing import Literal

from pointsplat_ns.errors import MissingPackageError


def need(package: Literal["nerfstudio"], what: str) -> None:
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
        # pip adds what an installed package asks for and lacks.
        remedy = f"pip install 'pointsplat-ns[{package}]' adds it"
        raise MissingPackageError(f"{what} needs {package}, which is not installed; {remedy}") from None
