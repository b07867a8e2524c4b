"""Cells of tables, and their files."""

import json
import math
import re
from dataclasses import replace

import pytest
import torch

from lab.tables import outputs
from lab.tables.cells import BINS, TABLE_FILES, CellJournal, distributions
from lab.tables.layout import Layout, Table, latex_table, markdown_table
from lab.tables.means import read_groups
from lab.tables.outputs import medians, write_tables
from lab.tables.ways import WAYS
from making import ball
from pointsplat_ns.errors import SceneError
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


def set_cell(**changes):
    return lambda content: content["cells"][1].update(changes)


def set_point(**changes):
    return lambda content: content["cells"][1]["point"].update(changes)


@pytest.mark.parametrize(
    "change",
    [
        *("", "{", "[]", "null", "[" * 100_000, "\x00\xff"),
        lambda content: content.pop("cells"),
        lambda content: content.update(format="pointsplat-tradeoff-points"),
        lambda content: content.update(cells=3),
        lambda content: content["of"].update(views="many"),
        lambda content: content["cells"].append(None),
        set_cell(unknown=1),
        set_cell(way=["merge"]),
        set_cell(opacities=[1] * (BINS.opacity - 1)),
        set_cell(volumes=["1"] * BINS.volume),
        set_point(gaussians=True),
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
    over = scenes.shared([("merge", 0.1)])
    mean, parts = scenes.mean("merge", 0.1, over), [scene.cells["merge", 0.1].point for scene in scenes.scenes]
    assert mean.scenes == 2 and mean.worst == "kitchen" and mean.worst_psnr == parts[1].against_photos.psnr
    assert mean.worst_loss == pytest.approx(30 - parts[1].against_photos.psnr)
    assert mean.photos.psnr == pytest.approx(sum(part.against_photos.psnr for part in parts) / 2)
    assert mean.fps == pytest.approx(1000.0) and mean.gaussians == 100 and mean.megabytes == pytest.approx(0.0248)
    alone = rooms.mean("merge", 0.1, frozenset({"a_room"}))
    assert alone.photos is None and alone.worst_loss is None and alone.worst == "a_room"
    assert scenes.mean("merge", 0.77, over) is None


def test_a_table_takes_its_means_over_the_same_scenes(tmp_path):
    """A dense scene more changes no row, and a row that lacks a scene is marked."""
    every = {way.name for way, _ in WAYS.cells((0.3, 0.1))}
    write_scene(tmp_path, "fox")
    write_scene(tmp_path, "kitchen", worse=2.0, without=("pointsplat",))
    write_scene(tmp_path, "attic", worse=9.0, without=(*(every - {"dense"}),))
    [group] = read_groups(tmp_path)
    one, two, _, four = Layout(group, (0.3,), {}).tables()
    assert one.title.endswith("2 scenes") and rows_of(one)["100 %", "3DGS (dense)"][-1] == "2"
    both = [
        scene.cells["paper", 0.1].point.against_photos.psnr for scene in group.scenes if scene.about.name != "attic"
    ]
    assert rows_of(one)["10 %", "PointSplat*"][0] == f"{sum(both) / 2:.2f}"
    assert rows_of(one)["10 %", "PointSplat"][-1] == rows_of(two)["10 %", "PointSplat"][-1] == "1 †"
    assert any("not over the scenes of the other rows (fox, kitchen)" in note for note in one.notes)
    assert [row[-1] for row in four.sections[0]] == ["2", "2", "2", "2", "1 †"]
    assert latex_table(one).count(r" & 1 \textdagger{} \\") == 2


def test_frames_that_were_timed_on_a_busy_machine_do_not_count(tmp_path):
    journal = write_scene(tmp_path, "fox")
    one = journal.cells["merge", 0.1]
    for changes in ({"others_cores": 100.0}, {"frame_ms": 0.0}):
        journal.add(replace(one, point=replace(one.point, **changes)), journal.about, IDENTITY)
        [group] = read_groups(tmp_path)
        over = frozenset({"fox"})
        assert group.mean("merge", 0.1, over).fps is None and group.mean("paper", 0.1, over).fps == pytest.approx(1000)


def test_a_mean_of_photos_needs_photos_of_all_scenes(tmp_path):
    write_scene(tmp_path, "fox")
    write_scene(tmp_path, "splat", photos=False)
    [group] = read_groups(tmp_path)
    mean = group.mean("merge", 0.1, frozenset({"fox", "splat"}))
    assert mean.photos is None and mean.renders is not None


@pytest.mark.parametrize(
    "datasets, expected",
    [(("Replica",) * 2, "Replica"), (("Replica", ""), ""), (("", ""), ""), (("nuScenes",) * 2, "")],
)
def test_a_group_is_of_a_dataset_if_all_its_scenes_are(tmp_path, datasets, expected):
    for number, dataset in enumerate(datasets):
        write_scene(tmp_path, f"room{number}", "Replica", dataset)
    [group] = read_groups(tmp_path)
    assert group.dataset == expected


@pytest.fixture()
def plain_figure(monkeypatch):
    monkeypatch.setattr(outputs, "plot_figure", lambda groups, path: path.write_text("a figure"))


def test_names_cannot_leave_their_cells_nor_start_commands():
    name = "a|b\n\\input{/etc/passwd} % $x^2$ ~ &"
    table = Table(1, name, (name, "b"), (((name, "c"),),), (name,))
    text = latex_table(table)
    assert r"\input" not in re.sub(r"^%.*$", "", text, flags=re.MULTILINE)
    assert all(line.count(" & ") == 1 for line in text.splitlines() if line.endswith(r"\\"))
    rows = [line for line in markdown_table(table).splitlines() if line.startswith("| ")]
    assert [len(re.findall(r"(?<!\\)\|", row)) for row in rows] == [3, 3]


def rows_of(table: Table) -> dict[tuple[str, str], tuple[str, ...]]:
    return {row[:2]: row[2:] for section in table.sections for row in section}


def test_tables_have_the_papers_rows(tmp_path):
    write_scene(tmp_path, "fox")
    [group] = read_groups(tmp_path)
    one, two, three, four = Layout(group, (0.3,), {}).tables()
    assert [len(section) for section in one.sections] == [1, 12, 12]
    assert one.header[:5] == ("kept", "method", "PSNR", "SSIM", "LPIPS") and one.header[-1] == "scenes"
    first = rows_of(one)
    assert first["100 %", "3DGS (dense)"] == ("30.00", "0.800", "0.200", "-", "0.900", "0.100", "fox 30.00", "1")
    point = group.scenes[0].cells["merge", 0.1].point
    assert first["10 %", "merge (our default)"][0] == f"{point.against_photos.psnr:.2f}"
    assert first["10 %", "merge (our default)"][6] == (
        f"fox {point.against_photos.psnr:.2f} ({point.against_photos.psnr - 30:+.2f})"
    )
    assert rows_of(two)["10 %", "PUP-3DGS"] == ("100", "1000", "0.0248", "1")
    assert [row[:2] for section in three.sections for row in section] == [
        (weight, name) for weight in ("0.1", "0.3", "0.5", "0.7", "0.9") for name in ("PointSplat*", "PointSplat")
    ]
    [ablation] = four.sections
    assert [row[:4] for row in ablation] == [
        ("I", "", "", ""),
        ("II", "yes", "", ""),
        ("III", "yes", "", "yes"),
        ("IV", "yes", "yes", ""),
        ("V", "yes", "yes", "yes"),
    ]
    assert all(len(row) == len(table.header) for table in (one, two, three, four) for s in table.sections for row in s)


@pytest.mark.parametrize("name, dataset", [("room0", ""), ("office0", ""), ("410c470782", ""), ("room0", "replica")])
def test_the_papers_figures_never_stand_beside_other_datasets(tmp_path, plain_figure, name, dataset):
    """Whatever scenes and groups are called."""
    write_scene(tmp_path, name, "Replica", dataset)
    [group] = write_tables(tmp_path, (0.3, 0.1), {})
    assert group.name == "Replica"
    assert not [column for table in Layout(group, (0.3,), {}).tables() for column in table.header if "paper" in column]
    assert json.loads((tmp_path / "tables.json").read_text())["paper"] == {}
    text = (tmp_path / "tables.md").read_text() + (tmp_path / "tables.tex").read_text()
    assert "(paper)" not in text and "39.40" not in text and "29.81" not in text


def test_they_stand_beside_ours_where_the_dataset_is_the_same(tmp_path, plain_figure):
    write_scene(tmp_path, "room0", "Replica", "Replica")
    write_scene(tmp_path, "0a5c013435", "ScanNet++", "ScanNet++")
    first, second = write_tables(tmp_path, (0.3, 0.1), {})
    assert (first.name, second.name) == ("ScanNet++", "Replica")
    one, two, three, four = Layout(second, (0.3,), {}).tables()
    assert one.header[-3:] == three.header[-3:] == ("scenes", "PSNR (paper)", "SSIM (paper)")  # its LPIPS is by VGG
    assert rows_of(one)["10 %", "PointSplat"][-2:] == ("29.81", "0.902")
    assert rows_of(one)["10 %", "merge (our default)"][-2:] == ("-", "-")
    assert "paper" not in str(two.header) and "paper" not in str(four.header)  # the paper does not say of which scenes
    assert rows_of(Layout(first, (0.3,), {}).tables()[3])["V", "yes"][-2:] == ("23.46", "0.855")
    assert "do not say of which scenes they are" in (tmp_path / "tables.md").read_text()
    assert json.loads((tmp_path / "tables.json").read_text())["paper"]["Replica"]["table 1, pup, 10%"]["psnr"] == 17.34


def test_another_protocol_than_the_papers_is_named_in_place_of_its_figures(tmp_path, plain_figure):
    write_scene(tmp_path, "room0", "Replica", "Replica")
    write_scene(tmp_path, "room1", "Replica", "Replica", differs="10 of 200 held-out photos")
    [group] = write_tables(tmp_path, (0.3, 0.1), {})
    assert group.dataset == "Replica" and group.comparable_dataset == ""
    assert "paper" not in str([table.header for table in Layout(group, (0.3,), {}).tables()])
    text = (tmp_path / "tables.md").read_text()
    assert "| differs from the paper in |" in text and "| 64 x 48 | 10 of 200 held-out photos |" in text
    assert json.loads((tmp_path / "tables.json").read_text())["paper"] == {}


def test_figure_4_is_drawn_and_its_medians_are_those_of_the_bins(tmp_path):
    write_scene(tmp_path, "fox")
    write_scene(tmp_path, "hall", "halls", without=("paper", "merge", "pup", "lightgaussian", "dense"))
    groups = read_groups(tmp_path)
    outputs.plot_figure(groups, tmp_path / "figure4.png")
    assert (tmp_path / "figure4.png").read_bytes()[:4] == b"\x89PNG"
    found = {group.name: medians(group) for group in groups}
    assert found["halls"] == {} and found["scenes"] == {
        "dense": (pytest.approx(9.5 / 40), pytest.approx(-20 + 9.5 / 2))
    }
