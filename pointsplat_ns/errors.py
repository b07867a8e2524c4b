"""Errors that a user can act on.

Every fault of a file, a folder or a flag raises a subclass of :class:`PointSplatError`. Its text is
one line: the path, what was found, what was expected and what to do. The command line prints that
line and exits with status 1.
"""

from __future__ import annotations

import importlib
from typing import Literal


def printable(text: str) -> str:
    r"""One line of text that cannot control a terminal: characters that are not printable become
    escapes, as in Python's ``repr``.

    Example:
        >>> print(printable("a name\x1b]0;with orders\x07\n"))
        a name\x1b]0;with orders\x07\n
    """
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


class PointSplatError(Exception):
    """Base of all errors caused by input rather than by a bug.

    Example:
        >>> import pointsplat_ns as ps
        >>> try:
        ...     ps.prune(ps.example_room(), by="magic")
        ... except ps.PointSplatError as error:
        ...     print(error)
        no method is called 'magic'; expected one of merge, coverage, paper, authors, opacity,
        random, \
lightgaussian, pup
    """

    def __str__(self) -> str:
        """The text in one line, with control characters escaped."""
        return printable(super().__str__())


class SceneError(PointSplatError):
    """A scene (PLY, checkpoint, run folder or tensors) that cannot be used.

    Example:
        >>> import pointsplat_ns as ps
        >>> try:
        ...     ps.load("nowhere.ply")
        ... except ps.SceneError as error:
        ...     print(f"{str(error)[:58]} ...")
        nowhere.ply: no such file; expected a scene (.compressed.p ...
    """


class DataError(PointSplatError):
    """Photos, poses or views that are missing, incomplete or inconsistent.

    Example:
        >>> import pointsplat_ns as ps
        >>> try:
        ...     ps.sample_views(ps.example_room()[:0], 12)
        ... except ps.DataError as error:
        ...     print(error)
        nothing of the scene is visible, so no view can be sampled
    """


class BudgetError(PointSplatError, ValueError):
    """A keep ratio, count, size or PSNR that no scene can satisfy.

    Example:
        >>> import pointsplat_ns as ps
        >>> try:
        ...     ps.prune(ps.example_room(), keep=0)
        ... except ps.BudgetError as error:
        ...     print(error)
        keep is 0 Gaussians; expected at least 1
    """


class MissingPackageError(PointSplatError):
    """An optional package that a function needs: nerfstudio or distributed.

    Example:
        >>> raise MissingPackageError("training needs nerfstudio, which is not installed")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.MissingPackageError: training needs nerfstudio, which is not installed
    """


_EXTRAS = {"nerfstudio": "nerfstudio", "distributed": "cluster"}
"""Extra of this package that installs an optional one."""


def need(package: Literal["nerfstudio", "distributed"], what: str) -> None:
    """Raise a MissingPackageError, with ``what`` needs the package, unless it can be imported."""
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:  # installed, but one of its dependencies is missing
            raise
        # pip also installs missing dependencies.
        remedy = f"install it with pip install 'pointsplat-ns[{_EXTRAS[package]}]'"
        raise MissingPackageError(
            f"{what} needs {package}, which is not installed; {remedy}"
        ) from None
