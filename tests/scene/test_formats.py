"""Scene files of every format: whatever its name, a file is what its content tells; what comes
back; sizes."""

import gzip
import io
import logging

import numpy as np
import pytest
import torch
from compressed_plys import encode_compressed_ply
from foreign import encode_spz4
from plys import columns_of, write_columns
from refusing import fails

import pointsplat_ns as ps
from lab.robustness.fuzz_readers import zip_of
from making import SHARED_DATA, cloud, normal_scene, same_bits, write_run
from pointsplat_ns.scene.discovery import find_scenes
from pointsplat_ns.scene.formats import format_like, format_named, format_to_read
from pointsplat_ns.scene.formats.gltf import encode_glb, encode_spz_glb
from pointsplat_ns.scene.formats.rad import encode_rad
from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.reading import kind_of, source_file

SCENE = cloud(64, 3, 1)


def torch_bytes(content, **options):
    stream = io.BytesIO()
    torch.save(content, stream, **options)
    return stream.getvalue()


def checkpoint(step=7):
    return {
        "step": step,
        "pipeline": {f"_model.gauss_params.{name}": value for name, value in SCENE.items()},
    }


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """Name of a format to the bytes of a file of it, and the scene that is read from them."""
    folder = tmp_path_factory.mktemp("contents")
    ps.save(SCENE, folder / "a.ply")
    ply = (folder / "a.ply").read_bytes()
    found = {
        "3DGS PLY": (ply, ".ply"),
        "compressed PLY": (encode_compressed_ply(SCENE), ".compressed.ply"),
        "SPZ 3": (encode_spz(SCENE, version=3), ".spz"),
        "SPZ 4": (encode_spz4(SCENE), ".spz"),
        "SOG": (encode_sog(SCENE), ".sog"),
        "glTF": (encode_glb(SCENE), ".glb"),
        "glTF with SPZ": (encode_spz_glb(SCENE), ".spz.glb"),
        "RAD": (encode_rad(SCENE, torch.zeros(64), torch.zeros(64)), ".rad"),
        "checkpoint": (torch_bytes(checkpoint()), ".ckpt"),
        "checkpoint of old torch": (
            torch_bytes(checkpoint(), _use_new_zipfile_serialization=False),
            ".ckpt",
        ),
    }
    scenes = {}
    for name, (data, suffix) in found.items():
        (folder / f"right{suffix}").write_bytes(data)
        scenes[name] = (data, ps.load(folder / f"right{suffix}"))
    return scenes


NAMES = ["x.ply", "x.spz", "x.splat", "x.ckpt", "x", "x.yml"]
KINDS = {"SPZ 3": "SPZ", "SPZ 4": "SPZ", "checkpoint of old torch": "checkpoint"}


@pytest.mark.parametrize("name", NAMES)
def test_content_decides_for_every_format_under_every_name(tmp_path, contents, name):
    for kind, (data, scene) in contents.items():
        path = tmp_path / name
        path.write_bytes(data)
        assert same_bits(ps.load(path), scene), (kind, name)
        assert kind_of(path) == KINDS.get(kind, kind), (kind, name)
        assert source_file(path).name == name


def test_a_renamed_file_is_written_again_as_what_it_is(tmp_path, contents):
    for kind, wanted in (
        ("3DGS PLY", ".ply"),
        ("compressed PLY", ".sog"),
        ("SPZ 3", ".spz"),
        ("SOG", ".sog"),
        ("glTF", ".glb"),
        ("glTF with SPZ", ".spz.glb"),
        ("RAD", ".ply"),
    ):
        path = tmp_path / "x.splat"
        path.write_bytes(contents[kind][0])
        assert format_like(path).suffix == wanted
    assert format_like(tmp_path / "none.splat").suffix == ".ply"


