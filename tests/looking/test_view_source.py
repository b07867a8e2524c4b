"""Where a scene is looked at from: given views, the poses of its dataset, poses sampled in free space."""

import dataclasses
from pathlib import Path

import pytest
import torch

from making import ball, box_room
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.sizes import sides_of
from pointsplat_ns.looking.traces import PhotoPlaces
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.views import Views


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(400)


def run_of(trained_walls: Path, name: str) -> Path:
    (run,) = (trained_walls / name / "splatfacto-cpu").iterdir()
    return run


def test_a_bare_scene_is_looked_at_from_sampled_poses(scene):
    bare = ViewSource(scene, run="scene.ply", dataset_views=dataset_views)
    assert len(bare.views(2)) == 2
    assert bare.origin.startswith("poses sampled in free space, up is ")


def test_a_run_is_looked_at_from_its_own_poses(scene, trained_walls):
    source = ViewSource(scene, run=run_of(trained_walls, "wall-b"), dataset_views=dataset_views)
    views = source.views(4)
    assert len(views) == 4 and source.origin == "poses of the dataset"
    assert (views.width, views.height) == (64, 48) and views.rasterize_mode == "antialiased"
    assert views.background.tolist() == [1.0, 1.0, 1.0]


def test_known_views_are_given_or_those_of_the_dataset_and_never_sampled(scene, trained_walls):
    assert ViewSource(scene, run="scene.ply", dataset_views=dataset_views).known(4) is None
    of_run = ViewSource(scene, run=run_of(trained_walls, "wall-b"), dataset_views=dataset_views)
    known = of_run.known(4)
    assert known is not None and len(known) == 4 and of_run.origin == "poses of the dataset"
    given = sample_views(scene, 6, 32, 24)
    assert len(ViewSource(scene, given=given).known(3)) == 3
    assert ViewSource(scene, given=given[:0]).known(3) is None


def data_is_gone(path: Path | str) -> Views:
    raise SceneError("its data is not there")


def test_a_run_whose_data_is_gone_is_looked_at_from_sampled_poses(scene, trained_walls):
    source = ViewSource(scene, run=run_of(trained_walls, "wall-b"), dataset_views=data_is_gone)
    assert len(source.views(2)) == 2
    assert source.origin == f"poses sampled in free space, up is {source.up} (no dataset: its data is not there)"


def test_a_run_whose_data_is_gone_and_whose_scene_shows_nothing_has_no_views(scene, trained_walls):
    nothing = ViewSource(scene[:0], run=run_of(trained_walls, "wall-a"), dataset_views=data_is_gone)
    with pytest.raises(DataError, match="nothing of the scene can be seen"):
        nothing.views(2)
    assert nothing.origin == ""


def test_given_views_go_before_all_others(scene, trained_walls):
    given = sample_views(scene, 3, 48, 36)
    source = ViewSource(scene, given, run_of(trained_walls, "wall-a"), data_is_gone)
    assert source.views(9) is given and source.origin == "given views"
    with pytest.raises(DataError, match="the views given are empty"):
        ViewSource(scene, given[:0]).views(3)


def test_renders_are_compared_in_few_views_of_a_middle_size(scene):
    given = sample_views(scene, 2, 900, 600)
    many = given[[0, 1] * 20]
    compared = ViewSource(scene, given=many).compared()
    assert len(compared) == VIEW_COUNTS.compared
    assert compared.width == sides_of(900, 600)[1] and ViewSource(scene, given=many).whole().width == 900


def test_a_resolution_that_is_asked_for_is_that_of_sampled_views_and_bounds_given_ones(scene):
    asked = ViewSource(scene, resolution=(96, 54)).views(2)
    assert (asked.width, asked.height) == (96, 54)
    given = sample_views(scene, 2, 900, 600)
    assert ViewSource(scene, given=given, resolution=(300, 200)).views(2).width == 300
    assert next(ViewSource(scene, given=given, resolution=(300, 200)).others()).width == 300


def test_a_scene_without_known_views_is_repaired_before_another_background_as_well(scene):
    views = ViewSource(scene, resolution=(64, 48)).others()
    behind = [next(views).background.tolist() for _ in range(10)]
    assert behind.count([1.0, 1.0, 1.0]) == 2 and behind.count([0.0, 0.0, 0.0]) == 8


def test_views_that_are_sampled_beside_too_few_known_ones_are_drawn_as_these_are(scene):
    given = dataclasses.replace(sample_views(scene, 2, 64, 48), rasterize_mode="antialiased")
    assert next(ViewSource(scene, given=given).others()).rasterize_mode == "antialiased"


def test_sampled_poses_near_photo_places_say_so(monkeypatch):
    asked = []
    photos = PhotoPlaces(torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64), torch.ones(1))
    monkeypatch.setattr(
        "pointsplat_ns.looking.sampling.photo_places", lambda scene, settings: asked.append(scene) or photos
    )
    source = ViewSource(box_room(0))
    assert len(source.views(3)) and len(source.compared())
    assert source.origin.startswith("poses sampled in free space, half of them where photos were taken, up is ")
    assert len(asked) == 1  # the search for photo places takes seconds


def test_up_is_as_named_or_estimated():
    scene = box_room(0, 3000)
    sideways = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    named, estimated = ViewSource(scene, up=Up(sideways)), ViewSource(scene)
    assert str(named.up) == "x" and named.up.sure
    rolls = [source.views(3).viewmats[:, 0, :3] @ source.up.direction for source in (named, estimated)]
    assert all(float(roll.abs().max()) < 1e-6 for roll in rolls)
    assert named.origin.endswith("up is x") and estimated.origin.endswith(f"up is {estimated.up}")
