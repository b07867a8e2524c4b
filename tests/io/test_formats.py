"""Scene files of every format: what comes back, that the order is known, and that sizes are as said."""

import logging

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import SHARED_DATA, cloud, normal_scene, same_bits
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import zero_as_identity
from pointsplat_ns.io.formats import format_to_read, format_to_write
from pointsplat_ns.io.formats.registry import format_named
from pointsplat_ns.io.formats.spz import encode_spz

LOSSY = (".compressed.ply", ".spz", ".sog", ".splat")
FIXED = (".ply", ".compressed.ply", ".splat", ".glb")

SPLATS = SHARED_DATA / "splats"


def written(scene, path):
    """What is read back of a scene, and the scene in the order of the file."""
    ps.save(scene, path)
    order = format_to_write(path).order
    return ps.load(path), scene if order is None else scene[order(scene)]


def name_of(suffix):
    return suffix if not suffix.startswith(".") else f"a{suffix}"


def degrees_apart(one, other):
    a, b = (torch.nn.functional.normalize(zero_as_identity(s.quats).double(), dim=1) for s in (one, other))
    apart = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return 4 * torch.asin(apart / 2).rad2deg()


def greatest(value):
    return float(value.abs().max()) if value.numel() else 0.0


def assert_close(suffix, before, after):
    """The tolerances are half of a step of each format, and what its reader adds in rounding."""
    extent = float((before.means.amax(0) - before.means.amin(0)).max())
    spread = float(before.scales.max() - before.scales.min())
    colors = float(before.features_dc.max() - before.features_dc.min())
    rest = float(before.features_rest.abs().max()) if before.sh_degree else 0.0
    position = {".spz": 2**-13, ".splat": 0.0, ".compressed.ply": extent / 1022 / 2 + 1e-6}
    log_scale = {".spz": 1 / 32, ".splat": 1e-6, ".compressed.ply": spread / 1023 / 2 + 1e-5}
    dc = {".spz": 0.5 / 255 / 0.15, ".splat": 0.5 / 255 / SH_C0, ".compressed.ply": colors / 255 / 2 + 1e-5}
    # The components of .splat have 7 bits and a sign, others 8 to 10 bits over sqrt(2); all four of them may be off.
    turn = {".splat": 1.1, ".spz": 0.3, ".compressed.ply": 0.3}.get(suffix, 1.1)
    logs = extent and float(torch.log1p(before.means.abs()).max())
    assert greatest(before.means - after.means) <= position.get(suffix, 2 * logs / 65535 * (1 + extent)) * 1.001
    assert greatest(before.scales - after.scales) <= log_scale.get(suffix, spread / 200) * 1.001
    assert float(degrees_apart(before, after).max()) <= turn
    assert greatest(before.alphas - after.alphas) <= 0.5 / 255 + 1e-5
    assert greatest(before.features_dc - after.features_dc) <= dc.get(suffix, colors / 200) * 1.001 + 1e-6
    if suffix == ".splat":
        assert after.sh_degree == 0
        return
    assert after.sh_degree == before.sh_degree
    # Steps of SPZ are 1/16 and, of degree 1, 1/32; of the compressed PLY 1/32.
    first = greatest((before.features_rest - after.features_rest)[:, :3])
    assert suffix != ".spz" or first <= 1 / 32 / 2
    coefficient = {".spz": 1 / 16 / 2, ".compressed.ply": 8 / 256 / 2}.get(suffix, rest / 12 + 1e-6)
    assert greatest(before.features_rest - after.features_rest) <= coefficient * 1.001


def mild(n, degree, seed=0):
    """Gaussians within what every format can hold: colours in [0, 1], no more SH than a palette has entries."""
    scene = cloud(n, seed, degree)
    return scene.replace(features_dc=(torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) - 0.5) / SH_C0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("suffix", LOSSY)
def test_a_scene_comes_back_within_half_a_step_of_its_format(tmp_path, suffix, degree):
    for n in (1, 257, 1000) if degree == 3 else (2, 600):
        after, before = written(mild(n, degree, seed=n), tmp_path / name_of(suffix))
        assert_close(suffix, before, after)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog", ".glb", ".spz"])
