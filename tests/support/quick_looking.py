"""Views that are sampled in a sixth of the time, and are a little worse."""

from collections.abc import Iterator
from contextlib import contextmanager

from pointsplat_ns.looking.settings import LOOKING

QUICK = {
    "candidates_per_view": 2,
    "min_candidates": 12,
    "evidence_count": 400,
}
"""Settings of looking for tests of something else."""

USUAL = {name: getattr(LOOKING, name) for name in QUICK}
"""Those that ship."""


@contextmanager
def looking(values: dict[str, int]) -> Iterator[None]:
    """Within, the default settings of looking have other values."""
    before = {name: getattr(LOOKING, name) for name in values}
    try:
        for name, value in values.items():
            object.__setattr__(LOOKING, name, value)
        yield
    finally:
        for name, value in before.items():
            object.__setattr__(LOOKING, name, value)
