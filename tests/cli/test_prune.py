"""pointsplat prune and export: what they write, and what they say of input that cannot be used."""

import json
import re
import shutil
from pathlib import Path

import psutil
import pytest
import torch
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball, normal_scene, run_of, same
from pointsplat_ns.compression import prune_file
from pointsplat_ns.io import read_ply, read_scene, write_ply
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.merging import cells
from pointsplat_ns.pruning import METHODS, prune
from posing import inria, written

SEED = 5


@pytest.fixture()
def ply(tmp_path) -> Path:
    write_ply(normal_scene(80, seed=SEED), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.fixture(scope="module")
def refined_run(make_refined_run, trained_walls, tmp_path_factory) -> Path:
    return make_refined_run(tmp_path_factory.mktemp("refined"), trained_walls, ("wall-b",), moved=0.5)


def test_prune_scores_as_it_is_told(ply, tmp_path):
    run("prune", ply, "--keep", "9", "--by", "authors", "-o", tmp_path / "authors.ply")
    run("prune", ply, "--keep", "9", "--by", "paper", "--opacity-weight", "1.0", "-o", tmp_path / "opacity.ply")
    dense = read_ply(ply)
    assert same(read_ply(tmp_path / "authors.ply"), prune(dense, 9, "authors"))
    assert same(read_ply(tmp_path / "opacity.ply"), prune(dense, 9, "opacity"))


def test_prune_refuses_what_is_no_scene(ply, refined_run, tmp_path, capsys):
    half = tmp_path / "half.ply"
    half.write_bytes(ply.read_bytes()[:-100])
    write_ply(normal_scene(3, seed=SEED).map(lambda value: value * torch.nan), tmp_path / "nothing.ply")
    for words, said in (
        ([tmp_path / "gone.ply"], "gone.ply: no such file"),
        ([refined_run], "another method"),
        ([half], "half.ply"),
        ([tmp_path / "nothing.ply"], "holds no Gaussians"),
        ([ply, "--by", "paper", "--opacity-weight", 2], "opacity_weight is 2.0; expected 0 to 1"),
        ([ply, "--by", "authors", "--opacity-weight", 2], "opacity_weight is 2.0; expected 0 to 1"),
    ):
        assert said in refusal(capsys, tmp_path, "prune", *words, "-o", tmp_path / "out.ply")


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_a_small_scene_stays_in_its_format_or_its_growth_is_said(suffix, ply, tmp_path, capsys):
    scene = tmp_path / f"small{suffix}"
    ps.save(read_ply(ply), scene)
    run("prune", scene, "--keep", "50%", "--by", "opacity")
    assert "note" not in capsys.readouterr().out
    assert len(read_scene(tmp_path / f"small_pruned{suffix}")) == 40
    run("prune", scene, "--keep", "90%", "--by", "opacity", "-o", tmp_path / "large.ply")
    assert f"note: {tmp_path / 'large.ply'} is larger than {scene}: " in capsys.readouterr().out


def test_a_dry_run_says_all_and_writes_nothing(ply, tmp_path, capsys):
    before = sorted(tmp_path.iterdir())
    run("prune", ply, "--by", "coverage", "--keep", "0.25", "--sh", "0", "--dry-run")
    said = capsys.readouterr().out
    assert sorted(tmp_path.iterdir()) == before
    assert "dry run, nothing is written: pruned by coverage to 20 of 80 Gaussians (25 %)" in said
    assert "SH degree" not in said
    run("prune", ply, "--by", "coverage", "--keep", "0.25", "--sh", "0", "--dry-run", "--verbose")
    assert "SH degree 3 cut to 0: colours change 100% less with the view" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--by", "best"), f"no method is called 'best'; expected one of {', '.join(METHODS)}"),
        (("--by", "merge", "--opacity-weight", "0.5"), "opacity weight 0.5: merge does not weigh opacity"),
        (("--keep", "half"), "keep is 'half'"),
        (("--plot", "out.jpg"), "ends in .png"),
    ],
)
def test_options_that_fit_no_scene_are_refused_before_one_is_read(options, message, tmp_path, capsys):
    (tmp_path / "damaged.ply").touch()
    assert message in refusal(capsys, tmp_path, "prune", tmp_path / "damaged.ply", *options)


@pytest.mark.parametrize("named", ["folder", "ckpt seen from its folder"])
def test_a_run_gets_its_ply_in_its_folder_and_never_among_its_checkpoints(named, trained_walls, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    shutil.copytree(run_of(trained_walls, "wall-a"), folder)
    before = sorted(folder.rglob("*"))
    (checkpoint,) = (folder / "nerfstudio_models").iterdir()
    monkeypatch.chdir(checkpoint.parent)
    run("prune", folder if named == "folder" else checkpoint.name, "--keep", "10%", "--by", "opacity")
    assert set(folder.rglob("*")) - set(before) == {folder / "pruned.ply"}


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_a_scene_that_fits_is_said_to_fit_and_a_lossy_file_to_differ(tmp_path, capsys, suffix):
    room, scene = tmp_path / "room.ply", ball(300, opacity=1.0, bright=1.0)
    write_ply(scene, room)
    poses = written(inria(sample_views(scene, 5, 64, 48)), tmp_path / "cameras.json")
    run("prune", room, "--keep", "2MB", "--poses", poses, "-o", tmp_path / f"small{suffix}")
    said = capsys.readouterr().out
    assert "nothing is merged, all 300 Gaussians fit as they are" in said
    assert "\nmore than 60 dB, SSIM 1.00: looks the same\n" in said or suffix != ".ply"
    assert re.search(r"(?m)^(more than )?[\d.]+ dB, SSIM \d.\d\d: ", said) and "inf" not in said


def test_a_scene_that_does_not_fit_is_merged_in_parts_and_resumed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(prune_file, "MEMORY", prune_file.MemorySettings(base=0, least=100))
    scene, small = tmp_path / "scene.ply", tmp_path / "small.ply"
    write_ply(normal_scene(900, degree=1, seed=SEED), scene)
    words = ("prune", scene, "--keep", "10%", "--sh", "0", "--memory", "200kB", "-o")
    run(*words, small, "--json")
    said = json.loads(capsys.readouterr().out)
    assert (said["gaussians_before"], said["gaussians"], said["sh_degree"]) == (900, 90, 0)
    assert len(read_ply(small)) == 90
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.ply", "small.ply"]
    steps, write = [], cells.write_tensors

    def interrupted(path, *rest):
        if len(steps) == 6:
            raise KeyboardInterrupt
        steps.append(path.name)
        write(path, *rest)

    with monkeypatch.context() as patch, pytest.raises((SystemExit, KeyboardInterrupt)):
        patch.setattr(cells, "write_tensors", interrupted)
        run(*words, tmp_path / "resumed.ply")
    assert len(list((tmp_path / ".resumed.ply.cells").glob("*.safetensors"))) == 6
    monkeypatch.setattr(cells, "write_tensors", lambda path, *rest: (steps.append(path.name), write(path, *rest)))
    run(*words, tmp_path / "resumed.ply")
    assert (tmp_path / "resumed.ply").read_bytes() == small.read_bytes() and len(steps) == len(set(steps))
    capsys.readouterr()
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
    assert "not compared with the dense scene: it does not fit into memory" in capsys.readouterr().out
    assert len(read_ply(tmp_path / "parts.ply")) == 90
    run("prune", tmp_path / "scene.ply", "--by", "opacity", "-o", tmp_path / "score.ply")  # needs less, as before
