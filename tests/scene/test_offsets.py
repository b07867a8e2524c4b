"""Scenes far from the origin: doubles keep their digits beside an offset, which files, poses and
turns carry."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from compressed_plys import encode_compressed_ply
from plys import columns_of, write_columns

import pointsplat_ns as ps
from making import ball, cloud, same_bits
from pointsplat_ns.pipeline.photos.posed_scene import read_scene_and_cameras
from pointsplat_ns.scene.offsets import offset_for
from posing import inria, written

pytestmark = pytest.mark.usefixtures("quick")

UTM = (451_234.6, 5_412_345.7, 312.4)


def with_doubles(scene, path, origin=UTM, order="<", text=False, comments=()):
    """Write a PLY whose x, y and z are doubles about an origin, and return them, float64."""
    means = scene.means.double().numpy() + np.array(origin)
    write_columns(
        path, columns_of(scene) | dict(zip("xyz", means.T, strict=True)), text, order, comments
    )
    return means


def absolute(scene):
    """Positions in the frame of the file, float64."""
    return scene.means.double().numpy() + np.array(scene.offset or (0, 0, 0))


@pytest.mark.parametrize(("order", "text"), [("<", False), (">", False), ("<", True)])
def test_doubles_keep_their_digits_beside_an_offset(tmp_path, caplog, order, text):
    scene = cloud(300)
    means = with_doubles(scene, tmp_path / "a.ply", order=order, text=text)
    with caplog.at_level(logging.INFO):
        back = ps.load(tmp_path / "a.ply")
    assert np.abs(absolute(back) - means).max() < 1e-6  # half a unit in float32
    assert all(abs(a - b) < 2 for a, b in zip(back.offset, UTM, strict=True))
    assert caplog.text.count("positions are doubles; their offset") == 1
    assert torch.equal(back.features_dc, scene.features_dc)
    with_doubles(scene, tmp_path / "a.ply", order=order, text=text, comments=["Offset: 100 20 3"])
    assert np.abs(absolute(ps.load(tmp_path / "a.ply")) - means - (100, 20, 3)).max() < 1e-6


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_files_carry_the_offset(tmp_path, suffix, caplog):
    scene = cloud(300).replace(offset=UTM)
    if suffix == ".ply":
        ps.save(scene, tmp_path / f"a{suffix}")
    else:
        (tmp_path / f"a{suffix}").write_bytes(encode_compressed_ply(scene))
    back = ps.load(tmp_path / f"a{suffix}")
    assert back.offset == UTM and not caplog.records
    assert float(back.means.min()) > -0.1 and float(back.means.max()) < 1.1
    if suffix == ".ply":
        assert same_bits(back, scene)


@pytest.mark.parametrize("suffix", [".spz", ".sog", ".splat"])
def test_files_that_cannot_carry_the_offset_say_so(tmp_path, suffix, caplog):
    ps.save(
        cloud(300, sh_degree=0).replace(offset=UTM, features_dc=torch.zeros(300, 3)),
        tmp_path / f"a{suffix}",
    )
    assert caplog.text.count("the position offset 451234.6 5412345.7 312.4; .ply keeps it") == 1


@pytest.mark.parametrize("text", ["1 2", "1 2 nan", "1 2 inf", "a b c", "1e300 0 0", ""])
def test_a_comment_that_is_no_offset_is_named_and_left_out(tmp_path, caplog, text):
    ps.save(cloud(5).replace(offset=UTM), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes().replace(b"451234.6 5412345.7 312.4", text.encode())
    (tmp_path / "a.ply").write_bytes(data)
    assert ps.load(tmp_path / "a.ply").offset is None
    assert "no offset of three numbers" in caplog.text or not text


def test_float32_that_has_lost_its_digits_is_warned_of(tmp_path, caplog):
    scene = cloud(50)
    ps.save(scene.replace(means=scene.means + 5e6), tmp_path / "a.ply")
    ps.load(tmp_path / "a.ply")
    assert "positions have lost precision" in caplog.text
    caplog.clear()
    ps.save(scene.replace(means=scene.means + 100), tmp_path / "a.ply", overwrite=True)
    ps.load(tmp_path / "a.ply")
    assert not caplog.records


def test_turned_and_scaled_scenes_turn_and_scale_their_offset():
    scene = cloud(40).replace(offset=UTM)
    moved = ps.place(scene, up="z:y", scale=2.0)
    x, y, z = absolute(scene).T
    assert np.allclose(absolute(moved), 2 * np.stack([x, z, -y], axis=1), rtol=0, atol=1e-5)


def test_scenes_of_different_offsets_are_joined_in_the_frame_of_the_first():
    one = cloud(10).replace(offset=UTM)
    other = cloud(10, 1).replace(offset=(451_230.0, 5_412_340.0, 310.0))
    both = ps.Gaussians.cat([one, other])
    assert both.offset == UTM
    assert np.allclose(
        absolute(both), np.concatenate([absolute(one), absolute(other)]), rtol=0, atol=1e-6
    )


def test_poses_of_a_file_are_in_the_frame_of_the_scene_s_file(tmp_path):
    scene = ball(400)
    with_doubles(scene, tmp_path / "a.ply")
    views = ps.sample_views(scene, 3, width=96, height=64)
    there = replace(views, viewmats=views.viewmats.double()).relative_to(
        tuple(-value for value in UTM)
    )
    written(inria(there), tmp_path / "cameras.json")
    dense, given, _ = read_scene_and_cameras(tmp_path / "a.ply", tmp_path / "cameras.json")
    with torch.no_grad():
        assert float(ps.psnr(ps.render(dense, given), ps.render(scene, views)).mean()) > 50


@pytest.mark.parametrize("extent", [0.0, 1e-300, 1e-3, 50.0, 1e9])
def test_offsets_of_any_extent_leave_small_positions(extent):
    means = np.array(UTM) + extent * np.linspace(-1, 1, 11)[:, None]
    offset = offset_for(means, np.full((11, 3), -30.0))
    assert np.abs(means - offset).max() <= 3 * extent + 1e-9
    assert offset_for(np.full((3, 3), np.nan), np.zeros((3, 3))) is None
