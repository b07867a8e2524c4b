"""Views that tests of budgets share."""

import pytest

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking import sampling
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.views import Views


@pytest.fixture(scope="package")
def ball_views(hollow_ball: Gaussians) -> Views:
    """Four small views from within."""
    return sample_views(hollow_ball, 4, 64, 48)


@pytest.fixture()
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for views ends at the first places that show nothing, not at the fourth: each time takes seconds."""
    monkeypatch.setattr(sampling, "_FRUITLESS", 1)
