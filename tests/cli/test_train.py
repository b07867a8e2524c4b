"""``pointsplat train``: the layout of a capture is recognised, and the run has as many Gaussians as were asked for."""

import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
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
