"""Files of cameras that lie beside a scene: which are used, which are not, and what is said."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import run_of
from pointsplat_ns.cli import main
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.pipeline.options import ViewOptions
from pointsplat_ns.pipeline.photos import posed_scene
from pointsplat_ns.pipeline.subject import read_subject
from posing import inria, nerfstudio, write_photos, write_sparse

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def views(scene) -> ps.Views:
    return ps.sample_views(scene, 6, 64, 48)


def known(path: Path, poses: str | None = None) -> ps.Views | None:
    return read_subject(path, ViewOptions(poses=poses)).given


def same(found: ps.Views | None, views: ps.Views) -> bool:
    return found is not None and torch.allclose(found.viewmats, views.viewmats.double(), atol=1e-5)


@pytest.mark.parametrize("place", ["point_cloud/iteration_30000/point_cloud.ply", "room.ply"])
def test_cameras_that_3dgs_training_wrote_are_used_and_named(place, scene, views, tmp_path, said):
    path = tmp_path / place
    path.parent.mkdir(parents=True, exist_ok=True)
    ps.save(scene, path)
    (tmp_path / "cameras.json").write_text(json.dumps(inria(views)))
    assert same(known(path), views)
    assert f"poses: {tmp_path / 'cameras.json'}; --poses none" in said.text
    main(["prune", str(path), "--keep", "100", "--poses", "none"])
    assert (
        known(path, "none") is None
        and known(path.parent / path.name, str(tmp_path / "cameras.json")) is not None
    )


def test_poses_of_another_frame_are_not_used(scene, views, tmp_path, said):
    ps.save(scene, tmp_path / "room.ply")
    poses = invert_rigid(views.viewmats.double())
    poses[:, :3, 3] += 1000
    (tmp_path / "cameras.json").write_text(
        json.dumps(inria(replace(views, viewmats=invert_rigid(poses))))
    )
    assert (
        known(tmp_path / "room.ply") is None and "cameras.json: not used for views: " in said.text
    )


@pytest.mark.parametrize("kind", ["transforms.json", "colmap", "colmap above"])
def test_poses_of_data_count_where_they_are_asked_for_and_no_photo_is_opened_before(
    kind, scene, views, tmp_path, said, monkeypatch
):
    """Their frame is that of the data, which may be another scene's. Photos tell, and are opened
    for who names the poses."""
    path = tmp_path / ("out/room.ply" if kind == "colmap above" else "room.ply")
    path.parent.mkdir(exist_ok=True)
    ps.save(scene, path)
    if kind == "transforms.json":
        named = tmp_path / kind
        named.write_text(json.dumps(nerfstudio(views)))
    else:
        named = write_sparse(views, tmp_path / "sparse" / "0")
    write_photos(scene, views, tmp_path / "images")
    opened = []
    read = posed_scene.read_reduced
    monkeypatch.setattr(
        posed_scene, "read_reduced", lambda *given: opened.append(given) or read(*given)
    )
    assert known(path) is None and "its frame may differ; --poses" in said.text
    assert not opened
    assert same(known(path, str(named)), views) and len(opened) == len(views)
    write_photos(scene, views[torch.arange(len(views)).flip(0).tolist()], tmp_path / "images")
    with pytest.raises(ps.DataError, match="match the photos of their views no better than"):
        known(path, str(named))


def test_no_photo_is_opened_for_cameras_that_nobody_named(scene, views, tmp_path, monkeypatch):
    ps.save(scene, tmp_path / "room.ply")
    (tmp_path / "cameras.json").write_text(json.dumps(inria(views)))
    write_photos(scene, views, tmp_path)
    monkeypatch.setattr(posed_scene, "read_reduced", lambda *_: pytest.fail("a photo is opened"))
    assert same(known(tmp_path / "room.ply"), views)


def test_damaged_files_beside_a_scene_stop_nothing(scene, tmp_path, said):
    ps.save(scene, tmp_path / "room.ply")
    (tmp_path / "cameras.json").write_text("[{}]")
    (tmp_path / "transforms.json").write_text("{")
    assert known(tmp_path / "room.ply") is None and said.text.count("not used for views") == 2


def test_none_passes_over_the_dataset_of_a_run_too(trained_walls):
    run = run_of(trained_walls, "wall-a")
    assert read_subject(run, ViewOptions()).views().known(3) is not None
    assert read_subject(run, ViewOptions(poses="none")).views().known(3) is None
