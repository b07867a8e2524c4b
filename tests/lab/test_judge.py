"""lab/judge: the camera paths that ship, what programs measure in their views, and rows that are
kept."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from lab.common.programs import Usage, run_measured
from lab.judge import (
    ablation,
    camera_paths,
    cleaning,
    judge,
    large,
    record,
    refinement,
    refiners,
    scenes,
)
from lab.judge import bytes as equal_bytes
from making import box_room, move_zero_layers, run_of
from peers import peer
from pointsplat_ns.cli import main
from pointsplat_ns.metrics import finite_psnr
from pointsplat_ns.pruning.merging import MERGING, merge
from pointsplat_ns.refinement import Refiner, refiner_preset, save_refiner
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import read_scene

pytestmark = pytest.mark.usefixtures("quick")

VIEWS = {
    "scene": "small",
    "about": "The walls of a room, from its middle.",
    "up": [0, 0, 1],
    "field_of_view": 60,
    "views": [{"eye": [0.2, 0.1, 0], "at": [2, 0, 0]}, {"eye": [0, 0, 0.3], "at": [0, 1.5, 0]}],
}


@pytest.fixture()
def small(tmp_path, monkeypatch) -> Path:
    """A room of 900 Gaussians with a path of two views."""
    monkeypatch.setattr(camera_paths, "FOLDER", tmp_path)
    (tmp_path / "small.json").write_text(json.dumps(VIEWS))
    write_ply(box_room(seed=3), tmp_path / "small.ply")
    return tmp_path / "small.ply"


def rows_of(results: Path) -> list[dict]:
    return json.loads(results.read_text())["rows"]


@pytest.mark.parametrize(
    "path", sorted(camera_paths.FOLDER.glob("*.json")), ids=lambda path: path.stem
)
def test_a_path_that_ships_has_sixteen_upright_views_from_different_places(path):
    found = camera_paths.read_path(path)
    views = camera_paths.views_of(path, 320)
    assert len(views) == 16 and 60 <= found.field_of_view <= 70
    assert len({tuple(eye) for eye in torch.cat([found.eyes, found.ats], 1).tolist()}) == 16
    up = found.up / found.up.norm()
    right = views.viewmats[:, 0, :3]
    down = views.viewmats[:, 1, :3]
    assert (right @ up).abs().max() < 1e-12  # the horizon is level
    assert (
        down @ up
    ).max() < -0.3  # and up is up: no view looks down or up by more than about 70 degrees


def test_every_way_has_a_row_for_each_width(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    options = {"keep": (0.5,), "ways": ("prune",), "widths": (32, 64), "views": 2, "lpips": False}
    judge.main((small,), **options, splat_transform=(peer(tmp_path, "3.7.0"),), json_path=results)
    said = capsys.readouterr().out
    content = json.loads(results.read_text())
    labels = ["prune", "splat-transform 3.7.0 -d", "splat-transform 3.7.0 adaptive"]
    assert [(row["at"], row["method"]) for row in content["rows"]] == [
        (at, m) for at in (32, 64) for m in labels
    ]
    for row in content["rows"]:
        assert (row["gaussians"], row["count"], row["views"], row["failed"]) == (900, 450, 2, "")
        assert row["peak_bytes"] > 5e6 and row["seconds"] > 0 and row["cpu_seconds"] > 0
        assert 0 < row["covered_psnr"] < 100 and 0 < row["dense_ssim"] < 1
    assert (
        said.count("covered PSNR") == 1
        and " ".join(said.split()).count("splat-transform 3.7.0 adaptive") >= 1
    )
    assert {path.name for path in tmp_path.iterdir()} == {
        "small.ply",
        "small.json",
        "rows.json",
        "peer-3.7.0",
    }


def test_a_way_that_fails_is_noted_and_measured_again(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    broken = peer(tmp_path, "2.0.0", fails="--decimate")
    options = {
        "keep": (0.5,),
        "ways": (),
        "widths": (32,),
        "views": 1,
        "lpips": False,
        "json_path": results,
    }
    judge.main((small,), **options, splat_transform=(broken, peer(tmp_path, "2.7.1")))
    said = capsys.readouterr().out
    failed, fine = rows_of(results)
    assert failed["method"] == "splat-transform 2.0.0" and "out of luck" in failed["failed"]
    assert failed["covered_psnr"] is failed["seconds"] is None and fine["covered_psnr"] > 0
    assert "splat-transform 2.0.0 at 50 % failed" in said
    judge.main((small,), **options, resume=True, splat_transform=(peer(tmp_path, "2.0.0"),))
    rows = rows_of(results)
    assert [row["failed"] for row in rows] == ["", ""] and rows[1] == fine


def test_a_run_is_judged_by_its_held_out_photos_in_their_size(trained_walls, tmp_path, capsys):
    results = tmp_path / "rows.json"
    run = run_of(trained_walls, "wall-a")
    options = {"keep": (0.5,), "ways": (), "views": 2, "lpips": False, "json_path": results}
    judge.main((run,), **options, splat_transform=(peer(tmp_path, "2.7.1"),))
    [row] = rows_of(results)
    assert (row["scene"], row["at"], row["views"]) == ("wall-a", "photos", 2)
    assert 0 < row["photo_psnr"] < 100 and row["photo_psnr"] != row["dense_psnr"]
    assert "photo PSNR" in " ".join(capsys.readouterr().out.split())


def test_means_and_leads_are_over_scenes_that_have_every_way():
    rows = [
        {
            "scene": scene,
            "keep": 0.1,
            "method": method,
            "at": 960,
            "failed": "",
            "cpu_seconds": 1.0,
            "peak_bytes": 1e9,
        }
        | dict.fromkeys(scenes.MEASURES)
        | {"covered_psnr": psnr}
        for scene, *psnrs in (("rock", 25, 27, 24, 23), ("chair", 30, 31, 26, 28), ("can", 40, 41))
        for method, psnr in zip(
            ("prune", "compact", "splat-transform 3 -d", "splat-transform 2"), psnrs, strict=False
        )
    ]
    figures = record.Figures(rows)
    text = record.section(figures, 960)
    row = "| 10 % | 26.00 | 27.50 | 29.00 | +1.50 (+1.00 rock) | +1.50 (+1.00 chair) |"
    assert figures.scenes(960) == "2" and row in text


def test_levels_of_a_stream_are_judged_beside_programs_at_their_counts(
    small, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(large, "WIDTHS", (32, 64))
    ps.lod(
        small, ["100%", "40%", "20%"], folder=tmp_path / "stream", stream=True, resolution=(64, 48)
    )
    results = tmp_path / "l.json"
    programs = dict(ways=("prune",), splat_transform=peer(tmp_path, "3.0"))
    for counts in ((360,), ()):  # what is there is not measured again
        large.main(
            tmp_path / "stream/lod-meta.json",
            "small",
            counts,
            json_path=results,
            resume=True,
            **programs,
        )
    rows = rows_of(results)
    found = sorted((row["way"][:5], row["count"]) for row in rows)
    assert found == [(way, count) for way in ("prune", "publi", "splat") for count in (180, 360)]
    assert all(
        row["worst_64"] < row["mean_64"] < 60 and row["kept"] == row["count"] for row in rows
    )
    assert "900 Gaussians" in (said := capsys.readouterr().out) and "| 1.00 |" in said


TWO = ("no_regrouping", "growth_0")


def test_a_variant_has_the_psnr_of_what_merging_makes_with_its_settings(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    ablation.main((small,), keep=(0.2,), variants=TWO, views=2, width=64, json_path=results)
    rows = rows_of(results)
    assert [row["method"] for row in rows] == ["default", *TWO]
    scene = scenes.load(small, (64,), 2)
    for row, changes in zip(
        rows, ({}, {"regrouping_rounds": 0}, {"growth_exponent": 0.0}), strict=True
    ):
        merged = merge(
            read_scene(small), 180, settings=dataclasses.replace(MERGING, **changes)
        ).scene
        [(_, _, expected)] = scenes.losses(scene, [merged], None)
        assert row["covered_psnr"] == expected["covered_psnr"]
        assert (row["at"], row["keep"], row["gaussians"], row["changes"]) == (64, 0.2, 900, changes)
        assert row["cpu_seconds"] > 0
    assert len({row["covered_psnr"] for row in rows}) == 3
    said = capsys.readouterr().out
    assert all(name in said for name in TWO) and "| 20 % |" in said


def test_a_refiner_gains_what_it_brings_closer_an_untrained_one_nothing(small, tmp_path):
    torch.manual_seed(0)
    about = {"by": "opacity", "keep": "0.5"}
    save_refiner(Refiner(refiner_preset("tiny")), tmp_path / "untrained.safetensors", about)
    save_refiner(
        move_zero_layers(Refiner(refiner_preset("tiny"))), tmp_path / "moved.safetensors", about
    )
    asked = tuple(f"{name}={tmp_path / name}.safetensors" for name in ("untrained", "moved"))
    options = {"keep": (0.5, 0.25), "by": ("opacity",), "width": 64, "views": 2}
    refiners.main((small,), asked, **options, json_path=tmp_path / "rows.json")
    rows = rows_of(tmp_path / "rows.json")
    wanted = [(name, keep, 900 * keep) for keep in (0.5, 0.25) for name in ("untrained", "moved")]
    assert [(row["method"], row["keep"], row["count"]) for row in rows] == wanted
    assert rows[0]["psnr"] == rows[0]["pruned_psnr"] == rows[1]["pruned_psnr"] != rows[1]["psnr"]
    scene = scenes.load(small, (64,), 2)
    pruned = ps.prune(scene.dense, keep=0.5, by="opacity")
    [(_, _, expected)] = scenes.losses(scene, [pruned], None)
    assert rows[0]["pruned_psnr"] == expected["covered_psnr"]


def test_a_refinement_is_measured_beside_the_best_constant(small, tmp_path):
    """Also, what is measured is not measured again, and the page has a row for each way."""
    about = {"keep": 0.25, "by": "paper"}
    save_refiner(
        Refiner(refiner_preset("tiny", units="local")), tmp_path / "net.safetensors", about
    )
    found = tmp_path / "rows.json"

    def measure(*asked: str) -> list[dict]:
        refinement.main(
            (small,),
            tuple(f"{name}={tmp_path}/net.safetensors" for name in asked),
            keep=(0.25,),
            width=64,
            views=2,
            json_path=found,
        )
        return rows_of(found)

    rows = measure("untrained")
    assert [row["way"] for row in rows] == ["selection", "best constant", "merged", "untrained"]
    assert {row["count"] for row in rows} == {225}
    selection, constant, _, untrained = (row["psnr"] for row in rows)
    assert selection == untrained and constant == max(
        round(scenes_psnr(small, add), 3) for add in refinement.CONSTANTS
    )
    assert rows[1]["constant"] in refinement.CONSTANTS
    again = measure("untrained", "other")
    assert again[:4] == rows and [row["way"] for row in again[4:]] == ["other"]
    text = found.with_suffix(".md").read_text()
    assert "| 25 % | untrained |" in text and "| small | 25 % |" in text


def test_the_shipped_network_is_that_of_the_selection(small, tmp_path):
    options = {"keep": (0.5,), "width": 64, "views": 2, "json_path": tmp_path / "rows.json"}
    scene = scenes.load(small, (64,), 2)
    dense = scenes.DenseViews(scene.dense, scene.looks[0].views)
    pruned = ps.prune(scene.dense, keep=0.5, by="paper")
    expected = dense.psnr(ps.refine(pruned, ps.load_refiner(by="paper")))
    assert expected != pytest.approx(dense.psnr(ps.refine(pruned, ps.load_refiner())), abs=1e-3)
    refiners.main((small,), ("shipped=shipped",), by=("paper",), **options)
    assert rows_of(tmp_path / "rows.json")[0]["psnr"] == expected
    (tmp_path / "rows.json").unlink()
    refinement.main((small,), ("shipped=shipped",), by="paper", **options)
    told = dense.psnr(ps.load_refiner(by="paper")(pruned, 0.5))  # the share that is left
    assert rows_of(tmp_path / "rows.json")[-1]["psnr"] == pytest.approx(told, abs=1e-3)


def test_a_refinement_of_a_run_is_judged_in_its_held_out_photos(trained_walls, small, tmp_path):
    found = tmp_path / "rows.json"
    run = run_of(trained_walls, "wall-a")
    refinement.main((small, run), keep=(0.5,), width=64, views=2, json_path=found)
    rows = rows_of(found)
    assert [row["against"] for row in rows] == ["renders"] * 3 + ["photos"] * 3
    [look] = scenes.load(run, (64,), 2).looks
    pruned = ps.prune(ps.load(run), keep=0.5, by="paper")
    values = [
        finite_psnr(ps.render(pruned, view), photo)
        for view, photo in zip(look.views, look.photos, strict=True)
    ]
    assert rows[3]["psnr"] == pytest.approx(sum(values) / len(values), abs=1e-3)
    text = found.with_suffix(".md").read_text()
    assert text.index("| small | 50 % |") < text.index("held-out photos of each")
    assert text.index("held-out photos of each") < text.index("| wall-a | 50 % |")


def scenes_psnr(path: Path, add: float) -> float:
    """PSNR of the paper's selection with a constant added to its log-scales."""
    scene = scenes.load(path, (64,), 2)
    pruned = ps.prune(scene.dense, keep=0.25, by="paper")
    dense = scenes.DenseViews(scene.dense, scene.looks[0].views)
    return dense.psnr(pruned.replace(scales=pruned.scales + add))


