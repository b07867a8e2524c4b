"""Exactly K, always the same K."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning import select


def by_sorting(scores, k):
    """The definition: sort by (NaN last, score descending, index), take k, order by index."""
    order = sorted(
        range(len(scores)), key=lambda i: (math.isnan(scores[i]), -scores[i] if scores[i] == scores[i] else 0, i)
    )
    return sorted(order[:k])


values = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, 1.0, 2.0, math.nan, math.inf, -math.inf])
)  # few values, so that ties are common


@settings(max_examples=200)
@given(st.lists(values, max_size=30).flatmap(lambda x: st.tuples(st.just(x), st.integers(0, len(x)))))
def test_select_is_its_definition(case):
    scores, k = case
    found = select(torch.tensor(scores, dtype=torch.float64), k)
    assert found.tolist() == by_sorting(scores, k) and found.dtype == torch.int64


@pytest.mark.parametrize("k", [-1, 6])
def test_more_or_fewer_than_there_are_is_said(k):
    with pytest.raises(BudgetError, match=f"cannot select {k} of 5 Gaussians; expected 0 to 5"):
        select(torch.zeros(5), k)
