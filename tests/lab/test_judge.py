"""lab/judge: the camera paths that ship, what is measured in their views, and rows that are kept."""

import json
import math
import re
from pathlib import Path

import pytest
import torch

from lab.judge import camera_paths, judge, scenes, tables
from making import box_room
from peers import peer
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.rasterizer import render, render_with_alpha

PATHS = sorted(camera_paths.FOLDER.glob("*.json"))
PATH = {
    "scene": "small",
    "about": "The walls of a room, from its middle.",
    "up": [0, 0, 1],
    "field_of_view": 60,
    "views": [
        {"eye": [0.2, 0.1, 0], "at": [2, 0, 0]},
        {"eye": [0, 0, 0.3], "at": [0, 1.5, 0]},
        {"eye": [-0.5, 0, 0], "at": [-2, -1, 0.5]},
    ],
}


@pytest.fixture()
def folder(tmp_path, monkeypatch) -> Path:
    """A folder of camera paths in place of those that ship."""
    monkeypatch.setattr(camera_paths, "FOLDER", tmp_path)
    return tmp_path


@pytest.fixture()
def small(folder) -> Path:
    """A room of 900 Gaussians with a path of three views."""
    write_ply(box_room(seed=3), folder / "small.ply")
    write_path(folder)
    return folder / "small.ply"


def write_path(folder: Path, **changes: object) -> Path:
    path = folder / "small.json"
    path.write_text(json.dumps({**PATH, **changes}))
    return path


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_path_that_ships_has_sixteen_upright_views_from_different_places(path):
    found, views = camera_paths.read_path(path), camera_paths.views_of(path, 320)
    assert len(views) == 16 and 60 <= found.field_of_view <= 70
    assert len({tuple(eye) for eye in torch.cat([found.eyes, found.ats], 1).tolist()}) == 16
    up = found.up / found.up.norm()
    right, down = views.viewmats[:, 0, :3], views.viewmats[:, 1, :3]
    assert (right @ up).abs().max() < 1e-12  # the horizon is level
    assert (down @ up).max() < -0.3  # and up is up: no view looks down or up by more than about 70 degrees


@pytest.mark.parametrize("width", [320, 960, 1920])
def test_a_view_has_what_it_looks_at_in_its_middle_and_the_field_across_its_width(folder, width):
    views = camera_paths.views_of(write_path(folder), width)
    assert (views.width, views.height) == (width, width * 9 // 16)
    assert views.background.tolist() == [0, 0, 0]
    distances = [math.dist(view["eye"], view["at"]) for view in PATH["views"]]
    assert views.near_plane == pytest.approx(1e-3 * sorted(distances)[1])
    for view, look, distance in zip(views, PATH["views"], distances, strict=True):
        rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
        at = rotation @ torch.tensor(look["at"], dtype=torch.float64) + translation
        assert torch.allclose(at, torch.tensor([0, 0, distance], dtype=torch.float64), atol=1e-12)
        edge = view.K @ torch.tensor([math.tan(math.radians(30)), 0, 1], dtype=torch.float64)
        assert edge[:2].tolist() == pytest.approx([width, view.height / 2])


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"scene": "other"}, "expected the name of the file, 'small'"),
        ({"about": ""}, "about is ''; expected text"),
        ({"up": [0, 0, 0]}, "up is [0, 0, 0]; expected a direction"),
        ({"up": [0, 1]}, "up is [0, 1]; expected three finite numbers"),
        ({"up": [0, 1, float("nan")]}, "expected three finite numbers"),
        ({"field_of_view": 1.2}, "field_of_view is 1.2; expected degrees from 20 to 120"),
        ({"field_of_view": True}, "field_of_view is True"),
        ({"views": []}, "views is []; expected a list"),
        ({"views": [{"eye": [0, 0, 0]}]}, "at of view 0 is None; expected three finite numbers"),
        ({"views": [[0, 0, 0]]}, "eye of view 0 is None"),
        ({"views": [{"eye": [0, "1", 0], "at": [1, 1, 1]}]}, "eye of view 0 is [0, '1', 0]"),
        ({"views": [{"eye": [1, 2, 3], "at": [1, 2, 3]}]}, "view 0 looks at its own eye"),
    ],
)
def test_a_path_that_means_nothing_is_an_error_with_the_reason(folder, changes, said):
    with pytest.raises(SystemExit, match=re.escape(said)):
        camera_paths.views_of(write_path(folder, **changes), 320)


