"""The same again, on one thread and on several: the same selection, the same repair and the same
bytes."""

import pytest

import pointsplat_ns as ps
from making import box_room, same_bits
from pointsplat_ns.pipeline.repair import repair
from pointsplat_ns.pipeline.repair_budget import STEPS, RepairBudget
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning.methods import METHODS
from pointsplat_ns.system.kernels import KERNELS
from pointsplat_ns.system.threads import fixed_threads

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def room():
    return box_room(0, count=1500, size=0.1)  # too few for merging to choose its finish by renders


@pytest.fixture(scope="module")
def looks(room):
    return ps.sample_views(room, 2, width=32, height=24)


@pytest.mark.parametrize("by", METHODS)
def test_a_scene_is_made_small_to_the_same_bits_on_one_thread_and_on_two(by, room, looks):
    views = looks if METHODS[by].needs_views else None
    first = ps.prune(room, 0.3, by=by, views=views)
    assert same_bits(first, ps.prune(room, 0.3, by=by, views=views))
    with fixed_threads(2):
        assert same_bits(first, ps.prune(room, 0.3, by=by, views=views))


@pytest.mark.skipif(
    bool(KERNELS.why_missing), reason="without kernels, threads add up gradients in another order"
)
def test_a_repair_has_the_same_bits_on_any_number_of_threads(room, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 8)
    small = ps.prune(room, 0.3)
    source = ViewProvider(room, given=ps.sample_views(room, 24, 64, 48))
    found = []
    for count in (1, 2, 3):
        with fixed_threads(count):
            found.append(repair(small, room, source, RepairBudget("quick")).scene)
    assert not same_bits(small, found[0]) and all(same_bits(found[0], each) for each in found[1:])


@pytest.mark.parametrize("suffix", ("ply", "spz", "sog", "splat"))
def test_a_file_has_the_same_bytes_again_on_one_thread_and_on_two(suffix, room, tmp_path):
    written = []
    for number, count in enumerate((1, 1, 2)):
        folder = tmp_path / str(number)  # a format may hold the name of its file
        folder.mkdir()
        with fixed_threads(count):
            ps.save(room, folder / f"room.{suffix}")
        written.append((folder / f"room.{suffix}").read_bytes())
    assert written[0] == written[1] == written[2] and len(written[0]) > 10_000
