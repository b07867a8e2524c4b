"""Ways of a table."""

import pytest

import pointsplat_ns as ps
from lab.common.ways import SplatTransform
from making import box_room
from peers import peer


def test_each_mode_makes_a_smaller_scene(tmp_path):
    found = SplatTransform(peer(tmp_path, "3.7.0"))
    assert (found.version, found.missing) == ("3.7.0", "")
    ps.save(box_room(0, 60), tmp_path / "room.ply")
    before = sorted(tmp_path.iterdir())
    small = [mode.reduce(tmp_path / "room.ply", 20) for mode in found.modes]
    assert [len(scene) for scene, _ in small] == [20, 20] and small[0][1].seconds > 0
    assert not (small[0][0].means == small[1][0].means).all()
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "says, version, modes",
    [
        ("splat-transform v2.7.1", "2.7.1", 1),
        ("v10.0.0-beta.1", "10.0.0-beta.1", 2),
        ("warning: old\nv3.0.0", "3.0.0", 2),
    ],
)
def test_versions_are_told_apart(says, version, modes, tmp_path):
    found = SplatTransform(peer(tmp_path, "3.7.0", says))
    assert found.version == version and len(found.modes) == modes
