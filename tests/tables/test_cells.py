"""cells.json: what is put in comes out, and what is not ours is refused."""

import json
import math
from dataclasses import replace

import pytest
import torch

from making import ball
from pointsplat_ns.errors import SceneError
from pointsplat_ns.tables.cells import BINS, TABLE_FILES, CellJournal, distributions
from pointsplat_ns.tables.means import read_groups
from pointsplat_ns.tables.ways import WAYS
from table_cells import IDENTITY, about, cell, write_scene


@pytest.fixture()
def written(tmp_path):
    """A folder with two cells of a fox."""
    journal = CellJournal(tmp_path, "fox")
    journal.add(cell("fox", WAYS.dense, 1.0, math.inf, 30.0), about("fox"), IDENTITY)
    journal.add(cell("fox", WAYS.merge, 0.1, 31.25, 27.5), about("fox"), IDENTITY)
    return tmp_path


def test_cells_are_read_back_as_they_were(written):
    again = CellJournal(written, "fox")
    assert again.about == about("fox")
    assert again.cells == {
        ("dense", 1.0): cell("fox", WAYS.dense, 1.0, math.inf, 30.0),
        ("merge", 0.1): cell("fox", WAYS.merge, 0.1, 31.25, 27.5),
    }


def test_a_cell_measured_again_takes_the_place_of_the_older_one(written):
    newer = cell("fox", WAYS.merge, 0.1, 32.0, 28.0)
    CellJournal(written, "fox").add(newer, about("fox"), IDENTITY)
    assert CellJournal(written, "fox").cells["merge", 0.1] == newer


@pytest.mark.parametrize("name, value", [("file", "abd"), ("most views", 4), ("machine", "another")])
def test_cells_of_something_else_are_refused(written, name, value):
    with pytest.raises(
        SceneError, match=rf"fox.{TABLE_FILES.cells}: its cells are of another scene's tables \({name}: .*--force"
    ):
        CellJournal(written, "fox").check({**IDENTITY, name: value})


def test_a_scene_can_change_its_group(written):
    CellJournal(written, "fox").regroup("animals")
    again = CellJournal(written, "fox")
    assert again.about.group == "animals" and len(again.cells) == 2
    again.check(IDENTITY)


def set_cell(**changes):
    return lambda content: content["cells"][1].update(changes)


def set_point(**changes):
    return lambda content: content["cells"][1]["point"].update(changes)


@pytest.mark.parametrize(
    "change",
    [
        *("", "{", "[]", "null", "[" * 100_000, "\x00\xff"),
        lambda content: content.pop("cells"),
        lambda content: content.pop("of"),
        lambda content: content.update(format="pointsplat-tradeoff-points"),
        lambda content: content.update(version=1),
        lambda content: content.update(cells=3),
        lambda content: content["of"].pop("group"),
        lambda content: content["of"].update(views="many"),
        lambda content: content["cells"].append(None),
        lambda content: content["cells"][1].pop("commit"),
        set_cell(unknown=1),
        set_cell(seed="0"),
        set_cell(way=["merge"]),
        set_cell(opacities=[1] * (BINS.opacity - 1)),
        set_cell(opacities=[-1] * BINS.opacity),
        set_cell(volumes=["1"] * BINS.volume),
        set_cell(volumes=7),
        set_point(gaussians=True),
        set_point(frame_ms=None),
        set_point(against_dense=None),
        set_point(against_photos={"psnr": 1.0, "ssim": "good", "lpips": None}),
    ],
)
def test_cells_that_are_none_are_refused(written, change):
    path = written / "fox" / TABLE_FILES.cells
    content = json.loads(path.read_text())
    if not isinstance(change, str):
        change(content)
    path.write_text(change if isinstance(change, str) else json.dumps(content))
    with pytest.raises(SceneError, match=f"{TABLE_FILES.cells}: not the cells of a scene's tables .*--force"):
        CellJournal(written, "fox")


def test_cells_under_another_scenes_name_are_refused(written):
    (written / "fox").rename(written / "dog")
    with pytest.raises(SceneError, match="not the cells of dog"):
        read_groups(written)


def test_distributions_count_every_gaussian_once():
    scene = ball(50)
    opacities, volumes = distributions(scene, "paper", 0.5)
    assert sum(opacities) == sum(volumes) == 50
    assert opacities[-1] == int((scene.alphas >= 1 - 1 / BINS.opacity).sum())
    flat = scene.replace(scales=torch.full_like(scene.scales, -math.inf))
    assert distributions(flat, "paper", 0.5)[1][0] == 50
    assert distributions(scene, "paper", 0.3) == (None, None)


def test_means_are_over_scenes_and_name_the_one_that_loses_most(tmp_path):
    write_scene(tmp_path, "fox")
    write_scene(tmp_path, "kitchen", worse=2.0)
    write_scene(tmp_path, "a_room", group="rooms", photos=False)
    scenes, rooms = sorted(read_groups(tmp_path), key=lambda group: -len(group.scenes))
    mean, parts = scenes.mean("merge", 0.1), [scene.cells["merge", 0.1].point for scene in scenes.scenes]
    assert mean.scenes == 2 and mean.worst == "kitchen" and mean.worst_psnr == parts[1].against_photos.psnr
    assert mean.worst_loss == pytest.approx(30 - parts[1].against_photos.psnr)
    assert mean.photos.psnr == pytest.approx(sum(part.against_photos.psnr for part in parts) / 2)
    assert mean.fps == pytest.approx(1000.0) and mean.gaussians == 100 and mean.megabytes == pytest.approx(0.0248)
    alone = rooms.mean("merge", 0.1)
    assert alone.photos is None and alone.worst_loss is None and alone.worst == "a_room"
    assert scenes.mean("merge", 0.77) is None


def test_frames_that_were_timed_on_a_busy_machine_do_not_count(tmp_path):
    journal = write_scene(tmp_path, "fox")
    one = journal.cells["merge", 0.1]
    for changes in ({"others_cores": 100.0}, {"frame_ms": 0.0}):
        journal.add(replace(one, point=replace(one.point, **changes)), journal.about, IDENTITY)
        [group] = read_groups(tmp_path)
        assert group.mean("merge", 0.1).fps is None and group.mean("paper", 0.1).fps == pytest.approx(1000)


def test_a_mean_of_photos_needs_photos_of_all_scenes(tmp_path):
    write_scene(tmp_path, "fox")
    write_scene(tmp_path, "splat", photos=False)
    [group] = read_groups(tmp_path)
    assert group.mean("merge", 0.1).photos is None and group.mean("merge", 0.1).renders is not None


@pytest.mark.parametrize(
    "datasets, expected",
    [(("Replica",) * 2, "Replica"), (("Replica", ""), ""), (("", ""), ""), (("nuScenes",) * 2, "")],
)
def test_a_group_is_of_a_dataset_if_all_its_scenes_are(tmp_path, datasets, expected):
    for number, dataset in enumerate(datasets):
        write_scene(tmp_path, f"room{number}", "Replica", dataset)
    [group] = read_groups(tmp_path)
    assert group.dataset == expected
