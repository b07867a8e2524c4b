"""Errors that a user can act on.

Everything that can be wrong with a file, a folder or a flag raises a subclass of
:class:`PointSplatError`. Its text is one line that names the file, what was found, what was
expected and what to do. The command line prints that line and exits with status 1.
"""

from __future__ import annotations

import importlib
from typing import Literal


def printable(text: str) -> str:
    r"""Text in one line that cannot steer a terminal: every character that is not printable becomes
    its escape, as in Python's ``repr``.

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
        """The text in one line: what a file put into it can neither break the line nor steer a
        terminal."""
        return printable(super().__str__())


class SceneError(PointSplatError):
    """A scene (PLY, checkpoint, run folder or tensors) that cannot be used as it is.

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
        nothing of the scene can be seen, so there is no place to look from
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
    """A package that not every installation has, and that what was asked for needs: nerfstudio.

    Example:
        >>> raise MissingPackageError("training needs nerfstudio, which is not installed")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.MissingPackageError: training needs nerfstudio, which is not installed
    """


def need(package: Literal["nerfstudio"], what: str) -> None:
    """Raise a MissingPackageError, which says ``what`` needs a package, if it cannot be
    imported."""
    try:
        importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:  # it is there, and something that it needs is not
            raise
        # pip adds what an installed package asks for and lacks.
        remedy = f"pip install 'pointsplat-ns[{package}]' adds it"
        raise MissingPackageError(
            f"{what} needs {package}, which is not installed; {remedy}"
        ) from None
