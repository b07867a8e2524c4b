"""How a budget is read: by its type, within its range, with a message that says what was got."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning import parse_keep, resolve_keep


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


@pytest.mark.parametrize("keep", [0.0, -0.1, 1.0001, math.nan, math.inf, -math.inf, "0.5", None, True])
def test_what_is_no_ratio_is_said(keep):
    with pytest.raises(BudgetError) as caught:
        resolve_keep(1000, keep)
    assert str(caught.value).startswith(f"keep is {keep!r}; expected a ratio above 0 and up to 1.0")


@pytest.mark.parametrize("keep", [0, -1, 1001])
def test_what_is_no_count_is_said(keep):
    with pytest.raises(BudgetError, match=f"keep is {keep} Gaussians; expected 1 to 1000"):
        resolve_keep(1000, keep)


@pytest.mark.parametrize("keep", [1, 0.5])
def test_an_empty_scene_has_nothing_to_keep(keep):
    with pytest.raises(BudgetError, match="holds no Gaussians"):
        resolve_keep(0, keep)


@pytest.mark.parametrize(
    ("text", "keep"),
    [("0.3", 0.3), ("30%", 0.3), ("1", 1), ("1.0", 1.0), (" 50000 ", 50000), ("1e-2", 0.01), ("-5", -5)],
)
def test_a_typed_budget_keeps_its_kind(text, keep):
    result = parse_keep(text)
    assert result == keep and type(result) is type(keep)


@pytest.mark.parametrize("text", ["", "half", "%", "1,000", "0.3x"])
def test_a_typed_budget_that_is_none_is_said(text):
    with pytest.raises(BudgetError, match="expected a ratio"):
        parse_keep(text)
