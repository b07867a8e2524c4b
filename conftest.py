"""Fixtures that tests and the examples in docstrings ask for by name.

Without them everything runs as it ships. A module of tests that are about something else than
views and repairs asks for ``quick``:

    pytestmark = pytest.mark.usefixtures("quick")
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from lab.rooms import light
from quick import quick_settings


@pytest.fixture(scope="module")
def quick() -> Iterator[None]:
    """Few and small views, no repair: see :func:`quick.quick_settings`. Fixtures of a session run
    before this one; those that sample views ask for :func:`quick_settings` themselves."""
    with quick_settings():
        yield


@pytest.fixture()
def coarse_rooms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Built-in rooms whose textures and light have few points: made in a second, for tests that do
    not look at them."""
    monkeypatch.setattr(light, "LIGHT", light.LightSettings(texel=0.1, lumel=0.5))


@pytest.fixture(autouse=True)
def quick_examples(request: pytest.FixtureRequest) -> None:
    """Examples in docstrings, which cannot ask, show how functions are called, not how good they
    are."""
    if isinstance(request.node, pytest.DoctestItem):
        request.getfixturevalue("quick")
        request.getfixturevalue("coarse_rooms")
