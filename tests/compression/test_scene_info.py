"""What is said of a scene."""

import json
import math

import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.io.formats import format_to_write


def test_rows_that_look_wrong_are_counted():
    scene = cloud(100, 0, 2)
    scene.means[0, 0] = math.nan
    scene.scales[1, 0] = math.inf
    scene.quats[2] = 0
    scene.opacities[3] = math.inf
    scene.opacities[4] = -20.0
    for value in scene.tensors():
        value[5:7] = value[7]
    assert ps.info(scene).suspicious == {
        "NaN": 1,
        "infinite": 1,
        "opacity of exactly 0 or 1": 1,
        "too faint to be drawn": 1,
        "zero quaternion": 1,
        "exact copy of another": 2,
    }
    assert ps.info(cloud(50).replace(opacities=torch.zeros(50, 1))).suspicious == {}


def test_rows_of_a_file_that_cannot_be_drawn_are_counted_too(tmp_path):
    write_ply(cloud(10, 0, 0), tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    data[-17 * 4 : -16 * 4] = b"\xff\xff\xff\x7f"  # NaN, as the x of the last
    (tmp_path / "a.ply").write_bytes(data)
    found = ps.info(tmp_path / "a.ply")
    assert found.gaussians == 10 and found.suspicious == {"NaN": 1}
    assert len(ps.load(tmp_path / "a.ply")) == 9


def test_histograms_hold_everyone_and_bounds_hold_the_positions():
    scene = cloud(500)
    found = ps.info(scene)
    assert sum(found.opacities) == sum(found.sizes.values()) == 500 and len(found.opacities) == 10
    assert found.opacities[0] == int((scene.alphas < 0.1).sum())
    assert found.sizes["1e-02"] == int(((scene.stds.amax(1) >= 0.01) & (scene.stds.amax(1) < 0.1)).sum())
    assert torch.allclose(torch.tensor(found.bounds), torch.stack([scene.means.amin(0), scene.means.amax(0)]))
    low, high = torch.tensor(found.content).unbind()
    # 4 % along each of three axes
    assert 430 <= int(((scene.means >= low) & (scene.means <= high)).all(1).sum()) < 500


def test_sizes_of_files_are_those_of_files(tmp_path):
    scene = cloud(300)
    found = ps.info(scene)
    for suffix, sizes in found.file_bytes.items():
        path = tmp_path / f"a{suffix}"
        format_to_write(path).write(scene, path, lambda what, share: None)
        assert path.stat().st_size == sizes["100%"], suffix  # so small a scene is encoded whole


def test_a_scene_of_nothing_has_no_bounds():
    found = ps.info(Gaussians.empty(1))
    assert found.gaussians == 0 and found.bounds == [] and found.sizes == {}
    json.dumps(found.as_dict())


def test_a_scene_too_large_for_spz_has_no_size_in_it():
    scene = cloud(10)
    scene.means[0] = 1e9
    assert ".spz" not in ps.info(scene).file_bytes and ".ply" in ps.info(scene).file_bytes
