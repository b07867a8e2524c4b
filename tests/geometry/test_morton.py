"""The space-filling curve, and the cells of its grid."""

import torch

from pointsplat_ns.geometry.transforms import curve_keys, unit_cells


def test_the_curve_interleaves_the_bits_of_the_grid():
    generator = torch.Generator().manual_seed(1)
    cells = torch.rand(200, 3, generator=generator)
    grid = (cells * (2**20 - 1)).long().tolist()
    wanted = [
        sum(((value >> bit) & 1) << (3 * bit + 2 - axis) for bit in range(20) for axis, value in enumerate(point))
        for point in grid
    ]
    assert curve_keys(cells).tolist() == wanted


def test_cells_hold_what_is_near_and_clamp_what_is_far():
    generator = torch.Generator().manual_seed(2)
    means = torch.randn(5000, 3, generator=generator)
    means[7] = 1e30
    cells = unit_cells(means)
    assert cells.min() >= 0 and cells.max() <= 1 and cells[7].tolist() == [1.0, 1.0, 1.0]
    assert (cells.std(dim=0) > 0.05).all()  # one outlier has not squeezed the others together
