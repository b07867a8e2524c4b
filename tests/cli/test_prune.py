"""pointsplat prune and export: what they write, and what they say of input that cannot be used."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from refusing import refusal, run

import pointsplat_ns as ps
from killing import KILLED_AFTER_STEPS
from making import ball, normal_scene, quick_start, run_of
from pointsplat_ns.pipeline import prune_file
from pointsplat_ns.pruning import METHODS
from pointsplat_ns.scene.ply import read_ply, write_ply
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.view_sampling.sampler import sample_views
from posing import inria, written

pytestmark = pytest.mark.usefixtures("quick")

SEED = 5


@pytest.fixture()
def ply(tmp_path) -> Path:
    write_ply(normal_scene(80, seed=SEED), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_a_small_scene_stays_in_its_format_or_its_growth_is_said(suffix, ply, tmp_path, capsys):
    scene = tmp_path / f"small{suffix}"
    ps.save(read_ply(ply), scene)
    run("prune", scene, "--keep", "50%", "--by", "opacity")
    assert "note" not in capsys.readouterr().out
    assert len(read_scene(tmp_path / f"small_pruned{suffix}")) == 40
    run("prune", scene, "--keep", "90%", "--by", "opacity", "-o", tmp_path / "large.ply")
    assert f"note: {tmp_path / 'large.ply'} is larger than {scene}: " in capsys.readouterr().out


def test_details_are_said_where_they_are_asked_for(ply, capsys):
    words = ("prune", ply, "--by", "coverage", "--keep", "0.25", "--sh", "0")
    run(*words)
    said = capsys.readouterr().out
    assert "pruned by coverage to 20 of 80 Gaussians (25 %)" in said and "SH degree" not in said
    run(*words, "--force", "--verbose")
    assert "SH degree 3 cut to 0: colours change 100% less with the view" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--by", "best"), f"no method is called 'best'; expected one of {', '.join(METHODS)}"),
        (
            ("--by", "merge", "--opacity-weight", "0.5"),
            "opacity weight 0.5: merge does not weigh opacity",
        ),
        (("--keep", "half"), "keep is 'half'"),
    ],
)
def test_options_that_fit_no_scene_are_refused_before_one_is_read(
    options, message, tmp_path, capsys
):
    (tmp_path / "damaged.ply").touch()
    assert message in refusal(capsys, tmp_path, "prune", tmp_path / "damaged.ply", *options)


@pytest.mark.parametrize("named", ["folder", "ckpt seen from its folder"])
def test_a_run_gets_its_ply_in_its_folder_and_never_among_its_checkpoints(
    named, trained_walls, tmp_path, monkeypatch
):
    folder = tmp_path / "run"
    shutil.copytree(run_of(trained_walls, "wall-a"), folder)
    before = sorted(folder.rglob("*"))
    (checkpoint,) = (folder / "nerfstudio_models").iterdir()
    monkeypatch.chdir(checkpoint.parent)
    run(
        "prune",
        folder if named == "folder" else checkpoint.name,
        "--keep",
        "10%",
        "--by",
        "opacity",
    )
    assert set(folder.rglob("*")) - set(before) == {folder / "pruned.ply"}


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_scene_that_fits_is_said_to_fit_and_a_lossy_file_to_differ(tmp_path, capsys, suffix):
    room = tmp_path / "room.ply"
    scene = ball(300, opacity=1.0, bright=1.0)
    write_ply(scene, room)
    poses = written(inria(sample_views(scene, 5, 64, 48)), tmp_path / "cameras.json")
    run("prune", room, "--keep", "2MB", "--poses", poses, "-o", tmp_path / f"small{suffix}")
    said = capsys.readouterr().out
    assert "nothing is merged, all 300 Gaussians remain" in said
    assert "\nmore than 60 dB, SSIM 1.00: looks the same\n" in said or suffix != ".ply"
    assert re.search(r"(?m)^(more than )?[\d.]+ dB, SSIM \d.\d\d: ", said) and "inf" not in said
    fill = re.search(r"(?m)^fill: ([\d.]+) -> ([\d.]+) Gaussians drawn per pixel$", said)
    assert fill is not None and float(fill[2]) == pytest.approx(float(fill[1]), rel=0.1)


def test_a_scene_that_does_not_fit_is_merged_in_parts(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(prune_file, "MEMORY", prune_file.MemorySettings(base=0, least=100))
    scene = tmp_path / "scene.ply"
    small = tmp_path / "small.ply"
    write_ply(normal_scene(900, degree=1, seed=SEED), scene)
    run("prune", scene, "--keep", "10%", "--sh", "0", "--memory", "200kB", "-o", small, "--json")
    said = json.loads(capsys.readouterr().out)
    assert (said["gaussians_before"], said["gaussians"], said["sh_degree"]) == (900, 90, 0)
    assert len(read_ply(small)) == 90
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.ply", "small.ply"]
    run("prune", scene, "--keep", "10%", "--memory", "8GB", "-o", tmp_path / "whole.ply")
    assert "not compared" not in capsys.readouterr().out


def test_where_memory_is_short_a_scene_is_merged_in_parts_unasked(tmp_path, capsys, monkeypatch):
    write_ply(normal_scene(900, degree=1, seed=SEED), tmp_path / "scene.ply")
    free = psutil.virtual_memory()._replace(available=450_000)  # the scene takes 443,000 in memory
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    run("prune", tmp_path / "scene.ply", "--keep", "90", "-o", tmp_path / "whole.ply")
    assert "not compared" not in capsys.readouterr().out
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free._replace(available=440_000))
    run("prune", tmp_path / "scene.ply", "--keep", "90", "-o", tmp_path / "parts.ply")
    assert (
        "not compared with the dense scene: it does not fit into memory" in capsys.readouterr().out
    )
    assert len(read_ply(tmp_path / "parts.ply")) == 90
    run(
        "prune", tmp_path / "scene.ply", "--by", "opacity", "-o", tmp_path / "score.ply"
    )  # needs less, as before


PROGRAM = """
from pointsplat_ns.cli import main
from pointsplat_ns.pipeline import prune_file
prune_file.MEMORY = prune_file.MemorySettings(base=0, least=100)
killed_after_steps(int(sys.argv[1]))
main(["prune", "scene.ply", "--keep", "10%", *sys.argv[2:]])
"""


def pruned(folder: Path, *words: object, killed_at: int = 0) -> tuple[int, str]:
    """Exit status and text of a command, killed after some of its first process's steps unless that
    is 0."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AFTER_STEPS + PROGRAM, f"{killed_at}", *map(str, words)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
        env=quick_start(),
    )
    return done.returncode, done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills processes")
