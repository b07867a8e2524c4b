"""Views that tests of budgets share."""

import pytest

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.view_sampling import sample_views
from pointsplat_ns.views import Views


@pytest.fixture(scope="package")
def ball_views(hollow_ball: Gaussians) -> Views:
    """Four small views from within."""
    return sample_views(hollow_ball, 4, 64, 48)