def test_each_strength_is_measured_in_held_out_photos(trained_walls, capsys):
    cleaning.main([run_of(trained_walls, "wall-a")], strengths=(0.0, 1.0), photos=2, side=32)
    lines = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if "│" in line]
    none, most = ([cell.strip() for cell in line] for line in lines)
    assert none[:3] == ["0", "0.00", "+0.000"] and most[0] == "1" and float(most[1]) >= 0


def run_here(args: list[str]) -> Usage:
    """Run in this process what would import torch in one of its own: our command, and
    splat-transform's conversion."""
    if args[1] == "-c":
        main(args[3:])
    elif len(args) == 6:
        ps.save(ps.load(args[4]), args[5])
    else:
        return run_measured(args)
    return Usage(1.0, 1.0, 1)


def test_files_of_equal_sizes_are_compared_and_drawn(small, tmp_path, monkeypatch, capsys):
    found = tmp_path / "found.json"
    monkeypatch.setattr(equal_bytes, "run_measured", run_here)

    def measure(**options: object) -> list[dict]:
        equal_bytes.main(
            (small,),
            (0.007,),
            ("prune .spz", "splat-transform .spz"),
            peer(tmp_path, "3.7.0"),
            width=48,
            json_path=found,
            **options,
        )
        return rows_of(found)

    rows = measure(picture=tmp_path / "found.png")
    assert (tmp_path / "found.png").read_bytes().startswith(b"\x89PNG")
    ours, peers = rows
    assert (
        6300 <= ours["bytes"] <= 7000
        and 6700 <= peers["bytes"] <= 7000
        and ours["count"] > peers["count"]
    )
    [[lead]] = equal_bytes.leads(rows).to_numpy()
    assert lead == pytest.approx(ours["covered_psnr"] - peers["covered_psnr"])
    assert f"{lead:+.1f} small" in capsys.readouterr().out

    monkeypatch.setattr(equal_bytes, "run_measured", lambda *_: pytest.fail("measured again"))
    assert measure(resume=True) == rows
