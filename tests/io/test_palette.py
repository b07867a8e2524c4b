"""Codebooks and palettes of SOG files."""

import pytest
import torch

from pointsplat_ns.io.formats.palette import codebook, palette, palette_size


def rows_of(n, dims, seed=0):
    """Rows about 300 centres, as real SH are about few."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.randn(300, dims, generator=generator)
    return centres[torch.randint(300, (n,), generator=generator)] + 0.01 * torch.randn(n, dims, generator=generator)


@pytest.mark.parametrize("values", [torch.zeros(5), torch.tensor([1.0]), torch.linspace(-3, 3, 256)])
def test_a_codebook_of_few_numbers_is_exact(values):
    book, index = codebook(values)
    assert book.shape == (256,) and index.dtype == torch.uint8
    assert torch.allclose(book[index.long()], values, atol=1e-6)


def test_a_codebook_is_ascending_and_better_than_even_steps():
    values = torch.randn(20_000, generator=torch.Generator().manual_seed(1))
    book, index = codebook(values)
    assert bool((book.diff() >= 0).all())
    even = torch.linspace(float(values.min()), float(values.max()), 256)
    error = (book[index.long()] - values).square().mean()
    assert error < (values[:, None] - even).abs().amin(dim=1).square().mean()
    assert float((book[index.long()] - values).abs().max()) <= float(book.diff().max())


def test_the_palette_grows_with_the_scene_up_to_what_an_index_reaches():
    sizes = [palette_size(n) for n in (0, 1, 1024, 2047, 2048, 100_000, 10**7)]
    assert sizes == [1024, 1024, 1024, 1024, 2048, 65_536, 65_536]


def test_few_rows_are_kept_as_they_are():
    rows = rows_of(500, 9)
    book, index = palette(rows, lambda share: None)
    assert len(book) == 512 and torch.equal(book[index], rows)


def test_many_rows_are_stood_for_by_near_ones():
    rows = rows_of(5000, 9)
    shares = []
    book, index = palette(rows, shares.append)
    assert len(book) == 4096 and shares[-1] == 1.0
    # Each centre holds about 17 rows and has about 14 entries: nearly every row one of its own.
    assert float((book[index] - rows).square().mean()) < 0.5 * 0.01**2


def test_equal_rows_need_one_entry():
    book, index = palette(torch.ones(3000, 9), lambda share: None)
    assert torch.equal(book[index], torch.ones(3000, 9))
