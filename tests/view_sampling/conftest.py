"""Tests of which views are chosen use the settings that ship."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def settings_as_they_ship(usual_looking: None) -> None:
    """All tests of this folder."""