def ball(colour: float = 1.0) -> Gaussians:
    """One opaque Gaussian of a grey, at the origin."""
    return Gaussians(
        means=torch.zeros(1, 3),
        scales=torch.full((1, 3), math.log(0.2)),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        opacities=torch.full((1, 1), 8.0),
        features_dc=torch.full((1, 3), colour),
        features_rest=torch.zeros(1, 0, 3),
    )


def together(a: Gaussians, b: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(pair) for pair in zip(a.tensors(), b.tensors(), strict=True)))


def scene_of(dense: Gaussians, path: Path, width: int = 64):
    looks = (scenes.Look(width, camera_paths.views_of(path, width)),)
    return scenes.JudgedScene("small", dense, looks, "")


def test_covered_psnr_counts_a_fault_beside_the_object_and_no_empty_background(folder):
    path = write_path(folder, views=[{"eye": [0, -2, 0], "at": [0, 0, 0]}])
    dense, other = ball(), ball(0.7)
    beside = ball()
    beside = beside.replace(means=torch.tensor([[0.9, 0.0, 0.0]]), scales=beside.scales - 1)
    scene = scene_of(dense, path)
    found = [measures for _, _, measures in scenes.losses(scene, [other, together(other, beside), dense], None)]
    view = scene.looks[0].views[0]
    image, alpha = render_with_alpha(dense, view)
    covered = float(alpha.mean())
    assert 0 < covered < 0.2
    expected = -10 * math.log10(float((render(other, view) - image).square().double().mean()) / covered)
    assert found[0]["covered_psnr"] == pytest.approx(expected, abs=1e-3)
    assert found[0]["dense_psnr"] > found[0]["covered_psnr"] + 7  # what the background gives
    assert found[1]["covered_psnr"] < found[0]["covered_psnr"] - 1  # the fault beside the object
    assert found[2]["dense_psnr"] == 100 and found[2]["covered_psnr"] > 80
    assert all(measures["photo_psnr"] is None and measures["dense_lpips"] is None for measures in found)


def test_a_view_in_which_the_dense_scene_covers_nothing_counts_for_all_pixels_alone(folder):
    away = write_path(folder, views=[{"eye": [0, -2, 0], "at": [0, -4, 0]}])
    scene = scene_of(ball(), away)
    [(_, _, found)] = scenes.losses(scene, [ball(0.5)], None)
    assert found["covered_psnr"] is None and found["dense_psnr"] == 100


def test_every_way_has_a_row_for_each_width(small, tmp_path, capsys):
    results = tmp_path / "rows.json"
    options = {"keep": (0.5,), "ways": ("prune",), "widths": (32, 64), "views": 2, "lpips": False}
    judge.main((small,), **options, splat_transform=(peer(tmp_path, "3.7.0"),), json_path=results)
    said = capsys.readouterr().out
    content = json.loads(results.read_text())
    labels = ["prune", "splat-transform 3.7.0 -d", "splat-transform 3.7.0 adaptive"]
    assert [(row["at"], row["method"]) for row in content["rows"]] == [(at, m) for at in (32, 64) for m in labels]
    for row in content["rows"]:
        assert (row["gaussians"], row["count"], row["views"], row["failed"]) == (900, 450, 2, "")
        assert row["peak_bytes"] > 5e6 and row["seconds"] > 0 and row["cpu_seconds"] > 0
        assert 0 < row["covered_psnr"] < 100 and 0 < row["dense_ssim"] < 1
    assert [(lead["at"], lead["method"]) for lead in content["leads"]] == [(32, "prune"), (64, "prune")]
    for lead in content["leads"]:
        psnrs = [row["covered_psnr"] for row in content["rows"] if row["at"] == lead["at"]]
        assert lead["covered_psnr"] == psnrs[0] - max(psnrs[1:])
    assert "64 pixels wide: prune minus the best mode" in " ".join(said.split())
    assert {path.name for path in tmp_path.iterdir()} == {"small.ply", "small.json", "rows.json", "peer-3.7.0"}


