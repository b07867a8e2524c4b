"""``--json``: standard output has one JSON value, which says what was written; and what a pipe gets
otherwise."""

import json
import logging
import re
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import ball, box_room
from pointsplat_ns.cli import main
from pointsplat_ns.pipeline import view_provider
from pointsplat_ns.system.files import bytes_text
from pointsplat_ns.view_sampling.sampler import sample_views

pytestmark = pytest.mark.usefixtures("quick")

COUNT = 60


@pytest.fixture()
def ply(tmp_path, monkeypatch) -> Path:
    """A scene in the folder of the test, which is where commands run."""
    ps.save(ball(COUNT, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    monkeypatch.chdir(tmp_path)
    return Path("room.ply")


@pytest.fixture()
def as_json(capsys):
    def run(*words: object) -> dict:
        main([*map(str, words), "--json"])
        return json.loads(capsys.readouterr().out)

    return run


def written(result: dict) -> ps.Gaussians:
    """The scene that a result names, after what is said of it was compared with it."""
    scene = ps.load(result["output"])
    file = Path(result["output"])
    assert (result["gaussians"], result["sh_degree"]) == (len(scene), scene.sh_degree)
    assert result["bytes"] == file.stat().st_size and result["seconds"] > 0
    return scene


def test_prune_convert_and_export_say_what_they_wrote(ply, as_json):
    pruned = as_json("prune", ply, "--keep", "50%")
    assert len(written(pruned)) == COUNT // 2 and pruned["gaussians_before"] == COUNT
    assert pruned["output"] == "room_pruned.ply"
    assert len(written(as_json("convert", ply, "room.spz"))) == COUNT
    parameters = {f"_model.gauss_params.{name}": value for name, value in ball(7).items()}
    torch.save({"step": 9, "pipeline": parameters}, "step-000000009.ckpt")
    exported = as_json("export", "step-000000009.ckpt", "-o", "seven.ply")
    assert len(written(exported)) == 7
    assert "gaussians_before" not in exported


def test_lod_and_tradeoff_print_their_files(ply, as_json, tmp_path, monkeypatch):
    assert as_json("lod", ply, "--levels", "50%") == {
        "output": "room_lod",
        **json.loads(Path("room_lod/lod.json").read_text("utf-8")),
    }
    views = sample_views(box_room(0, COUNT), 2, 24, 18)
    monkeypatch.setattr(
        view_provider.Sampler, "views", lambda sampler, count, *_, **options: views[:count]
    )
    few = ("--views", "2", "--repairs", "none", "--keep", "10%")
    assert as_json("tradeoff", ply, *few) == {
        "output": "room_tradeoff",
        **json.loads(Path("room_tradeoff/tradeoff.json").read_text("utf-8")),
    }


@pytest.mark.parametrize("form", [["-o", "levels.rad"], ["--tiles"], ["--stream"]])
def test_lod_prints_the_size_of_what_it_writes_and_of_no_ply(form, ply, capsys):
    main(["lod", str(ply), "--levels", "50%", *form])
    said = capsys.readouterr().out
    path = Path(re.search(r"(?m)^(.+): 2 levels of ", said)[1])
    files = [file for file in (path, *path.rglob("*")) if file.is_file()]
    assert f", {bytes_text(sum(file.stat().st_size for file in files))} in all" in said
    assert [line.split("│")[4].strip() for line in said.splitlines() if "level_" in line] == [
        "-",
        "-",
    ]


def test_what_libraries_print_and_what_is_found_go_to_standard_error(ply, capsys, monkeypatch):
    found = ps.info(ball(5))

    def chatty(path, **options):
        print("a library speaks")
        logging.getLogger("pointsplat_ns").info("a finding")
        return found

    monkeypatch.setattr("pointsplat_ns.info", chatty)
    main(["info", str(ply), "--json"])
    said = capsys.readouterr()
    assert json.loads(said.out)["gaussians"] == 5
    assert said.err.splitlines() == ["a library speaks", "a finding"]
