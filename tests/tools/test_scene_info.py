"""What is told of a scene."""

import math

import pytest
import torch
from compressed_plys import encode_compressed_ply
from foreign import write_sog_folder

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.view_sampling.upright import up_named

pytestmark = pytest.mark.usefixtures("quick")


def test_rows_that_look_wrong_are_counted():
    scene = cloud(100, 0, 2)
    scene.means[0, 0] = math.nan
    scene.scales[1, 0] = math.inf
    scene.quats[2] = 0
    scene.opacities[3] = math.inf
    scene.opacities[4] = -20.0
    kinds = (
        "NaN",
        "infinite",
        "opacity of exactly 0 or 1",
        "too faint to be drawn",
        "zero quaternion",
    )
    assert ps.info(scene).suspicious == dict.fromkeys(kinds, 1)
    assert ps.info(cloud(50).replace(opacities=torch.zeros(50, 1))).suspicious == {}


def test_rows_of_a_file_that_cannot_be_drawn_are_counted_too(tmp_path):
    write_ply(cloud(10, 0, 0), tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    data[-17 * 4 : -16 * 4] = b"\xff\xff\xff\x7f"  # NaN, as the x of the last
    (tmp_path / "a.ply").write_bytes(data)
    found = ps.info(tmp_path / "a.ply")
    assert found.gaussians == 10 and found.suspicious == {"NaN": 1}
    assert len(ps.load(tmp_path / "a.ply")) == 9


def test_the_file_its_format_and_its_size_are_named(tmp_path):
    scene = cloud(300)
    for suffix, name in {
        ".ply": "3DGS PLY",
        ".spz": "SPZ",
        ".sog": "SOG",
        ".splat": "splat",
    }.items():
        path = tmp_path / f"a{suffix}"
        ps.save(scene, path)
        found = ps.info(path)
        assert (found.file, found.format, found.bytes) == (str(path), name, path.stat().st_size)
    (tmp_path / "named.ply").write_bytes(encode_compressed_ply(scene))
    assert ps.info(tmp_path / "named.ply").format == "compressed PLY"
    write_sog_folder(scene, tmp_path / "folder")
    found = ps.info(tmp_path / "folder")
    parts = sum(part.stat().st_size for part in (tmp_path / "folder").iterdir())
    assert (found.format, found.bytes) == ("SOG folder", parts)
    assert (ps.info(scene).file, ps.info(scene).format, ps.info(scene).bytes) == ("", "", 0)


def test_up_is_named_or_estimated_and_fill_is_that_of_the_views():
    scene = ps.example_room()[::100]
    view = {"resolution": "64x48"}
    found = ps.info(scene, **view)
    named = ps.info(scene, up="-y", **view)
    assert found.up_text.startswith("z") and found.up == [0, 0, 1]
    assert named.up_text == "-y" and not named.up_is_guess
    views = ViewProvider(scene, resolution=(64, 48), up=up_named("-y")).views(12)
    assert named.fill == pytest.approx(fill(scene, views)) and named.fill != pytest.approx(
        found.fill
    )
    assert named.views == f"{len(views)} views of 64 x 48 pixels"
