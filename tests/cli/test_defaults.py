"""Each command with all defaults as they ship, on a small scene, and what it gains in numbers.

Thresholds are about two thirds of what was measured, in dB half of it, and leave room for other
processors' rounding.
"""

import http.client
import json
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, same_bits, splats
from pointsplat_ns.cli import main
from pointsplat_ns.tools.pages.viewer import Viewer


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Path:
    """A closed box of 400 Gaussians in smooth colours, as a file."""
    path = tmp_path_factory.mktemp("box") / "box.ply"
    ps.save(box_room(0, 400, smooth=True), path)
    return path


@pytest.fixture
def run(tmp_path, capsys):
    """A function that runs a command and gives what it prints as JSON."""

    def run(*words: str | Path) -> dict:
        main([*map(str, words), "--json"])
        return json.loads(capsys.readouterr().out)

    return run


def test_prune_keeps_three_tenths_closer_than_the_most_opaque(box, run, tmp_path):
    merged = run("prune", box, "-o", tmp_path / "merged.ply")
    ranked = run("prune", box, "-o", tmp_path / "ranked.ply", "--by", "opacity")
    assert merged["gaussians"] == ranked["gaussians"] == 120
    assert merged["bytes"] < 0.32 * box.stat().st_size
    assert (merged["views"], merged["width"], merged["height"]) == (12, 1920, 1080)
    assert merged["psnr"] > ranked["psnr"] + 5  # measured: 21.8 and 12.3 dB


def test_compact_repairs_a_tenth(box, run, tmp_path):
    compacted = run("compact", box, "-o", tmp_path / "compacted.ply")
    merged = run("prune", box, "-o", tmp_path / "merged.ply", "--keep", "10%")
    assert compacted["gaussians"] == merged["gaussians"] == 40 and compacted["repaired"]
    assert compacted["psnr"] > merged["psnr"] + 2  # measured: 21.3 and 16.7 dB


def test_clean_removes_what_no_picture_shows_and_nothing_else(run, tmp_path):
    room = box_room(0, 400, smooth=True)
    faint = splats(torch.zeros(30, 3), [-2.0, -2.0, -2.0], -9.0, degree=1)
    dense = tmp_path / "dense.ply"
    ps.save(joined(room, faint), dense)
    cleaned = run("clean", dense, "-o", tmp_path / "cleaned.ply")
    assert (cleaned["gaussians_before"], cleaned["gaussians"]) == (430, 400)
    assert cleaned["psnr"] is None or cleaned["psnr"] > 60


def joined(*scenes: ps.Gaussians) -> ps.Gaussians:
    """Scenes as one."""
    names = [name for name, _ in scenes[0].items()]
    return ps.Gaussians(**{name: torch.cat([getattr(s, name) for s in scenes]) for name in names})


def test_lod_writes_four_levels_each_closer_than_the_next(box, run, tmp_path):
    levels = run("lod", box, "-o", tmp_path / "levels")["levels"]
    assert [level["count"] for level in levels] == [200, 100, 40, 12]
    psnrs = [level["psnr"] for level in levels]  # measured: 29.1, 22.2, 18.1 and 14.5 dB
    assert psnrs[0] > 25
    assert all(finer > coarser + 1.5 for finer, coarser in zip(psnrs, psnrs[1:], strict=False))


def test_tradeoff_measures_six_sizes_with_and_without_repair(box, run, tmp_path):
    found = run("tradeoff", box, "-o", tmp_path / "tradeoff")
    points = {point["key"]: point for point in found["points"]}
    shares = ("70pct", "50pct", "30pct", "20pct", "10pct", "5pct")
    repaired = [f"{share}_quick" for share in shares]
    assert sorted(points) == sorted(("dense", *shares, *repaired))
    assert [points[share]["gaussians"] for share in shares] == [280, 200, 120, 80, 40, 20]
    gains = [
        points[f"{share}_quick"]["against_dense"]["psnr"] - points[share]["against_dense"]["psnr"]
        for share in shares
    ]
    assert min(gains) > 1.8  # measured: 3.6 to 6.7 dB
    assert found["recommended"] == "70pct_quick"
    assert (tmp_path / "tradeoff" / "tradeoff.html").stat().st_size > 10_000


def test_render_films_ten_seconds_without_an_option(box, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.ply").write_bytes(box.read_bytes())
    film = run("render", "box.ply")
    video = tmp_path / "box.mp4"
    assert film["frames"] == 240 and film["bytes"] == video.stat().st_size
    raw = 240 * 960 * 540 * 3
    assert 0 < film["bytes"] < raw / 300  # measured: a 540th


def test_view_serves_a_page_whose_slider_loads_a_tenth_of_the_bytes(box, monkeypatch, capsys):
    sizes = {}

    def ask(viewer: Viewer) -> None:
        for percent in (100, 10):
            asked = {"stage": 1, "scene": 0, "percent": percent, "have": "", "spz": True}
            body = json.dumps(asked)
            connection = http.client.HTTPConnection(viewer.url.removeprefix("http://"), timeout=60)
            connection.request("POST", "/scene", body, {"Origin": viewer.url})
            answer = connection.getresponse()
            sizes[percent] = answer.status, len(answer.read())

    monkeypatch.setattr(Viewer, "wait", ask)
    main(["view", str(box)])
    assert "http://127.0.0.1:" in capsys.readouterr().out
    assert sizes[100][0] == sizes[10][0] == 200
    assert sizes[10][1] < 0.3 * sizes[100][1]


def test_a_page_shows_both_scenes_and_weighs_less_than_the_files(box, tmp_path):
    room = ps.load(box)
    page = ps.write_page([room, ps.prune(room, 0.3)], tmp_path / "box.html")
    text = page.read_text("utf-8")
    assert "http://" not in text and "https://" not in text
    assert page.stat().st_size < 400_000


@pytest.mark.parametrize(("suffix", "share"), [(".spz", 0.35), (".sog", 0.6), (".splat", 0.5)])
def test_convert_takes_a_part_of_the_bytes_and_looks_the_same(suffix, share, box, run, tmp_path):
    output = tmp_path / f"box{suffix}"
    converted = run("convert", box, output)
    assert converted["gaussians"] == 400
    assert converted["bytes"] == output.stat().st_size < share * box.stat().st_size
    dense = ps.load(box)
    views = ps.sample_views(dense, 3, 320, 180)
    found = ps.psnr(ps.render(ps.load(output), views), ps.render(dense, views))
    assert float(found.min()) > 35


def test_export_writes_the_scene_of_a_run_to_the_bit(trained_walls, run, tmp_path):
    [folder] = (trained_walls / "wall-a").glob("*/*")
    exported = run("export", folder, "-o", tmp_path / "wall.ply")
    trained = ps.load(folder)
    assert exported["gaussians"] == len(trained) > 0
    assert same_bits(ps.load(tmp_path / "wall.ply"), trained)
    [checkpoint] = folder.glob("nerfstudio_models/*.ckpt")
    assert exported["bytes"] < 0.5 * checkpoint.stat().st_size  # without optimisers


def test_info_counts_what_is_there(box, run):
    found = run("info", box)
    assert (found["gaussians"], found["sh_degree"], found["format"]) == (400, 1, "3DGS PLY")
    assert found["bytes"] == box.stat().st_size
    assert found["views"] == "12 views of 1920 x 1080 pixels"
    assert 4 < found["fill"] < 12
