"""What keeps tests and the examples in docstrings quick: few and small views, no repair, coarse
rooms."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lab.rooms import light
from pointsplat_ns.pipeline import repair_budget, view_provider
from pointsplat_ns.view_sampling.settings import changed
from quick_looking import QUICK, USUAL


@pytest.fixture(scope="session", autouse=True)
def quick_looking() -> Iterator[None]:
    """Views are chosen from few candidates, unless a test is about which are chosen."""
    with changed(QUICK):
        yield


@pytest.fixture(scope="module")
def usual_looking() -> Iterator[None]:
    """The settings of looking as they ship, for tests of what they are good for."""
    with changed(USUAL):
        yield


@pytest.fixture(scope="session", autouse=True)
def small_views_by_default() -> Iterator[None]:
    """Where no views are given, those that renders are compared in have 64 x 48 pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(view_provider, "RESOLUTION", (64, 48))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_repair_by_default() -> Iterator[None]:
    """``compact`` optimises for seconds unless told otherwise; here only those tests wait for it
    that are about it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(repair_budget.STEPS, "quick", 0)
        yield


@pytest.fixture()
def coarse_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Built-in rooms whose textures and light have few points: made in a second, for tests that do
    not look at them."""
    monkeypatch.setattr(light, "LIGHT", light.LightSettings(texel=0.1, lumel=0.5))


@pytest.fixture(autouse=True)
def coarse_rooms_in_examples(request: pytest.FixtureRequest) -> None:
    """An example shows how a room is made, and not how it looks."""
    if isinstance(request.node, pytest.DoctestItem):
        request.getfixturevalue("coarse_rooms")