def test_several_processes_write_the_bytes_of_one_also_after_a_kill(tmp_path):
    write_ply(normal_scene(600, degree=1, seed=3), tmp_path / "scene.ply")
    parts = ("--memory", "50kB", "-o")
    status, said = pruned(tmp_path, *parts, "alone.ply")
    assert status == 0, said
    status, said = pruned(tmp_path, *parts, "shared.ply", "--jobs", 2, killed_at=5)
    assert status != 0 and not (tmp_path / "shared.ply").exists(), said
    assert len(list((tmp_path / ".shared.ply.cells").glob("round*"))) >= 2
    status, said = pruned(tmp_path, *parts, "shared.ply", "--jobs", 2)
    assert status == 0 and said.count("merged to 60 of 600 Gaussians") == 1, said
    assert (tmp_path / "shared.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_several_jobs_for_a_scene_that_fits_into_memory_are_refused(tmp_path, capsys):
    write_ply(normal_scene(50), tmp_path / "scene.ply")
    words = ("prune", tmp_path / "scene.ply", "--keep", "10%", "--jobs")
    fits = "scene.ply: fits into memory; expected no --jobs, which is for merging in parts"
    assert fits in refusal(capsys, tmp_path, *words, 2)
    assert "jobs is 0; expected 1 or more" in refusal(
        capsys, tmp_path, *words, 0, "--memory", "10kB"
    )
