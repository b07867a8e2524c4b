"""How a budget is read: by its type, within its range, with a message that says what was got."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning import Megabytes, WithinPsnr, parse_keep, ply_bytes, resolve_keep


@pytest.mark.parametrize(
    ("n", "keep", "k"),
    [
        (1000, 0.3, 300),
        (1000, 1.0, 1000),
        (1000, 1, 1),
        (1000, 1000, 1000),
        (3, 0.5, 2),  # a half goes up
        (100, 0.29, 29),  # 0.29 * 100 is 28.999999999999996
        (1000, 1e-9, 1),  # never nothing
        (1000, np.int64(7), 7),
        (1000, np.float32(0.5), 500),
    ],
)
def test_a_float_is_a_ratio_and_an_int_is_a_count(n, keep, k):
    result = resolve_keep(n, keep)
    assert result == k and type(result) is int


@given(st.integers(1, 10**9), st.floats(0, 1, exclude_min=True))
def test_a_ratio_is_within_half_a_gaussian_of_what_was_asked(n, ratio):
    k = resolve_keep(n, ratio)
    assert 1 <= k <= n
    assert abs(k - n * ratio) <= 0.5 + 1e-6 or k == 1  # 1e-6: n * ratio has itself been rounded


@pytest.mark.parametrize(
    ("n", "keep", "message"),
    [
        *(
            (1000, keep, f"keep is {keep!r}; expected a ratio above 0 and up to 1.0")
            for keep in (0.0, -0.1, 1.0001, math.nan, math.inf, -math.inf, b"0.5", None, True)
        ),
        *((1000, keep, f"keep is {keep} Gaussians; expected 1 to 1000") for keep in (0, -1, 1001)),
        *((1000, Megabytes(value), "keep is ") for value in (0.0, -1.0, math.nan, math.inf, 1e-6)),
        *((0, keep, "holds no Gaussians") for keep in (1, 0.5, Megabytes(1.0))),
        (1000, WithinPsnr(35.0), "found by rendering"),
        (1000, Megabytes(1.0, ".sog"), "found by writing"),
    ],
)
def test_a_budget_that_fits_no_count_of_the_scene_is_refused(n, keep, message):
    with pytest.raises(BudgetError) as caught:
        resolve_keep(n, keep)
    assert message in str(caught.value)
    assert not isinstance(keep, Megabytes) or "MB" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "keep"),
    [
        ("0.3", 0.3),
        ("30%", 0.3),
        ("1", 1),
        ("1.0", 1.0),
        (" 50000 ", 50000),
        *((text, 1000) for text in ("1e3", "1k", "1,000", "0.001M", "1000 Gaussians", "1kgaussians", "1.0e3")),
        ("1 gaussian", 1),
        ("10 %", 0.1),
        ("12kb", Megabytes(0.012)),
        ("1GB", Megabytes(1000.0)),
        ("5,000 B", Megabytes(0.005)),
        ("1.5 MB.sog", Megabytes(1.5, ".sog")),
        ("1e-2", 0.01),
        ("-5", -5),
        ("12MB", Megabytes(12.0)),
        (" 0.5 mb ", Megabytes(0.5)),
        ("12MB.SPZ", Megabytes(12.0, ".spz")),
        ("auto", WithinPsnr(35.0)),
        ("auto:40", WithinPsnr(40.0)),
        ("auto:32.5dB", WithinPsnr(32.5)),
        ("auto:32.5.sog", WithinPsnr(32.5, ".sog")),
        ("auto.spz", WithinPsnr(35.0, ".spz")),
    ],
)
def test_a_typed_budget_keeps_its_kind(text, keep):
    result = parse_keep(text)
    assert result == keep and isinstance(result, type(keep))


def test_few_gaussians_of_many_are_asked_about_unless_they_are_called_so():
    for n, text, kept in ((5000, "10%", 500), (5000, "10gaussians", 10), (4999, "10", 10), (5000, "100", 100)):
        assert resolve_keep(n, text) == kept
    assert resolve_keep(5000, 10) == 10
    wanted = r"keep is 10, of 5,000 Gaussians; did you mean 10%\? Write 10gaussians for so few"
    with pytest.raises(BudgetError, match=wanted):
        resolve_keep(5000, "10")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "half",
        "%",
        "1,00",
        "0,3",
        "0.3x",
        "MB",
        "xMB",
        "12TB",
        "1e999",
        "0.5 gaussians",
        "auto:",
        "auto:0",
        "auto:-3",
        "auto:nan",
        "auto:inf",
    ]
    + ["automatic"],
)
def test_a_typed_budget_that_is_none_is_refused(text):
    with pytest.raises(BudgetError, match="expected a ratio"):
        parse_keep(text)


@settings(max_examples=200)
@given(st.integers(1, 10**7), st.integers(0, 3), st.floats(0.002, 3000))
def test_a_size_keeps_as_many_as_fit_and_not_one_more(n, degree, megabytes):
    k = resolve_keep(n, Megabytes(megabytes), degree)
    limit = math.floor(megabytes * 1e6)
    assert 1 <= k <= n and ply_bytes(k, degree) <= limit
    assert k == n or ply_bytes(k + 1, degree) > limit
