"""Scene files of every format: what comes back, that the order is known, and that sizes are as said."""

import logging
import struct

import numpy as np
import pytest
from foreign import encode_spz4, write_sog_folder
from plys import columns_of, write_columns

import pointsplat_ns as ps
from making import SHARED_DATA, cloud, normal_scene, same_bits
from pointsplat_ns.io.formats import format_named, format_to_read
from pointsplat_ns.io.formats.spz import encode_spz

FIXED = (".ply", ".splat")

SPLATS = SHARED_DATA / "splats"


@pytest.mark.parametrize("suffix", FIXED)
def test_the_size_of_a_file_is_known_to_the_byte(tmp_path, suffix):
    bytes_of = format_named(suffix).bytes_of
    for n, degree in ((0, 0), (1, 3), (255, 1), (256, 2), (257, 0), (1001, 3)):
        ps.save(normal_scene(n, degree), tmp_path / f"a{suffix}", overwrite=True)
        assert (tmp_path / f"a{suffix}").stat().st_size == bytes_of(n, degree)
    scene = normal_scene(9, 0).replace(antialiased=True, up="-y")
    ps.save(scene, tmp_path / f"a{suffix}", overwrite=True)
    assert (tmp_path / f"a{suffix}").stat().st_size == bytes_of(9, 0, scene.traits)


def test_spz_4_is_read_as_spz_3_and_extensions_are_said_to_be_left_out(tmp_path, caplog):
    scene = cloud(500, 1, 2)
    (tmp_path / "3.spz").write_bytes(encode_spz(scene))
    (tmp_path / "4.spz").write_bytes(encode_spz4(scene, struct.pack("<II4s", 7, 4, b"what")))
    assert same_bits(ps.load(tmp_path / "3.spz"), ps.load(tmp_path / "4.spz"))
    assert caplog.messages == [f"{tmp_path / '4.spz'}: extensions of the SPZ file are not read"]


def test_a_sog_folder_is_read_by_both_names_and_equals_the_file(tmp_path):
    scene = cloud(1500, 0, 3)
    write_sog_folder(scene, tmp_path / "room")
    ps.save(scene, tmp_path / "room.sog")
    scenes = [ps.load(tmp_path / "room"), ps.load(tmp_path / "room" / "meta.json"), ps.load(tmp_path / "room.sog")]
    assert same_bits(scenes[0], scenes[1]) and same_bits(scenes[0], scenes[2])


def test_degree_4_of_a_ply_is_read_up_to_3(tmp_path, caplog):
    columns = columns_of(cloud(2, 0, 3)) | {f"f_rest_{i}": np.full(2, i / 64, np.float32) for i in range(72)}
    write_columns(tmp_path / "a.ply", columns)
    scene = ps.load(tmp_path / "a.ply")
    assert scene.sh_degree == 3 and "SH degree 4, read up to degree 3" in caplog.text
    wanted = np.arange(72).reshape(3, 24)[:, :15] / 64
    assert np.array_equal(scene.features_rest[1].T.numpy(), wanted)


REAL = {
    "apt_bathroom/Toilet.compressed.ply": (57_574, 3),
    "kettle_pod/pod.spz": (101_407, 3),
    "mujoco_tabletop/scene.spz": (213_944, 0),
    "pc_statue_massa/massa.sog": (58_649, 0),
    "pc_flowers": (92_802, 2),
    "plant_pilea": (386_884, 3),
}


@pytest.mark.skipif(not SPLATS.is_dir(), reason="the files are not there")
@pytest.mark.parametrize("name", REAL)
def test_files_that_others_published_are_read(name, caplog):
    with caplog.at_level(logging.WARNING):
        scene = ps.load(SPLATS / name)
    assert (len(scene), scene.sh_degree) == REAL[name]
    assert bool(scene.opacities.isfinite().all()) and bool(scene.usable().all())
    assert "dropped" not in caplog.text
    assert format_to_read(SPLATS / name).name in ("compressed PLY", "SPZ", "SOG", "SOG folder")