def test_colours_beyond_black_and_white_and_tiny_sizes_are_not_clipped(tmp_path, suffix):
    scene = cloud(300, 4, 0)
    scene.features_dc[:5] = (torch.tensor([1.4, -0.4, 0.5]) - 0.5) / SH_C0
    scene.scales[:5] = torch.tensor([-14.0, -12.0, -4.0])
    after, before = written(scene, tmp_path / name_of(suffix))
    tiny = before.scales < -11
    assert int(tiny.sum()) == 10
    colours, wanted = (0.5 + SH_C0 * s.features_dc[tiny.any(dim=1)] for s in (after, before))
    assert greatest(colours - wanted) < 0.02  # some steps of each format
    if suffix == ".spz":  # its bytes begin at -10
        assert bool((after.scales[tiny] == -10).all())
    else:
        assert greatest((after.scales - before.scales)[tiny]) < 0.05


@pytest.mark.parametrize("suffix", FIXED)
def test_the_size_of_a_file_is_known_to_the_byte(tmp_path, suffix):
    bytes_of = format_named(suffix).bytes_of
    for n, degree in ((0, 0), (1, 3), (255, 1), (256, 2), (257, 0), (1001, 3)):
        ps.save(normal_scene(n, degree), tmp_path / f"a{suffix}")
        assert (tmp_path / f"a{suffix}").stat().st_size == bytes_of(n, degree)


@pytest.mark.parametrize("suffix", (".spz", ".sog", "meta.json", ".compressed.ply", ".splat", ".glb"))
def test_the_same_scene_gives_the_same_bytes(tmp_path, suffix):
    for folder in "ab":
        ps.save(cloud(2000, 3, 1), tmp_path / folder / name_of(suffix))
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_spz_4_holds_what_spz_3_holds(tmp_path):
    scene = cloud(500, 1, 2)
    for version in (3, 4):
        (tmp_path / f"{version}.spz").write_bytes(encode_spz(scene, version=version))
    assert (tmp_path / "3.spz").read_bytes()[:2] == b"\x1f\x8b" and (tmp_path / "4.spz").read_bytes()[:4] == b"NGSP"
    assert same_bits(ps.load(tmp_path / "3.spz"), ps.load(tmp_path / "4.spz"))


def test_a_sog_folder_is_read_by_both_names_and_equals_the_file(tmp_path):
    scene = cloud(1500, 0, 3)
    ps.save(scene, tmp_path / "room" / "meta.json")
    ps.save(scene, tmp_path / "room.sog")
    scenes = [ps.load(tmp_path / "room"), ps.load(tmp_path / "room" / "meta.json"), ps.load(tmp_path / "room.sog")]
    assert same_bits(scenes[0], scenes[1]) and same_bits(scenes[0], scenes[2])


def test_degree_4_of_a_ply_is_read_up_to_3(tmp_path, caplog):
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(72)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    rows = np.arange(2 * len(names), dtype="<f4").reshape(2, -1) / 64  # log-scales that can be drawn
    (tmp_path / "a.ply").write_bytes(head.encode() + rows.tobytes())
    scene = ps.load(tmp_path / "a.ply")
    assert scene.sh_degree == 3 and "SH degree 4, read up to degree 3" in caplog.text
    for channel in range(3):
        first = names.index(f"f_rest_{24 * channel}")
        assert scene.features_rest[1, :, channel].tolist() == rows[1, first : first + 15].tolist()


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_a_comment_that_a_scene_is_drawn_in_another_way_is_passed_on(tmp_path, caplog, suffix):
    ps.save(cloud(3), tmp_path / f"a{suffix}")
    ps.load(tmp_path / f"a{suffix}")
    assert "trained" not in caplog.text
    data = (tmp_path / f"a{suffix}").read_bytes().replace(b" 1.0\n", b" 1.0\ncomment SplatRenderMode: 2dgs\n", 1)
    (tmp_path / f"a{suffix}").write_bytes(data)
    assert len(ps.load(tmp_path / f"a{suffix}")) == 3
    assert "trained" in caplog.text and "drawn here" in caplog.text


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


@pytest.mark.parametrize("name", ["a.lcc", "a.lcc2"])
def test_lcc_is_refused_by_name(tmp_path, name):
    (tmp_path / name).write_text("{}")
    with pytest.raises(ps.SceneError, match="LCC files are not read"):
        ps.load(tmp_path / name)
    with pytest.raises(ps.SceneError, match="cannot write a LCC"):
        ps.save(ps.example_room()[:3], tmp_path / name)
