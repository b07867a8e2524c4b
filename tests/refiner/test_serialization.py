import itertools

import pytest
import torch

from pointsplat_ns.refiner.serialization import curve_codes

CURVES = ("z", "z-trans", "hilbert", "hilbert-trans")


def full_grid(side: int) -> torch.Tensor:
    return torch.tensor(list(itertools.product(range(side), repeat=3)))


@pytest.mark.parametrize("curve", ["hilbert", "hilbert-trans"])
@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_consecutive_cells_of_the_hilbert_curve_share_a_face(curve, bits):
    cells = full_grid(2**bits)
    walk = cells[curve_codes(cells, bits, [curve])[0].argsort()]
    assert ((walk[1:] - walk[:-1]).abs().sum(dim=1) == 1).all()


@pytest.mark.parametrize("bits", [16, 20])
def test_z_order_equals_python_interleaving_at_full_width(bits):
    generator = torch.Generator().manual_seed(0)
    coords = torch.randint(0, 2**bits, (50, 3), generator=generator)
    expected = [
        sum(((int(c) >> b) & 1) << (3 * b + 2 - a) for b in range(bits) for a, c in enumerate(row)) for row in coords
    ]
    assert curve_codes(coords, bits, ["z"])[0].tolist() == expected


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("drop", [1, 5, 15])
def test_coarse_cells_are_prefixes_so_that_one_sort_serves_all_grids(curve, drop):
    generator = torch.Generator().manual_seed(1)
    coords = torch.randint(0, 2**16, (4000, 3), generator=generator)
    coarse = curve_codes(coords, 16, [curve])[0] >> 3 * drop
    # Equal cells must have equal prefixes and different cells different ones.
    cells = torch.unique(coords >> drop, dim=0, return_inverse=True)[1]
    pairs = torch.unique(torch.stack([coarse, cells], dim=1), dim=0)
    assert len(pairs) == len(pairs[:, 0].unique()) == len(pairs[:, 1].unique())


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_trans_exchanges_x_and_y(curve):
    coords = full_grid(8)
    turned, plain = (curve_codes(coords, 3, [name])[0] for name in (f"{curve}-trans", curve))
    assert torch.equal(turned, curve_codes(coords[:, [1, 0, 2]], 3, [curve])[0]) and not torch.equal(turned, plain)


def test_unknown_curves_and_widths_are_refused():
    with pytest.raises(ValueError, match="no curve 'peano'"):
        curve_codes(full_grid(2), 1, ["peano"])
    with pytest.raises(ValueError, match="21 bits"):
        curve_codes(full_grid(2), 21, ["z"])


def test_empty_input_gives_no_codes():
    assert curve_codes(torch.empty(0, 3, dtype=torch.long), 16, ["hilbert"])[0].shape == (0,)


def skilling(point: list[int], bits: int) -> int:
    """Hilbert code of one point, bit by bit, as published."""
    axes = list(point)
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for i in range(3):
            if axes[i] >> bit & 1:
                axes[0] ^= low
            else:
                swapped = (axes[0] ^ axes[i]) & low
                axes[0] ^= swapped
                axes[i] ^= swapped
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    parity = 0
    for bit in range(bits - 1, 0, -1):
        if axes[2] >> bit & 1:
            parity ^= (1 << bit) - 1
    return sum(((axis ^ parity) >> b & 1) << (3 * b + 2 - i) for i, axis in enumerate(axes) for b in range(bits))


@pytest.mark.parametrize("bits", [1, 2, 5, 16, 19, 20])
def test_hilbert_tables_give_the_codes_of_the_published_algorithm(bits):
    coords = torch.randint(0, 2**bits, (200, 3), generator=torch.Generator().manual_seed(2))
    assert curve_codes(coords, bits, ["hilbert"])[0].tolist() == [skilling(point, bits) for point in coords.tolist()]
