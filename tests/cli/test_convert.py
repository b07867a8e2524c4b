"""``pointsplat convert`` and ``pointsplat info``, and output in other formats."""

import json

import pytest
import torch
from refusing import refusal, run

import pointsplat_ns as ps
from making import cloud, same
from pointsplat_ns.system.files import bytes_text, three_digits

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def scene(tmp_path):
    ps.save(cloud(400, 2, 2), tmp_path / "a.ply")
    return tmp_path / "a.ply"


@pytest.mark.parametrize(
    "name", ["a.spz", "folder/a.sog", "a.splat", "a.glb", "a.gltf", "a.spz.glb"]
)
def test_convert_writes_what_the_name_says_and_prints_its_size(scene, tmp_path, capsys, name):
    run("convert", scene, tmp_path / name)
    said = capsys.readouterr().out
    size = sum(path.stat().st_size for path in (tmp_path / name).parent.iterdir() if path != scene)
    assert f"{tmp_path / name}: 400 Gaussians, SH degree 2, {bytes_text(size)}" in said
    assert said.endswith(", in a new folder\n") == ("folder" in name)
    back = tmp_path / "back.ply"
    run("convert", tmp_path / name, back)
    assert same(ps.load(back), ps.load(tmp_path / name))


def test_convert_cuts_turns_and_scales(scene, tmp_path, capsys):
    run("convert", scene, tmp_path / "b.ply", "--sh", "1", "--up=-y:z", "--scale", "2")
    assert "SH degree 2 cut to 1" in capsys.readouterr().out
    before = ps.load(scene)
    after = ps.load(tmp_path / "b.ply")
    assert after.sh_degree == 1 and torch.allclose(
        after.means[:, 2], -2 * before.means[:, 1], atol=1e-5
    )


def test_info_prints_a_page_or_json(scene, capsys):
    run("info", scene)
    said = capsys.readouterr().out
    assert "400 Gaussians of SH degree 2" in said and "suspicious: nothing" in said
    found = ps.info(scene)
    assert said.startswith(f"{scene}: 3DGS PLY, {bytes_text(scene.stat().st_size)}\n")
    assert (
        f"\nup: {found.up_text}" in said
        and f"\nfill: {found.fill:.1f} Gaussians drawn per pixel, in 12 v" in said
    )
    run("info", scene, "--json")
    assert json.loads(capsys.readouterr().out) == found.as_dict()


def test_info_of_several_files_is_a_table(scene, tmp_path, capsys):
    other = tmp_path / "other.spz"
    run("convert", scene, other)
    capsys.readouterr()
    run("info", scene, other)
    said = capsys.readouterr().out
    infos = [ps.info(path) for path in (scene, other)]
    for path, found in zip((scene, other), infos, strict=True):
        [row] = [line for line in said.splitlines() if str(path) in line]
        cells = [cell.strip() for cell in row.strip("│").split("│")]
        size = three_digits(found.bytes / 1e6)
        assert (
            cells[:4] == [str(path), found.format, size, f"{found.gaussians:,}"]
            and cells[5] == found.up_text
        )
    run("info", scene, other, "--json")
    assert json.loads(capsys.readouterr().out) == [found.as_dict() for found in infos]
    refusal(capsys, tmp_path, "info", scene, other, "--views", tmp_path / "sheet.png")


def test_info_draws_where_a_scene_is_looked_at_from(scene, tmp_path, capsys):
    sheet = tmp_path / "sheet.png"
    run("info", scene, "--views", sheet, "--resolution", "64x48")
    said = capsys.readouterr().out
    assert "of 64 x 48 pixels; sampled poses" in said and "up is " in said
    assert sheet.read_bytes().startswith(b"\x89PNG")
    assert "exists already" in refusal(capsys, tmp_path, "info", scene, "--views", sheet)


@pytest.mark.parametrize("command", ["info", "prune", "compact", "lod"])
def test_a_resolution_that_means_nothing_is_refused(command, scene, capsys):
    said = refusal(capsys, scene.parent, command, scene, "--resolution", "wide")
    assert "expected width and height in pixels, such as 1920x1080" in said
