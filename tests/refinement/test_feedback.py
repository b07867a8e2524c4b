"""The feedback network, and its file."""

import pytest
import torch
from safetensors.torch import save_file

from pointsplat_ns.refinement.feedback import (
    FEEDBACK_FORMAT,
    FeedbackRefiner,
    read_feedback_refiner,
    save_feedback_refiner,
)
from pointsplat_ns.refinement.weights import WeightsError
from pointsplat_ns.scene.gaussians import PARAMETERS


def trained() -> FeedbackRefiner:
    torch.manual_seed(0)
    network = FeedbackRefiner()
    for value in network.parameters():
        torch.nn.init.normal_(value)
    return network


def test_factors_are_bounded_whatever_comes_in():
    factors = trained()(100 * torch.randn(50, FeedbackRefiner.FEATURES))
    assert factors.shape == (50, len(PARAMETERS))
    assert float(factors.log().abs().max()) <= FeedbackRefiner.MAX_LOG_FACTOR + 1e-5
    assert float(factors.log().abs().max()) > 0.5 * FeedbackRefiner.MAX_LOG_FACTOR, (
        "weights of this size use the range"
    )


def test_a_file_gives_back_the_network(tmp_path):
    network = trained()
    features = torch.randn(7, FeedbackRefiner.FEATURES)
    save_feedback_refiner(network, tmp_path / "a.safetensors", {"steps": 3})
    again = read_feedback_refiner(tmp_path / "a.safetensors")
    assert not again.training and not any(value.requires_grad for value in again.parameters())
    for found, expected in zip(again(features), network(features), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize(
    ("bias", "form", "message"),
    [
        (torch.zeros(0), "another", "not a feedback refiner"),
        (None, FEEDBACK_FORMAT, "expected"),
        (torch.nan, FEEDBACK_FORMAT, "NaN or Inf"),
    ],
    ids=["format", "missing", "nan"],
)
def test_a_file_of_another_kind_is_refused(tmp_path, bias, form, message):
    state = trained().state_dict()
    if bias is None:
        del state["mlp.0.bias"]
    else:
        state["mlp.0.bias"] = (
            bias if isinstance(bias, torch.Tensor) else torch.full_like(state["mlp.0.bias"], bias)
        )
    save_file(state, tmp_path / "a.safetensors", metadata={"format": form})
    with pytest.raises(WeightsError, match=message):
        read_feedback_refiner(tmp_path / "a.safetensors")
