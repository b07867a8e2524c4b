"""Settings that make a test of something else quick: few and small views, no repair."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

from pointsplat_ns.pipeline import view_provider
from pointsplat_ns.pipeline.repair_budget import STEPS
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings

QUICK = replace(DEFAULT_SETTINGS, candidates_per_view=2, min_candidates=12, evidence_count=400)
"""Views sampled in a sixth of the time, a little worse."""

RESOLUTION = (64, 48)
"""Width and height of sampled views in which renders are compared, pixels."""


@contextmanager
def quick_settings() -> Iterator[None]:
    """Within, views are chosen from few candidates and small, and ``--effort quick`` takes no
    steps."""
    small = mock.patch.object(view_provider, "RESOLUTION", RESOLUTION)
    unrepaired = mock.patch.dict(STEPS, {"quick": 0})
    with use_settings(QUICK), small, unrepaired:
        yield
