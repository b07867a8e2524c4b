"""A scene that photos are taken of, and what is said of them."""

import logging

import pytest

import pointsplat_ns as ps
from making import ball


@pytest.fixture(scope="session")
def scene() -> ps.Gaussians:
    return ball(500)


@pytest.fixture()
def said(caplog) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, logger="pointsplat_ns")
    return caplog
