"""Training of the feedback network on pieces of scenes."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from lab import feedback_pieces, feedback_study, feedback_training, make_feedback
from lab.feedback_inputs import COLUMNS, NEIGHBOURS, all_inputs
from lab.feedback_pieces import MEMBERS, Piece, PieceSettings, member_features, pieces_of
from lab.feedback_training import (
    FeedbackTrainingSettings,
    Kept,
    measured_loss,
    reached,
    roll_out,
    train_feedback,
)
from pointsplat_ns.errors import DataError
from pointsplat_ns.refinement.feedback import FeedbackRefiner, read_feedback_refiner
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.scene.ply import write_ply

SMALL = PieceSettings(merged=60, fewest_merged=10, views=12, held_out=4, drawn_side=32)


@pytest.fixture(scope="module", autouse=True)
def small_settings() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feedback_pieces, "PIECES", SMALL)
        patch.setattr(feedback_training, "PIECES", SMALL)
        settings = FeedbackTrainingSettings(steps=(6, 8), often=(1, 1), measured=3)
        patch.setattr(feedback_training, "TRAINING", settings)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("pieces")


@pytest.fixture(scope="module")
def pieces(hollow_ball, folder) -> list[Piece]:
    return [*pieces_of("ball", hollow_ball, [0.1, 0.2], 2, folder)]


def test_training_brings_repairs_closer(pieces):
    def mean(network: FeedbackRefiner) -> float:
        return sum(reached(network, piece, 8, seed) for piece in pieces for seed in range(2)) / 4

    network = train_feedback(pieces, 20, at_once=1)
    assert mean(network) > mean(FeedbackRefiner()) + 0.05


def test_a_training_that_was_interrupted_ends_with_the_same_bits(pieces, tmp_path, monkeypatch):
    whole = train_feedback(pieces, 4, at_once=1, output=tmp_path / "whole.safetensors")
    settings = FeedbackTrainingSettings(
        **{**vars(feedback_training.TRAINING), "save_interval": 0.0}
    )
    monkeypatch.setattr(feedback_training, "TRAINING", settings)
    monkeypatch.setattr(feedback_training.FeedbackTrainingSettings, "__repr__", lambda self: "same")
    output = tmp_path / "parts.safetensors"

    def interrupt(share: float) -> None:
        if share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_feedback(pieces, 4, at_once=1, output=output, progress=interrupt)
    shares: list[float] = []
    parts = train_feedback(pieces, 4, at_once=1, output=output, progress=shares.append)
    assert shares == [0.75, 1.0]
    for name, value in whole.state_dict().items():
        assert torch.equal(parts.state_dict()[name], value), name
    assert read_feedback_refiner(output).most_steps == 8
    with pytest.raises(DataError, match="another training"):
        train_feedback(pieces, 5, at_once=1, output=output)


def test_the_gradient_of_a_repair_of_one_step_is_exact(pieces, monkeypatch):
    monkeypatch.setattr(
        feedback_training,
        "TRAINING",
        FeedbackTrainingSettings(
            **{**vars(feedback_training.TRAINING), "row_share": 1.0, "least_error": 0.0}
        ),
    )
    piece = pieces[0]
    network = FeedbackRefiner()
    views = [(index, 0) for index in range(SMALL.held_out)]

    def psnr() -> float:
        return measured_loss(roll_out(network, piece, 1, "same"), piece, views)[0]

    kept = Kept([], [], [])
    last = roll_out(network, piece, 1, "same", kept=kept)
    kept.loss(network, measured_loss(last, piece, views)[1], 1.0).backward()
    bias = network.mlp[-1].bias
    for kind in range(len(PARAMETERS)):
        found = []
        for change in (0.05, -0.05):
            with torch.no_grad():
                bias[kind] = change
            found.append(psnr())
        with torch.no_grad():
            bias[kind] = 0.0
        slope = -(found[0] - found[1]) / 0.1  # of the loss
        # renders are float32, and the slope is a secant over a tenth
        assert float(bias.grad[kind]) == pytest.approx(slope, rel=0.05, abs=0.02)


def test_means_move_as_in_the_whole_scene(pieces):
    piece = pieces[0]
    further = Piece(**{**_fields(piece), "reach": 2 * piece.reach})

    def moved(piece: Piece) -> torch.Tensor:
        return roll_out(FeedbackRefiner(), piece, 1, 0).means - piece.merged.means

    torch.testing.assert_close(moved(further), 2 * moved(piece), rtol=1e-3, atol=1e-6)


def _fields(piece: Piece) -> dict[str, object]:
    return {name: value for name, value in vars(piece).items() if not name.startswith("_")}


def test_pieces_are_made_once_and_read_again(hollow_ball, folder, pieces, monkeypatch):
    def never(*args: object) -> Piece:
        raise AssertionError("made again")

    monkeypatch.setattr(feedback_pieces, "_made", never)
    again = [*pieces_of("ball", hollow_ball, [0.1, 0.2], 2, folder)]
    assert [piece.name for piece in again] == ["ball, piece 0", "ball, piece 1"]
    for old, new in zip(pieces, again, strict=True):
        assert 10 <= len(old.merged) <= SMALL.merged
        for name, value in _fields(old).items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(_fields(new)[name], value), name
            elif isinstance(value, Gaussians):
                same = zip(_fields(new)[name].tensors(), value.tensors(), strict=True)
                assert all(torch.equal(a, b) for a, b in same), name
            else:
                assert _fields(new)[name] == value, name


def test_pieces_of_another_seed_and_damaged_ones_are_made_anew(hollow_ball, folder, pieces):
    path = folder / "ball_0.safetensors"
    before = path.read_bytes()
    path.write_bytes(before[: len(before) // 2])
    (piece,) = pieces_of("ball", hollow_ball, [0.1], 1, folder, seed=5)
    assert path.read_bytes() != before and piece.psnr > 0


def test_a_piece_that_is_too_small_is_left_out_with_one_line(hollow_ball, tmp_path, capsys):
    assert not [*pieces_of("ball", hollow_ball[:40], [0.1], 1, tmp_path)]
    assert capsys.readouterr().out == (
        "ball, piece 0: left out (4 merged Gaussians; expected at least 10)\n"
    )
    with pytest.raises(DataError, match="no piece"):
        train_feedback([], 1)


def test_members_are_counted_and_measured(hollow_ball):
    dense = hollow_ball[:6]
    merged = hollow_ball[:2]
    features = member_features(dense, merged, torch.tensor([0, 0, 0, 1, -1, 0]))
    assert features.shape == (2, MEMBERS)
    assert features[:, 0].exp().square().tolist() == pytest.approx([4, 1])
    alphas = dense.alphas.view(-1)[[0, 1, 2, 5]]
    assert float(features[0, 3]) == pytest.approx(float(alphas.std(unbiased=False)), abs=1e-5)
    assert features[1, 3:].tolist() == pytest.approx([0, 0], abs=1e-3)


def test_neighbours_and_members_follow_the_own_features(pieces):
    piece = pieces[0]
    features = torch.randn(len(piece.merged), FeedbackRefiner.FEATURES)
    inputs = all_inputs(piece)(features)
    columns = COLUMNS["own and neighbours"][FeedbackRefiner.FEATURES :]
    apart = torch.cdist(piece.merged.means.double(), piece.merged.means.double())
    nearest = apart.argsort(1)[:, 1 : NEIGHBOURS + 1]
    torch.testing.assert_close(inputs[:, columns], features[nearest].mean(1))
    columns = COLUMNS["own and members"]
    torch.testing.assert_close(inputs[:, columns], torch.cat([features, piece.members], dim=1))


def test_the_command_makes_a_network_and_goes_on_where_it_was(hollow_ball, tmp_path, capsys):
    write_ply(hollow_ball, tmp_path / "ball.ply")
    output = tmp_path / "net.safetensors"
    options = dict(keep=(0.2,), pieces=1, updates=2, at_once=1)
    make_feedback.main([tmp_path / "ball.ply"], output, **options)
    assert "1 pieces of 1 scenes" in capsys.readouterr().out
    written = output.read_bytes()
    make_feedback.main([tmp_path / "ball.ply"], output, **options)
    assert output.read_bytes() == written
    assert (tmp_path / "net_pieces" / "ball_0.safetensors").exists()
    with pytest.raises(DataError, match="--pieces 0"):
        make_feedback.main([tmp_path / "ball.ply"], output, pieces=0)
    assert json.loads(_metadata(output)["metadata"])["updates"] == 2


def _metadata(path: Path) -> dict[str, str]:
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        return file.metadata()


def test_the_study_of_inputs_measures_each_in_pieces_that_it_did_not_learn_from(
    hollow_ball, tmp_path, monkeypatch
):
    for name in ("seen", "unseen"):
        write_ply(hollow_ball, tmp_path / f"{name}.ply")
    monkeypatch.setattr(feedback_study, "PIECES", SMALL)
    paths = [tmp_path / "seen.ply"], (tmp_path / "unseen.ply",)
    options = dict(keep=(0.2,), pieces=1, unseen_pieces=1, steps=4, folder=tmp_path)
    feedback_study.main(*paths, **options, json_path=tmp_path / "study.json")
    content = json.loads((tmp_path / "study.json").read_text())
    assert [row["inputs"] for row in content["rows"]] == [*COLUMNS]
    for row in content["rows"]:
        assert [*row["gains"]] == ["unseen, piece 0"]
        # a piece like the one that it learned from: the direction points up
        assert row["first_order"] > 0
