"""``--spz-version``: what each command writes, and what it says of who reads it."""

import gzip
import json

import pytest
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball, cloud
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.scene.formats.spz import version_of
from pointsplat_ns.tools.wording import spz_readers

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def scene(tmp_path):
    ps.save(ball(400, 1, opacity=1.0, bright=1.0), tmp_path / "a.ply")
    return tmp_path / "a.ply"


WAYS = {
    "prune": ("--keep", "50%", "--by", "opacity"),
    "compact": ("--keep", "50%", "--effort", "instant"),
    "clean": (),
    "convert": (),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_command_writes_the_version_and_says_who_reads_it(way, scene, tmp_path, capsys):
    for options, version in (((), 4), (("--spz-version", "3"), 3), (("--spz-version", "2"), 2)):
        output = tmp_path / f"{version}.spz"
        where = (output,) if way == "convert" else ("-o", output)
        run(way, scene, *where, *WAYS[way], *options)
        assert version_of(output) == version
        assert f"\n{spz_readers(version)}\n" in capsys.readouterr().out
        run(way, scene, *where, *WAYS[way], *options, "--force", "--json")
        assert json.loads(capsys.readouterr().out)["spz_version"] == version
    where = (tmp_path / "b.ply",) if way == "convert" else ("-o", tmp_path / "b.ply")
    run(way, scene, *where, *WAYS[way])
    assert "SPZ" not in capsys.readouterr().out


def test_versions_are_named_with_their_readers_and_the_way_to_others():
    assert spz_readers(4).startswith("SPZ 4: the format's own library, SuperSplat, PlayCanvas")
    assert spz_readers(4).endswith("--spz-version 3")
    assert "PlayCanvas' engine needs --spz-version 4" in spz_readers(3)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_a_size_is_that_of_the_version(version, tmp_path, capsys):
    ps.save(cloud(3000, 2, 1), tmp_path / "cloud.ply")
    output = tmp_path / "small.spz"
    words = ("--keep", "20kB", "--by", "opacity", "--spz-version", version, "-o", output)
    run("prune", tmp_path / "cloud.ply", *words)
    assert version_of(output) == version
    assert 0.9 * 20_000 < output.stat().st_size <= 20_000
    small = ps.prune(cloud(3000, 2, 1), "0.02MB.spz", by="opacity", spz_version=version)
    ps.save(small, tmp_path / "python.spz", spz_version=version)
    assert (tmp_path / "python.spz").read_bytes() == output.read_bytes()


def test_a_quality_is_that_of_the_file_in_the_version(tmp_path, scene):
    found = ps.compact(
        scene, by="opacity", target_db=25.0, target_format=".spz", spz_version=2, effort="instant"
    )
    ps.save(found.scene, tmp_path / "found.spz", spz_version=2)
    assert found.target is not None
    assert found.target.bytes == (tmp_path / "found.spz").stat().st_size


def test_a_headset_gets_the_version_of_its_browsers_unless_another_is_asked_for(scene, tmp_path):
    words = ("compact", scene, "--for", "headset", "--effort", "instant", "-o")
    run(*words, tmp_path / "a.spz")
    run(*words, tmp_path / "b.spz", "--spz-version", "4")
    assert [version_of(tmp_path / name) for name in ("a.spz", "b.spz")] == [3, 4]


def test_a_folder_s_results_have_the_version_and_are_made_again_for_another(tmp_path, capsys):
    ps.save(ball(120, 1, opacity=1.0, bright=1.0), tmp_path / "rooms" / "a.spz", spz_version=3)
    words = ("compact", tmp_path / "rooms", "--keep", "50%", "--effort", "instant")
    run(*words)
    assert f"\n{spz_readers(4)}\n" in capsys.readouterr().out
    assert version_of(tmp_path / "rooms_compact" / "a.spz") == 4
    said = refusal(capsys, tmp_path, *words, "--spz-version", "2")
    assert "results of other options" in said
    run(*words, "--spz-version", "2", "--force")
    assert version_of(tmp_path / "rooms_compact" / "a.spz") == 2


def test_tiles_hold_what_cesium_reads(scene, tmp_path, capsys):
    for options, version, said in (
        ((), 3, "tiles hold SPZ 3 for CesiumJS, the newest that it reads\n"),
        (("--spz-version", "2"), 2, "tiles hold SPZ 2 for CesiumJS\n"),
    ):
        folder = tmp_path / f"{version}"
        run("lod", scene, "--tiles", "--levels", "50%", "-o", folder, *options)
        assert f"\n{said}" in capsys.readouterr().out
        [first, *_] = sorted(folder.rglob("*.glb"))
        data = first.read_bytes()
        content = gzip.decompress(data[data.index(b"\x1f\x8b\x08") :].rstrip(b"\0") + bytes(3))
        assert content[:8] == b"NGSP" + bytes([version, 0, 0, 0])


def test_tiles_of_version_4_and_versions_without_tiles_are_refused(scene, tmp_path, capsys):
    said = refusal(capsys, tmp_path, "lod", scene, "--spz-version", "2")
    assert "SPZ version 2 of levels; expected 3 or 2, which CesiumJS reads, and 3D Tiles" in said
    with pytest.raises(PointSplatError, match="expected 3 or 2, which CesiumJS reads"):
        ps.lod(scene, [0.5], folder=tmp_path / "out", tiles=True, spz_version=4)
