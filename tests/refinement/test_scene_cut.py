"""Cutting scenes into pieces by planes."""

import pytest
import torch

from pointsplat_ns.refinement.scene_cut import cut_scene


def points(n: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("n", [1, 7, 100, 1000])
@pytest.mark.parametrize("most", [1, 8, 100])
def test_each_position_is_in_one_piece_of_at_most_so_many(n, most):
    means = points(n)
    cut = cut_scene(means, most)
    sizes = cut.pieces_of(means).bincount(minlength=cut.count)
    assert len(sizes) == cut.count and int(sizes.sum()) == n
    assert 1 <= int(sizes.min()) and int(sizes.max()) <= most


def test_pieces_are_divided_by_planes():
    """Positions that were not cut lie in pieces, too: midway between two of a piece, in it."""
    means = points(500)
    cut = cut_scene(means, 50)
    pieces = cut.pieces_of(means)
    for number in range(cut.count):
        inside = means[pieces == number]
        middle = (inside + inside.roll(1, 0)) / 2
        assert (cut.pieces_of(middle) == number).all()


def test_another_seed_cuts_otherwise():
    means = points(500)
    one, two, again = (cut_scene(means, 100, seed).pieces_of(means) for seed in (0, 1, 0))
    assert torch.equal(one, again) and not torch.equal(one, two)


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_coincident_positions_stay_together(share):
    means = points(100)
    means[: int(100 * share)] = means[0]
    cut = cut_scene(means, 10)
    pieces = cut.pieces_of(means)
    assert len(pieces[: int(100 * share)].unique()) == 1
    assert (pieces.bincount(minlength=cut.count) >= 1).all()


def test_far_positions_and_flat_scenes_are_cut():
    flat = points(200) * torch.tensor([1.0, 1.0, 0.0])
    far = points(200)
    far[3] = 1e30
    for means in (flat, far):
        cut = cut_scene(means, 20)
        assert int(cut.pieces_of(means).bincount().max()) <= 20
