"""Compiled kernels find the tiles that torch finds."""

import pytest
import torch

from making import assert_same_on_any_threads
from pointsplat_ns.rasterizer import ellipses as in_torch
from pointsplat_ns.rasterizer.compiled import tiles as compiled_tiles
from pointsplat_ns.rasterizer.ellipses import Region
from pointsplat_ns.rasterizer.tiles import Footprints

missing = compiled_tiles.KERNELS.why_missing
needs_compiler = pytest.mark.skipif(bool(missing), reason=missing)

WIDTH, HEIGHT = 203, 149


def given(count=6000, cameras=2, seed=1):
    """Gaussians in and around images, from points to needles and some larger than an image, some too faint to draw."""
    g = torch.Generator().manual_seed(seed)
    means2d = torch.rand(count, 2, generator=g) * 400 - 100
    spread = 10.0 ** (4 * torch.rand(count, 2, generator=g) - 1)
    share = (2 * torch.rand(count, generator=g) - 1) * 0.999
    xx, yy = spread.unbind(-1)
    cov2d = torch.stack([xx, share * (xx * yy).sqrt(), yy], -1)
    det = xx * yy * (1 - share * share)
    opacities = torch.rand(count, generator=g) ** 4
    depths, camera_ids = torch.randn(count, generator=g).abs(), torch.randint(cameras, (count,), generator=g)
    return means2d, cov2d, det, opacities, depths, camera_ids, cameras, WIDTH, HEIGHT


REGIONS = (Region(0, 19, 0, 26), Region(3, 4, 0, 26), Region(5, 6, 7, 8), Region(18, 19, 25, 26))


@needs_compiler
@pytest.mark.parametrize("cameras", [1, 2])
def test_pairs_are_those_of_torch(cameras):
    ours, torchs = (Footprints(*given(cameras=cameras), engine=engine) for engine in (compiled_tiles, in_torch))
    assert ours.whole == torchs.whole == REGIONS[0]
    assert ours.regions(5000) == torchs.regions(5000) and len(ours.regions(5000)) > 3
    for region in REGIONS:
        mine, theirs = ours.tiles(region), torchs.tiles(region)
        assert len(theirs.gaussians) > 0
        for name in ("gaussians", "offsets", "places", "counts", "order"):
            assert torch.equal(getattr(mine, name), getattr(theirs, name)), (region, name)


@needs_compiler
def test_nothing_gives_no_pair_and_any_number_of_threads_the_same_bits():
    empty = Footprints(*(v[:0] if isinstance(v, torch.Tensor) else v for v in given()), engine=compiled_tiles)
    tiles = empty.tiles(empty.whole)
    assert len(tiles.gaussians) == len(tiles.counts) == 0 and not tiles.offsets.any()

    def found():
        footprints = Footprints(*given(20_000), engine=compiled_tiles)
        return footprints._ellipses.shapes, footprints.tiles(footprints.whole).gaussians

    assert_same_on_any_threads(found)
