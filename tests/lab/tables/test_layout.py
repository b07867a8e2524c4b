"""Tables of cells that are known in advance."""

import json

import pytest
import torch

from lab.tables import layout
from lab.tables.cells import FILES, Tables
from lab.tables.figure import OPACITY_EDGES, VOLUME_EDGES, distributions
from lab.tables.layout import Layout, Table, write_tables
from lab.tables.ways import WAYS, cell_key
from making import ball


def add_scene(
    tables, name, group="scenes", dataset="", worse=0.0, photos=True, without=(), differs=""
):
    """Add the cells of a scene of 1,000 Gaussians at 30 and 10 %, in all ways but those without."""
    about = {
        "name": name,
        "path": name,
        "dataset": dataset,
        "group": group,
        "origin": "held-out photos",
    }
    about |= {"machine": "a machine", "views": 3, "width": 64, "height": 48, "differs": differs}
    tables.scenes[name] = about
    for number, (way, share) in enumerate(WAYS.cells((0.3, 0.1))):
        if way.name in without:
            continue
        lost = 0.0 if way == WAYS.dense else 1 + worse + 0.1 * number
        key = cell_key(name, way, share)
        point = {
            "key": key,
            "label": way.label,
            "command": "",
            "share": share,
            "sh_degree": 3,
            "seconds": 1.5,
        }
        point |= {
            "gaussians": round(1000 * share),
            "bytes": round(248_000 * share),
            "frame_ms": 10 * share,
            "frame_ms_torch": 70 * share,
            "fill": 20 * share,
        }
        nets = {"lpips": 0.2, "lpips_vgg": 0.3}
        point["against_dense"] = {"psnr": 40 - lost if lost else None, "ssim": 0.9}
        point["against_photos"] = {"psnr": 30 - lost, "ssim": 0.8, **nets} if photos else None
        if not photos:
            point["against_dense"] |= nets
        cell = {
            "way": way.name,
            "point": point,
            "made_with": "",
            "seed": 0,
            "version": "0.1.0",
            "commit": "",
        }
        for kind, edges in (("opacities", OPACITY_EDGES), ("volumes", VOLUME_EDGES)):
            counts = [0] * 9 + [7] + [0] * (len(edges) - 11)
            cell[kind] = counts if way in WAYS.figure_4 else None
        tables.cells[key] = cell
    return tables


def tables_of(tables, keeps=(0.3,)):
    """Tables 1 to 4 of the only group."""
    [(group, names)] = tables.groups().items()
    return Layout(tables, group, names, keeps).tables()[:4]


def rows_of(table: Table) -> dict[tuple[str, str], tuple[str, ...]]:
    return {row[:2]: row[2:] for row in table.rows}


def photos_psnr(tables, key):
    return tables.cells[key]["point"]["against_photos"]["psnr"]


def test_distributions_count_every_gaussian_once():
    scene = ball(50)
    opacities, volumes = distributions(scene)
    assert sum(opacities) == sum(volumes) == 50
    assert opacities[-1] == int((scene.alphas >= 1 - 1 / len(opacities)).sum())
    flat = scene.replace(scales=torch.full_like(scene.scales, -float("inf")))
    assert distributions(flat)[1][0] == 50


def test_tables_have_the_papers_rows():
    tables = add_scene(Tables(), "fox")
    one, two, three, four = tables_of(tables)
    heads = ("kept", "method", "PSNR", "SSIM", "LPIPS", "LPIPS VGG", "PSNR (renders)")
    assert len(one.rows) == 31 and one.header[:7] == heads
    first = rows_of(one)
    merged = photos_psnr(tables, "fox/merge/10%")
    assert first["100 %", "3DGS (dense)"] == (
        "30.00",
        "0.800",
        "0.200",
        "0.300",
        "-",
        "0.900",
        "fox 30.00",
        "",
        "1",
    )
    row = first["10 %", "merge (our default)"]
    assert (row[0], row[6]) == (f"{merged:.2f}", f"fox {merged:.2f} ({merged - 30:+.2f})")
    assert rows_of(two)["10 %", "PUP-3DGS"] == ("100", "0.0248", "1.0", "7.0", "2.0", "1")
    names = [
        (weight, name)
        for weight in ("0.1", "0.3", "0.5", "0.7", "0.9")
        for name in ("PointSplat*", "PointSplat, unseen", "PointSplat, own photos")
    ]
    assert [row[:2] for row in three.rows] == names
    assert [row[0] for row in four.rows] == ["I", *sorted(2 * ["II", "III", "IV", "V"])]
    assert [row[4] for row in four.rows] == ["", *4 * ["other scenes", "own photos"]]
    assert four.rows[4][1:4] == ("yes", "", "yes")
    assert all(
        len(row) == len(table.header) for table in (one, two, three, four) for row in table.rows
    )


