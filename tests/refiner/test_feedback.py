"""The network that sets the steps of a repair, and its files."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from pointsplat_ns.refiner.feedback import (
    FEATURES,
    FORMAT,
    MAX_LOG_FACTOR,
    PARAMETERS,
    PRETRAINED,
    FeedbackRefiner,
    read_feedback_refiner,
    save_feedback_refiner,
)
from pointsplat_ns.refiner.weights import WeightsError


def trained() -> FeedbackRefiner:
    torch.manual_seed(0)
    network = FeedbackRefiner()
    for value in network.parameters():
        torch.nn.init.normal_(value)
    return network


def test_factors_are_bounded_whatever_comes_in():
    factors = trained()(100 * torch.randn(50, FEATURES))
    assert factors.shape == (50, len(PARAMETERS))
    assert float(factors.log().abs().max()) <= MAX_LOG_FACTOR + 1e-5
    assert float(factors.log().abs().max()) > 0.5 * MAX_LOG_FACTOR, "weights of this size use the range"


def test_a_file_gives_back_the_network(tmp_path):
    network, features = trained(), torch.randn(7, FEATURES)
    save_feedback_refiner(network, tmp_path / "a.safetensors", {"steps": 3})
    again = read_feedback_refiner(tmp_path / "a.safetensors")
    assert not again.training and not any(value.requires_grad for value in again.parameters())
    for found, expected in zip(again(features), network(features), strict=True):
        assert torch.equal(found, expected)


def test_the_network_that_ships_is_there_and_trained():
    network = read_feedback_refiner()
    assert PRETRAINED.is_file() and bool(network.mlp[-1].weight.any())


def broken(kind: str) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    state, header = trained().state_dict(), {"format": FORMAT}
    if kind == "format":
        header = {"format": "another"}
    elif kind == "missing":
        del state["mlp.0.bias"]
    elif kind == "shape":
        state["mlp.0.bias"] = torch.zeros(3)
    elif kind == "nan":
        state["mlp.0.bias"][0] = torch.nan
    return state, header


@pytest.mark.parametrize(
    ("kind", "message"),
    [("format", "not a feedback refiner"), ("missing", "expected"), ("shape", "expected"), ("nan", "NaN or Inf")],
)
def test_a_file_of_another_kind_is_refused(tmp_path, kind, message):
    state, header = broken(kind)
    save_file(state, tmp_path / "a.safetensors", metadata=header)
    with pytest.raises(WeightsError, match=message):
        read_feedback_refiner(tmp_path / "a.safetensors")


def test_a_damaged_or_missing_file_is_refused(tmp_path):
    save_feedback_refiner(trained(), tmp_path / "a.safetensors")
    whole = (tmp_path / "a.safetensors").read_bytes()
    (tmp_path / "a.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(WeightsError, match="not a readable"):
        read_feedback_refiner(tmp_path / "a.safetensors")
    with pytest.raises(WeightsError, match="no such file"):
        read_feedback_refiner(tmp_path / "b.safetensors")
