"""Errors that a user can act on.

Everything that can be wrong with a file, a folder or a flag raises a subclass of
:class:`PointSplatError`; its text is one line that names the file, what was found, what was
expected and what to do. The command line prints that line and exits with status 1.
"""


class PointSplatError(Exception):
    """Base of all errors caused by input rather than by a bug."""


class SceneError(PointSplatError):
    """A scene (PLY, checkpoint, run folder or tensors) that cannot be used as it is."""


class DataError(PointSplatError):
    """A dataset folder that is incomplete or inconsistent."""


class BudgetError(PointSplatError, ValueError):
    """A keep ratio or count that no scene can satisfy."""
