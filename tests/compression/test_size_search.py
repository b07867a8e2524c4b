"""Budgets in bytes of compressed files."""

import pytest

from making import cloud
from pointsplat_ns.compression.budget_search import FileLimit, largest_within
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.requests import PruneRequest
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.formats import Format, format_to_write
from pointsplat_ns.io.formats.rounding import Rounding
from pointsplat_ns.io.formats.spz import encode_spz


def search(full, limit, encode=encode_spz):
    limit = FileLimit(Format("SPZ", ".spz", encode=encode), limit)
    return largest_within(full, lambda count: full[:count], limit, lambda share: None)


def test_the_file_fits_and_is_not_much_smaller():
    full = cloud(4000)
    for limit in (5000, 20_000, 60_000):
        found = search(full, limit)
        size = found.tried[len(found.scene)]
        assert 0.95 * limit <= size <= limit
        assert size == len(encode_spz(found.scene))


def test_all_are_kept_if_all_fit():
    full = cloud(100)
    found = search(full, 10**6)
    assert found.scene is full and list(found.tried) == [100]


def test_a_budget_for_less_than_one_gaussian_is_refused():
    with pytest.raises(BudgetError, match="too small for one Gaussian; expected at least"):
        search(cloud(100), 10)


def test_a_size_that_jumps_ends_the_search_with_what_fits():
    # Beyond 50 Gaussians the file is ten times as large.
    found = search(cloud(100), 600, lambda scene, _: bytes(10 * len(scene) * (10 if len(scene) > 50 else 1)))
    assert found.tried[len(found.scene)] <= 600 and 1 <= len(found.scene) <= 50


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".compressed.ply", ".splat", ".glb", ".ply"])
def test_prune_counts_bytes_of_the_format_that_is_named(tmp_path, suffix):
    scene = cloud(2000)
    small = prune_scene(scene, PruneRequest(f"0.02MB{suffix}", "opacity")).scene
    path = tmp_path / f"a{suffix}"
    format_to_write(path).write(small, path, lambda what, share: None)
    assert path.stat().st_size <= 20_000
    assert len(small) < 2000 or suffix == ".sog"


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_a_size_rounds_as_far_as_the_scene_has_errors_already(suffix):
    full, limit = cloud(4000), FileLimit(format_to_write(suffix), 40_000)
    found = {
        psnr: largest_within(full, lambda count: full[:count], limit, lambda share: None, lambda scene, psnr=psnr: psnr)
        for psnr in (25.0, 35.0)
    }
    assert found[25.0].limit.rounding.tolerance == pytest.approx(10**0.5 * found[35.0].limit.rounding.tolerance)
    assert len(found[25.0].scene) > 1.1 * len(found[35.0].scene)
    for one in found.values():
        small = one.limit.rounded(one.scene)
        assert (
            len(small) == len(one.scene) and 0.9 * 40_000 < one.limit.bytes_of(small) == one.tried[len(small)] <= 40_000
        )


def test_a_scene_is_rounded_further_if_it_is_too_large_and_less_if_there_is_room():
    scene, kind, usual = cloud(2000), format_to_write(".spz"), Rounding(0.002)
    size = FileLimit(kind, 10**9).bytes_of(kind.rounded(scene, usual))
    for most in (int(0.9 * size), size, int(1.05 * size)):
        found = FileLimit(kind, most, usual).bytes_of(FileLimit(kind, most, usual).rounded(scene))
        assert 0.8 * most < found <= most
    roomy = FileLimit(kind, int(1.5 * size), usual)
    assert size < roomy.bytes_of(roomy.rounded(scene)) <= roomy.most


def test_all_are_kept_unrounded_if_all_fit():
    full, limit = cloud(500), FileLimit(format_to_write(".sog"), 10**6)
    found = largest_within(full, lambda count: full[:count], limit, lambda share: None)
    assert found.scene is full and found.limit.rounded(full) is full
    larger = cloud(3000, seed=1)  # as a repair may make one
    tight = FileLimit(found.limit.kind, found.limit.bytes_of(larger) * 4 // 5)
    assert tight.bytes_of(tight.rounded(larger)) <= tight.most