def test_rows_that_are_there_stay_and_what_is_asked_for_again_is_measured_anew(small, tmp_path, capsys):
    results, first, second = tmp_path / "rows.json", peer(tmp_path, "3.7.0"), peer(tmp_path, "2.7.1")
    options = {"ways": (), "widths": (32,), "views": 2, "lpips": False, "json_path": results, "keep": (0.5,)}

    def main(*programs: str, **changes) -> list[dict]:
        judge.main((small,), **{**options, "resume": True, "splat_transform": programs, **changes})
        return json.loads(results.read_text())["rows"]

    def marked() -> None:
        """Give rows a time that no program took."""
        content = json.loads(results.read_text())
        for row in content["rows"]:
            row["seconds"] = -1.0
        results.write_text(json.dumps(content))

    def fresh(rows: list[dict]) -> list[tuple]:
        return [(row["method"][16:], row["keep"], row["at"]) for row in rows if row["seconds"] != -1]

    assert len(main(first, resume=False)) == 2
    marked()
    assert fresh(main(first)) == [] and f"small: as {results} has it" in capsys.readouterr().out
    assert fresh(main(second)) == [("2.7.1", 0.5, 32)] and "3.7.0 adaptive" in capsys.readouterr().out
    marked()
    assert fresh(main(second, keep=(0.5, 0.3), widths=(32, 64))) == [
        ("2.7.1", 0.5, 32),
        ("2.7.1", 0.3, 32),
        ("2.7.1", 0.5, 64),
        ("2.7.1", 0.3, 64),
    ]
    marked()
    again = main(second, again=("splat-transform 2.7.1",))
    assert fresh(again) == [("2.7.1", 0.5, 32)]
    assert [(row["method"][16:], row["keep"], row["at"]) for row in again] == [
        ("2.7.1", 0.5, 32),  # measured again; its row of another width is gone, as it may be of an older program
        ("3.7.0 -d", 0.5, 32),
        ("3.7.0 adaptive", 0.5, 32),
        ("2.7.1", 0.3, 32),
        ("2.7.1", 0.3, 64),
    ]
    with pytest.raises(SystemExit, match=re.escape("was written with views 2, now 1")):
        main(second, views=1)
    capsys.readouterr()
    write_path(tmp_path, field_of_view=61)
    changed = main(second)
    assert fresh(changed) == [("2.7.1", 0.5, 32)] and len(changed) == 1
    assert "small: not the scene or the path that" in capsys.readouterr().out


FAILS = """#!/bin/sh
case "$*" in *--version*) echo "splat-transform v2.0.0";; *) echo "out of memory" >&2; exit 3;; esac
"""


def test_a_way_that_fails_is_noted_and_measured_again(small, tmp_path, capsys):
    results, broken = tmp_path / "rows.json", tmp_path / "broken"
    broken.write_text(FAILS)
    broken.chmod(0o755)
    options = {"keep": (0.5,), "ways": (), "widths": (32,), "views": 1, "lpips": False, "json_path": results}
    judge.main((small,), **options, splat_transform=(str(broken), peer(tmp_path, "2.7.1")))
    said = capsys.readouterr().out
    failed, fine = json.loads(results.read_text())["rows"]
    assert failed["method"] == "splat-transform 2.0.0" and "out of memory" in failed["failed"]
    assert failed["covered_psnr"] is failed["seconds"] is None and fine["covered_psnr"] > 0
    assert "splat-transform 2.0.0 at 50 % failed" in said
    mended = Path(peer(tmp_path, "2.0.0"))
    judge.main((small,), **options, resume=True, splat_transform=(str(mended),))
    rows = json.loads(results.read_text())["rows"]
    assert [row["failed"] for row in rows] == ["", ""] and rows[1] == fine