def test_a_folder_is_searched_by_what_its_files_hold(tmp_path, contents, caplog):
    (tmp_path / "a.ply").write_bytes(contents["SPZ 3"][0])
    (tmp_path / "b.splat").write_bytes(contents["3DGS PLY"][0])
    (tmp_path / "c.spz").write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"
    )
    assert [*find_scenes(tmp_path)] == ["a", "b"]
    assert "c.spz: no Gaussians in it" in caplog.text
    (tmp_path / "d.ply").write_bytes(b"ply\n")
    (tmp_path / "e.sog").write_bytes(
        contents["SOG"][0][:-50]
    )  # a scene that is damaged is none that is passed over
    assert [*find_scenes(tmp_path)] == ["a", "b", "e"]
    assert "d.ply: no Gaussians in it" in caplog.text


REFUSED = {
    "x.ply": (
        zip_of({"document.json": "{}", "splat_0.ply": "ply\n"}),
        "SuperSplat project files are not read; open",
    ),
    "x.ssproj": (b"anything", "SuperSplat project"),
    "x.zip": (zip_of({"lod-meta.json": "{}", "0_0/meta.json": "{}"}), "zip of a streamed SOG"),
    "x.sog": (
        zip_of(dict.fromkeys(("a.jpg", "b.jpg", "c.jpg", "d.jpg"), b"")),
        "a zip archive of a.jpg, b.jpg, c.jpg and 1",
    ),
    "x.lcc": (b"{}", "LCC files are not read; convert it"),
    "x.ksplat": (bytes(9000), "ksplat files are not read; convert it to .ply or .sog"),
    "x.splatv": (
        bytes(64),
        "moving scene (splatv) files are not read; export a .ply of one moment",
    ),
    "x.spz": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "Git LFS pointer"),
    "y.ply": (b"<!DOCTYPE html><html>", "web page"),
    "y.splat": (b"LASF" + bytes(60), "LAS point cloud"),
    "z.ply": (b"PXR-USDC" + bytes(60), "USD files are not read"),
    "y.zip": (
        zip_of({"room/a.ply": "ply\n"}),
        "zip of a PLY files are not read; unpack it and name the PLY",
    ),
    "z.zip": (zip_of({"a.ply": "ply\n" * 99})[:-30], "a truncated or damaged zip archive"),
    "z.splat": (b"# a text of words and numbers 32\n" * 32, "text"),
    "z.spz": (gzip.compress(b"ply\nformat ascii 1.0\n"), "SPZ of b'ply\\n'"),
    "x.glb": (b"glTF" + bytes(60), "glTF of version 0; expected 2"),
    "x.radc": (b"RADC" + bytes(60), "page of a RAD files are not read; name its .rad"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_read_is_refused_by_what_it_is(tmp_path, name):
    data, said = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    assert fails(lambda: ps.load(tmp_path / name), said, error=ps.SceneError).startswith(
        str(tmp_path / name)
    )


def test_info_names_runs_and_checkpoints_in_them_with_method_and_step(tmp_path, capsys):
    path = write_run(tmp_path / "run", 8, 100)
    torch.save(checkpoint(), path)
    config = tmp_path / "run" / "config.yml"
    config.write_text(
        config.read_text().replace("max_num", "method_name: splatfacto-big\nmax_num", 1)
    )
    names = [ps.info(place).format for place in (tmp_path / "run", config, path)]
    assert names == ["run of splatfacto-big, step 7"] * 2 + ["checkpoint of splatfacto-big, step 7"]


SPLATS = SHARED_DATA / "splats"


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".glb", ".gltf"])
def test_the_size_of_a_file_is_known_to_the_byte(tmp_path, suffix):
    bytes_of = format_named(suffix).bytes_of
    for n, degree in ((0, 0), (1, 3), (255, 1), (256, 2), (257, 0), (1001, 3)):
        ps.save(normal_scene(n, degree), tmp_path / f"a{suffix}", overwrite=True)
        assert (tmp_path / f"a{suffix}").stat().st_size == bytes_of(n, degree)
    scene = normal_scene(9, 0).replace(antialiased=True, up="-y")
    ps.save(scene, tmp_path / f"a{suffix}", overwrite=True)
    assert (tmp_path / f"a{suffix}").stat().st_size == bytes_of(9, 0, scene.traits)


def test_degree_4_of_a_ply_is_read_up_to_3(tmp_path, caplog):
    columns = columns_of(cloud(2, 0, 3)) | {
        f"f_rest_{i}": np.full(2, i / 64, np.float32) for i in range(72)
    }
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
