"""Trained runs: everything needed from a run comes from its folder alone."""

import json
import logging

import pytest
import torch
from refusing import fails

from making import normal_scene
from pointsplat_ns.scene.discovery import find_runs
from pointsplat_ns.scene.inert_yaml import Tagged
from pointsplat_ns.scene.reading import read_scene, save
from pointsplat_ns.scene.runs import open_run


def test_the_newest_checkpoint_of_a_run_is_found(make_run):
    folder = make_run(steps=(1999, 9999, 29999))
    run = open_run(folder)
    assert (run.folder, run.config_path) == (folder, folder / "config.yml")
    assert run.checkpoint == folder / "nerfstudio_models" / "step-000029999.ckpt"
    assert run.step == 29999


def test_the_names_of_a_run_are_those_of_its_config(make_run):
    run = open_run(make_run())
    names = (run.method_name, run.experiment_name, run.timestamp)
    assert names == ("splatfacto", "kitchen", "2024-05-06_070809")
    assert run.is_gaussian_scene


def test_the_data_and_dataparser_of_a_run_are_those_of_its_config(make_run, tmp_path):
    run = open_run(make_run())
    assert run.data == tmp_path / "data" / "kitchen"
    module = "nerfstudio.data.dataparsers.nerfstudio_dataparser"
    assert run.dataparser_class == f"{module}.NerfstudioDataParserConfig"
    assert run.dataparser_fields["eval_mode"] == "fraction"
    assert run.dataparser_fields["train_split_fraction"] == 0.9
    assert not {"_target", "data"} & run.dataparser_fields.keys()


def test_settings_of_a_run_are_those_of_its_config(make_run):
    run = open_run(make_run())
    assert run.datamanager_fields["camera_res_scale_factor"] == 1.0
    assert "dataparser" not in run.datamanager_fields
    names = ("sh_degree", "rasterize_mode", "background_color")
    assert [run.model_fields[name] for name in names] == [3, "classic", "random"]
    assert isinstance(run.model_fields["camera_optimizer"], Tagged)


def test_the_transform_of_a_run_is_that_of_its_dataparser(make_run):
    folder = make_run()
    transform = {"transform": [[1, 0, 0, 0.25], [0, 0, 1, -2], [0, -1, 0, 0]], "scale": 0.125}
    (folder / "dataparser_transforms.json").write_text(json.dumps(transform))
    run = open_run(folder)
    assert run.transform.tolist() == transform["transform"] and run.scale == 0.125


@pytest.mark.parametrize(
    "content",
    [
        '{"scale": 1}',
        '{"transform": [[1, 0], [0, 1]], "scale": 1}',
        '{"transform": "no", "scale": 1}',
        json.dumps({"transform": torch.eye(4)[:3].tolist(), "scale": 0}),
        json.dumps({"transform": [[float("nan")] * 4] * 3, "scale": 1}),
        json.dumps({"transform": torch.eye(4)[:3].tolist(), "scale": 1, "note": "x" * 100_000}),
    ],
)
def test_damaged_transforms_are_said(make_run, content):
    folder = make_run()
    (folder / "dataparser_transforms.json").write_text(content)
    fails(lambda: open_run(folder), folder / "dataparser_transforms.json", "transform", "scale")


def test_an_incomplete_newest_checkpoint_gives_way_to_the_one_before(make_run, caplog):
    folder = make_run(steps=(1999, 9999))
    newest = folder / "nerfstudio_models" / "step-000009999.ckpt"
    newest.write_bytes(newest.read_bytes()[:-100])
    with caplog.at_level(logging.WARNING, "pointsplat_ns"):
        assert open_run(folder).step == 1999
    assert f"{newest}: not a complete checkpoint" in caplog.text


def test_what_is_no_run_is_said(tmp_path):
    fails(lambda: open_run(tmp_path / "none"), "no such file or folder")
    fails(lambda: open_run(tmp_path), tmp_path, "not a nerfstudio run", "config.yml")
    (tmp_path / "config.yml").write_text("!!python/object:a.B {x: 1}")
    fails(lambda: open_run(tmp_path), tmp_path / "config.yml", "lacks the object 'pipeline'")


def test_other_methods_are_passed_over_and_said_where_nothing_is_left(make_run, tmp_path):
    folder = make_run(method="nerfacto")
    assert not open_run(folder).is_gaussian_scene
    fails(
        lambda: find_runs(tmp_path),
        tmp_path,
        "no trained Splatfacto run below it",
        f"{folder}: method nerfacto",
    )
    (tmp_path / "empty").mkdir()
    fails(lambda: find_runs(tmp_path / "empty"), "EXPERIMENT/METHOD/TIME/config.yml")
    fails(lambda: find_runs(tmp_path / "none"), "no such folder")


def test_anything_else_is_refused_with_what_is_accepted(tmp_path):
    accepted = "tileset.json), a checkpoint of Splatfacto, gsplat or 3DGS (.ckpt, .pt, .pth)"
    (tmp_path / "scene.obj").write_bytes(b"")
    fails(
        lambda: read_scene(tmp_path / "scene.obj"), tmp_path / "scene.obj", "a .obj file", accepted
    )
    fails(lambda: read_scene(tmp_path), "a folder without config.yml or meta.json", accepted)
    fails(lambda: read_scene(tmp_path / "none.ply"), "no such file", accepted)
    fails(
        lambda: save(normal_scene(), tmp_path / "a.obj"), "cannot write a .obj file", ".spz, .sog"
    )
    fails(
        lambda: save(normal_scene(), tmp_path / "a.rad"),
        "cannot write a RAD file here",
        "lod SCENE -o",
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.obj"]
