"""pointsplat compact: what it writes and says, and what it refuses."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import pytest
import torch
from refusing import refusal, run

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from html_parts import parts_of
from making import ball, same
from pointsplat_ns.cli.compact import GOALS
from pointsplat_ns.pipeline import quality
from pointsplat_ns.pruning import METHODS, prune
from pointsplat_ns.refinement import Refiner, refiner_preset, save_refiner
from pointsplat_ns.scene.discovery import find_scenes
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import read_ply, write_ply
from pointsplat_ns.scene.reading import read_scene, save
from pointsplat_ns.system.files import bytes_text
from pointsplat_ns.tools import comparison_plots as pictures
from pointsplat_ns.tools.pages.flight import FlightFrame

pytestmark = pytest.mark.usefixtures("quick")


def room(n: int = 150) -> Gaussians:
    return ball(n, log_size=-1.0, opacity=1.0, bright=1.0)


@pytest.fixture(scope="module")
def ply(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("compact") / "room.ply"
    write_ply(room(), path)
    return path


@pytest.fixture(scope="module")
def helps(tmp_path_factory) -> Path:
    """A file with a refiner that adds 0.05 to every log-scale."""
    torch.manual_seed(1)
    refiner = Refiner(refiner_preset("tiny"))
    with torch.no_grad():
        [*refiner.heads.mlps["scales"].modules()][-1].bias.fill_(0.05)
    save_refiner(
        refiner,
        path := tmp_path_factory.mktemp("helps") / "r.safetensors",
        {"keep": 0.5, "by": "opacity"},
    )
    return path


def test_refinement_that_helps_is_written_and_shown(ply, helps, tmp_path, capsys):
    output = tmp_path / "new" / "small.ply"
    run(
        "compact",
        ply,
        "--refiner",
        helps,
        "-o",
        output,
        "--picture",
        tmp_path / "shown.png",
        "--verbose",
    )
    kept = prune(read_ply(ply), 0.5, "opacity")
    assert same(read_ply(output), kept.replace(scales=kept.scales + 0.05))
    said = capsys.readouterr().out
    assert re.search(
        r"small.ply: pruned by opacity and refined to 75 of 150 Gaussians \(50 %\), .* kB, in .* s",
        said,
    )
    lines = said.splitlines()
    figures = r"([\d.]+) -> ([\d.]+) dB PSNR .* \(12 views of .*; worst .* dB, better in \d+"
    found = re.match(f"refined by the network: {figures}", lines[1])
    assert float(found[2]) > float(found[1])
    assert lines[0].startswith("views: sampled poses, up is ") and "small.ply: " in lines[2]
    assert "shown.png: dense, pruned, refined, side by side" in said
    height, width, _ = matplotlib.image.imread(tmp_path / "shown.png").shape
    assert width == 1600 and height > 1200  # three columns and rows of 4 to 3, and a line of titles
    assert [p.name for p in output.parent.iterdir()] == ["small.ply"]


def test_a_page_to_fly_through_both_scenes_is_written(ply, helps, tmp_path, capsys, monkeypatch):
    """It names the files and their sizes, in their formats, and opens as ``pointsplat view``
    does."""
    output = tmp_path / "small.sog"
    shown = tmp_path / "shown.html"
    titles: list[str] = []
    monkeypatch.setattr(pictures, "side_by_side", lambda rows, given, path: titles.extend(given))
    run(
        "compact",
        ply,
        "--refiner",
        helps,
        "-o",
        output,
        "--html",
        shown,
        "--picture",
        tmp_path / "shown.png",
    )
    said = capsys.readouterr().out
    assert f"{shown}: {bytes_text(shown.stat().st_size)}, to fly through in a browser" in said
    text = shown.read_text("utf-8")
    quality = re.search(r"(?m)^[\d.]+ dB, SSIM 0.\d\d: .*", said)[0]
    assert f">{quality}<" in text and "<h1>room</h1>" in text
    flight = parts_of(shown).data["flight"]
    files = [f"{path.name}, {bytes_text(path.stat().st_size)}" for path in (ply, output)]
    assert [(scene["name"], scene["amount"]) for scene in flight["scenes"]] == [
        (f"dense ({files[0]})", "150 Gaussians"),
        (f"compact ({files[1]})", "75 Gaussians"),
    ]
    assert titles[0].splitlines()[2:] == files[:1]
    assert titles[-1].splitlines()[2:] == [files[1], *quality.split(": ")]
    assert (
        flight["views"] == FlightFrame.of(read_scene(ply)).data([])["views"]
        and len(flight["views"]) == 6
    )


@pytest.mark.parametrize("goal", [name for name in GOALS if name])
def test_a_goal_is_a_format_a_budget_and_a_page(goal, tmp_path, monkeypatch, capsys):
    """The budget is an upper bound, so this scene is whole; its page has it alone. Options replace
    the goal's parts."""
    monkeypatch.chdir(tmp_path)
    write_ply(room(), "my room.ply")
    wanted = GOALS[goal]
    file = Path(f"my room_{goal}{GOALS[goal].suffix}")
    page = Path(f"my room_{goal}.html")
    run("compact", "my room.ply", "--for", goal)
    said = capsys.readouterr().out
    assert "all 150 Gaussians remain" in said and len(read_scene(file)) == 150
    assert page.exists() == wanted.page and ("use a smaller --keep" in said) == (goal == "headset")
    if wanted.page:
        [shown] = parts_of(page).data["flight"]["scenes"]
        assert (shown["name"], shown["amount"]) == ("my-room", "150 Gaussians")
        assert f"{page}: {bytes_text(page.stat().st_size)}, to " in said
    assert ('<iframe src="my%20room_web.html" title="my-room"' in said) == (goal == "web")
    assert [*find_scenes(tmp_path)] == ["my room"]
    words = ("compact", "my room.ply", "--for", goal)
    run(*words, "--keep", "50%", "--html", "both.html", "--effort", "instant", "--force")
    assert (
        len(read_scene(file)) == 75
        and len(parts_of(Path("both.html")).data["flight"]["scenes"]) == 2
    )
    refused = refusal(capsys, tmp_path, *words, "-o", "small.ply")
    assert (
        f"small.ply: --for {goal} writes {wanted.suffix}; expected that suffix, or --keep in place"
        in refused
    )