def test_a_run_is_judged_by_its_held_out_photos_in_their_size(trained_walls, tmp_path, capsys):
    results = tmp_path / "rows.json"
    [run] = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    options = {"keep": (0.5,), "ways": (), "views": 2, "lpips": False, "json_path": results}
    judge.main((run,), **options, splat_transform=(peer(tmp_path, "2.7.1"),))
    [row] = json.loads(results.read_text())["rows"]
    assert (row["scene"], row["at"], row["views"]) == ("wall-a", "photos", 2)
    assert 0 < row["photo_psnr"] < 100 and row["photo_psnr"] != row["dense_psnr"]
    assert "photo PSNR" in " ".join(capsys.readouterr().out.split())


def row(scene: str, method: str, covered: float, at: int | str = 320, keep: float = 0.1, **more: object) -> dict:
    known = {"scene": scene, "keep": keep, "method": method, "at": at, "failed": "", "covered_psnr": covered}
    return known | {"dense_psnr": covered + 5, "photo_psnr": None} | more


def test_means_have_the_median_and_the_worst_with_its_scene():
    rows = [row("rock", "prune", 30.0, dense_lpips=0.1), row("pc_playbot", "prune", 20.0, dense_lpips=0.3)]
    rows += [row("lounge", "prune", 22.0), row("bouquet", "prune", 10.0), row("rock", "prune", 1.0, at=960)]
    judged, wide, tuning, everything, _ = tables.means(rows)
    assert (judged["group"], judged["scenes"], judged["at"]) == ("judged", 3, 320)
    figures = [judged[f"covered_psnr{kind}"] for kind in ("", "_median", "_worst", "_worst_scene")]
    assert figures == [24.0, 22.0, 20.0, "pc_playbot"]
    assert (judged["dense_lpips"], judged["dense_lpips_worst_scene"]) == (pytest.approx(0.2), "pc_playbot")
    assert "photo_psnr" not in judged and wide["at"] == 960 and tuning["scenes"] == 1
    assert (everything["group"], everything["scenes"], everything["covered_psnr_worst_scene"]) == ("all", 4, "bouquet")


def test_leads_are_of_prune_over_the_best_mode_and_of_compact_over_prune_at_each_width():
    a, b = "splat-transform 3.7.0 -d", "splat-transform 2.7.1"
    rows = [row("rock", "prune", 30.0), row("rock", "compact", 33.0), row("rock", a, 28.0), row("rock", b, 29.0)]
    rows += [row("rock", "prune", 20.0, at=960), row("rock", a, 21.0, at=960), row("rock", b, 19.0, at=960)]
    rows += [row("bouquet", "prune", 25.0), row("bouquet", a, 20.0), row("bouquet", b, 99.0, covered_psnr=None)]
    found = {(lead["method"], lead["at"], lead["scene"]): lead for lead in tables.all_leads(rows)}
    figures = {key: (lead["covered_psnr"], lead["covered_psnr_peer"]) for key, lead in found.items()}
    assert figures == {
        ("prune", 320, "rock"): (1.0, b),
        ("prune", 320, "bouquet"): (5.0, a),
        ("compact", 320, "rock"): (3.0, "prune"),
        ("prune", 960, "rock"): (-1.0, a),
    }
    titles = [shown.title for shown in tables.lead_tables(rows)]
    assert [title.split(", PSNR")[0] for title in titles] == [
        "320 pixels wide: prune minus the best mode of splat-transform",
        "960 pixels wide: prune minus the best mode of splat-transform",
        "320 pixels wide: compact minus prune",
    ]
    first = next(iter(tables.lead_tables(rows)))
    names, figures = (list(column.cells) for column in first.columns)
    lines = dict(zip(names, figures, strict=True))
    assert (lines["all mean"], lines["all worst"]) == ("+3.00", "+1.00 rock")
