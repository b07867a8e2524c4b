"""Views that are sampled in a sixth of the time, and are a little worse."""

from pointsplat_ns.view_sampling.settings import LOOKING

QUICK = {"candidates_per_view": 2, "min_candidates": 12, "evidence_count": 400}
"""Settings of looking for tests of something else."""

USUAL = {name: getattr(LOOKING, name) for name in QUICK}
"""Those that ship."""