@pytest.mark.parametrize(
    ("psnr", "other"),
    [
        (20.0, "compact 'a room.spz' --keep 30% -o 'a room_30.spz'"),
        (30.0, "compact 'a room.spz' --for web"),
        (40.0, "compact 'a room.spz' --keep 3% -o 'a room_3.spz'"),
    ],
)
def test_without_options_two_commands_come_next(psnr, other, tmp_path, monkeypatch, capsys):
    """Both work as they are printed; the result has the format of the scene."""
    monkeypatch.chdir(tmp_path)
    save(room(), "a room.spz")
    measured = quality.quality_of_file
    monkeypatch.setattr(
        quality, "quality_of_file", lambda *given: replace(measured(*given), psnr=psnr)
    )
    run("compact", "a room.spz")
    *_, first, second = capsys.readouterr().out.splitlines()
    assert first == "next: pointsplat view 'a room.spz' 'a room_compact.spz'"
    assert second == f"      pointsplat {other}" and len(read_scene("a room_compact.spz")) == 15
    run(*shlex.split(other), "--effort", "instant")
    assert "next: " not in capsys.readouterr().out


def test_what_cannot_be_used_is_refused_in_one_line_and_early(
    ply, helps, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(
        "pointsplat_ns.pipeline.compact_scene.prune_scene", None
    )  # a call of it would be no error of ours
    save_refiner(Refiner(refiner_preset("tiny", sh_degree=0)), tmp_path / "flat.safetensors")
    shown = tmp_path / "shown"
    for scene, options, wanted in (
        (ply, ("--refiner", ply), "expected a trained pointsplat run"),
        (ply, ("-o", tmp_path / "small.obj"), ".spz, .sog"),
        (ply, ("--refiner", tmp_path / "flat.safetensors"), "SH degree 1, but the refiner"),
        (tmp_path / "gone.ply", ("--refiner", helps), "gone.ply: no such file"),
        (ply, ("--seconds", "-1"), "the time to repair is -1 s; expected 0 or more"),
        (ply, ("--keep", "half"), "keep is 'half'"),
        (ply, ("--by", "best"), f"expected one of {', '.join(METHODS)}"),
        (ply, ("--picture", shown.with_suffix(".jpg")), "ends in .png"),
        (ply, ("--html", shown.with_suffix(".png")), "ends in .html"),
    ):
        output = () if "-o" in options else ("-o", tmp_path / "small.ply")
        assert wanted in refusal(capsys, tmp_path, "compact", scene, *options, *output), options
