"""Commands that train, make levels and tables."""

import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main
from pointsplat_ns.nerfstudio_plugin.captures import dataparser_for


@pytest.mark.parametrize(
    ("files", "name"),
    [
        (["transforms.json"], "NerfstudioDataParserConfig"),
        (["traj.txt", "results/frame000000.png"], "ReplicaDataParserConfig"),
        (["dslr/nerfstudio/transforms.json", "transforms.json"], "SeededScanNetppDataParserConfig"),
        (["colmap/sparse/0/cameras.bin", "colmap/cameras.bin"], "ColmapDataParserConfig"),
        (["sparse/cameras.bin"], "ColmapDataParserConfig"),
        (["sparse/0/cameras.txt"], "ColmapDataParserConfig"),
    ],
)
def test_a_capture_is_read_by_the_dataparser_of_its_files(files, name, tmp_path):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    found = dataparser_for(tmp_path)
    assert type(found).__name__ == name
    if name == "ColmapDataParserConfig":
        assert found.colmap_path == Path(files[0]).parent


def test_a_run_of_exactly_as_many_gaussians_is_trained(wall_scene, tmp_path, capsys):
    main(["train", str(wall_scene), "--keep", "0.2k", "--steps", "30", "-o", str(tmp_path)])
    said = capsys.readouterr().out.splitlines()[-1]
    run, _, rest = said.partition(": ")
    assert rest == "a run of 200 Gaussians" and Path(run).parent == tmp_path / wall_scene.name / "splatfacto-cpu"
    assert len(ps.load(run)) == 200


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["no_such"], "no_such: no such folder; expected a capture"),
        (["."], r"\.: no capture that is known; expected transforms.json, a COLMAP model"),
        ([".", "--keep", "0"], "--keep 0: expected a number of Gaussians, at least 1"),
        ([".", "--steps", "0"], "0 steps at a scale of 1; expected at least 1"),
        ([".", "--scale", "1.5"], "7000 steps at a scale of 1.5; expected .* up to 1"),
    ],
)
def test_what_cannot_be_trained_is_said_in_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["train", *words])
    assert end.value.code == 1
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert re.search(message, said)
    assert not list(tmp_path.iterdir())


@pytest.fixture()
def ply(tmp_path) -> Path:
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def run(*args) -> None:
    main([str(a) for a in args])


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), {}),
        (("--levels", "10%", "0.5", "20", "--sh", "0"), {"levels": [0.5, "10%", 20], "sh": "0"}),
        (("--levels", "0.01MB"), {"levels": ["0.01MB"]}),
    ],
)
def test_pointsplat_lod_writes_what_lod_gives_bit_for_bit(arguments, options, ply, tmp_path):
    run("lod", ply, *arguments, "-o", tmp_path / "by_command")
    ps.lod(ply, **options).save(tmp_path / "by_api")
    assert contents(tmp_path / "by_command") == contents(tmp_path / "by_api")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--levels", "50%", "200"), "levels 50% and 200 both mean 200 of 400 Gaussians"),
        (("--levels", "auto:35"), "level auto:35: expected a ratio"),
        (("-o", "levels.ply"), "levels.ply: levels are several files; expected the name of a folder"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line_and_writes_nothing(arguments, message, ply, tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        run("lod", ply, *arguments)
    said = capsys.readouterr()
    assert caught.value.code == 1 and said.out == ""
    [line] = said.err.splitlines()
    assert line.startswith("error: ") and message in line
    assert [path.name for path in tmp_path.iterdir()] == ["room.ply"]