def test_a_table_takes_its_means_over_the_same_scenes():
    """A dense scene more changes no row, and a row that lacks a scene is marked."""
    every = {way.name for way, _ in WAYS.cells((0.3, 0.1))}
    tables = add_scene(Tables(), "fox")
    add_scene(tables, "kitchen", worse=2.0, without=("pointsplat",))
    add_scene(tables, "attic", worse=9.0, without=(*(every - {"dense"}),))
    one, two, _, four = tables_of(tables)
    assert one.title.endswith("2 scenes") and rows_of(one)["100 %", "3DGS (dense)"][-1] == "2"
    both = [photos_psnr(tables, f"{name}/paper/10%") for name in ("fox", "kitchen")]
    row = rows_of(one)["10 %", "PointSplat*"]
    assert (
        row[0] == f"{sum(both) / 2:.2f}"
        and row[6] == f"kitchen {both[1]:.2f} ({both[1] - 30:+.2f})"
    )
    unseen = "10 %", "PointSplat, unseen"
    assert rows_of(one)[unseen][-1] == rows_of(two)[unseen][-1] == "1 †"
    assert any("not over the scenes of the other rows (fox, kitchen)" in note for note in one.notes)
    assert [row[-1] for row in four.rows] == [*7 * ["2"], "1 †", "2"]


@pytest.fixture()
def written(monkeypatch, tmp_path):
    """A function that writes tables without the figure, and gives the text of all files."""
    monkeypatch.setattr(
        layout, "plot_figure", lambda cells, groups, path: path.write_text("a figure")
    )

    def write(tables):
        write_tables(tables, tmp_path, (0.3, 0.1))
        return {name: (tmp_path / name).read_text() for name in FILES}

    return write


@pytest.mark.parametrize(
    "name, dataset, differs",
    [
        ("room0", "", ""),
        ("410c470782", "", ""),
        ("room0", "replica", ""),
        ("room0", "Replica", "10 of 200 photos"),
    ],
)
def test_the_papers_figures_never_stand_beside_another_dataset_or_protocol(
    written, name, dataset, differs
):
    tables = add_scene(Tables(), name, "Replica", dataset, differs=differs)
    files = written(tables)
    assert not [
        column for table in tables_of(tables) for column in table.header if "paper" in column
    ]
    text = files["tables.md"]
    assert json.loads(files["tables.json"])["paper"] == {}
    assert "(paper)" not in text and "39.40" not in text and "29.81" not in text
    assert not differs or f"| 64 x 48 | {differs} |" in text


def test_they_stand_beside_ours_where_the_dataset_is_the_same(written):
    tables = add_scene(Tables(), "room0", "Replica", "Replica")
    add_scene(tables, "0a5c013435", "ScanNet++", "ScanNet++")
    files = written(tables)
    assert [*tables.groups()] == ["ScanNet++", "Replica"]
    one, two, three, four = Layout(tables, "Replica", ["room0"], ()).tables()[:4]
    papers = ("scenes", "PSNR (paper)", "SSIM (paper)", "LPIPS VGG (paper)")
    assert one.header[-4:] == three.header[-4:] == papers
    for protocol in ("unseen", "own photos"):
        row = rows_of(one)["10 %", f"PointSplat, {protocol}"]
        assert row[-3:] == ("29.81", "0.902", "0.276")
    assert rows_of(one)["10 %", "merge (our default)"][-3:] == ("-", "-", "-")
    assert "paper" not in str(two.header) and "paper" not in str(
        four.header
    )  # the paper does not say of which scenes
    first = Layout(tables, "ScanNet++", ["0a5c013435"], ()).tables()
    assert rows_of(first[3])["V", "yes"][-3:] == ("23.46", "0.855", "0.374")
    assert (
        json.loads(files["tables.json"])["paper"]["Replica"]["table 1, pup, 10%"]["psnr"] == 17.34
    )
