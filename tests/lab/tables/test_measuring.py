"""Tables of a small room, really measured: every way, what cannot be measured, and going on."""

import json
import os
from pathlib import Path

import pytest

import pointsplat_ns as ps
from lab.common.ways import SplatTransform
from lab.tables.cells import Tables
from lab.tables.fine_tune import FINE_TUNING
from lab.tables.make_scene import Refiners
from lab.tables.measure import Judge
from lab.tables.ways import WAYS, Ways
from making import box_room
from peers import peer
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.rendering.comparison.closeness import DenseReference

pytestmark = pytest.mark.usefixtures("quick")


def cells_of(tables) -> dict:
    """Cells of the only scene, by way and share."""
    return {(cell["way"], cell["point"]["share"]): cell for cell in tables.cells.values()}


@pytest.fixture()
def all_weights(weights):
    """Weights for every row."""
    wanted = {way.network for way, _ in WAYS.cells((0.3,)) if way.network}
    return [
        weights(
            f"{network.encoder}-{network.by}-{network.opacity_weight}-{network.use_appearance:d}{network.use_position:d}-{scenes}",
            {
                "scenes": scenes,
                "supervision": "photos",
                "by": network.by,
                "keep": 0.1,
                "more_keeps": [0.3],
                "opacity_weight": network.opacity_weight,
                "steps": 24,
            },
            encoder=network.encoder,
            use_appearance=network.use_appearance,
            use_position=network.use_position,
        )
        for network in wanted
        for scenes in ("elsewhere", "room")
    ]


def test_every_cell_can_be_measured_and_says_by_what(measured, all_weights, tmp_path):
    tables = measured(refiners=all_weights, splat_transform=peer(tmp_path, "3.7.0"))
    cells = cells_of(tables)
    timed = {"dense", *(way.name for way in WAYS.table_2)}
    assert {*cells} == {
        (way.name, share) for way, share in WAYS.cells((0.3,))
    } and tables.missing == {}
    for (way, share), cell in cells.items():
        point = cell["point"]
        assert (
            point["gaussians"] == round(400 * share)
            and point["key"] == f"room/{way}/{100 * share:g}%"
        )
        assert (
            point["command"].startswith("python -m lab.tables ")
            and f"--only {point['key']}" in point["command"]
        )
        assert cell["version"] == ps.__version__ and cell["seed"] == 0 and point["frame_ms"] > 0
        assert point["against_photos"] is None and (
            way == "dense" or point["against_dense"]["psnr"] < 100
        )
        assert (cell["opacities"] is not None) == (way in {shown.name for shown in WAYS.figure_4})
    psnr = {
        way: cell["point"]["against_dense"]["psnr"]
        for (way, share), cell in cells.items()
        if share == 0.3
    }
    assert (
        psnr["lightgaussian-tuned"] != psnr["lightgaussian"] and psnr["pointsplat"] != psnr["paper"]
    )
    assert psnr["splat-transform"] != psnr["splat-transform-adaptive"]
    made_with = {way: cell["made_with"] for (way, share), cell in cells.items() if share == 0.3}
    assert (
        made_with["splat-transform"] == "splat-transform 3.7.0 -d"
        and made_with["pup-tuned"] == "2 of 5,000 steps"
    )
    assert made_with["pointsplat"].endswith(
        "(664,563 parameters; norm by scene; dual encoder, trained on scenes pruned by paper, "
        "lambda 0.3, keep 0.1, 0.3; steps 24, supervision photos; 1 scenes)"
    )
    assert cells["pointsplat", 0.3]["made_with"] != cells["pointsplat-own", 0.3]["made_with"]
    assert all(
        (cell["point"]["frame_ms_torch"] is None) == (way not in timed)
        and cell["point"]["fill"] > 0
        for (way, _), cell in cells.items()
    )
    page = (tmp_path / "tables" / "tables.md").read_text()
    assert "| 30 % | LightGaussian |" in page and "| 2 of 5,000 steps | 1 |" in page
    assert "| weights " in page and "| PointSplat, own photos |" in page
    assert (
        "--refiners" in cells["pointsplat", 0.3]["point"]["command"] and "not measured" not in page
    )
    assert Tables.read(tmp_path / "tables").cells == json.loads(json.dumps(tables.cells))


def test_a_cell_is_what_the_functions_of_the_package_make(measured, room):
    cells = cells_of(measured(only=["room/paper-0.7/*", "room/merge/*"]))
    dense = ps.load(room)
    for way, share, small in (
        ("paper-0.7", 0.1, ps.prune(dense, 0.1, "paper", opacity_weight=0.7)),
        ("merge", 0.3, ps.prune(dense, 0.3)),
    ):
        wanted, _ = DenseReference(dense, ps.sample_views(dense, 2, 48, 36)).psnr(small)
        assert cells[way, share]["point"]["against_dense"]["psnr"] == pytest.approx(
            wanted, abs=1e-4
        )


def test_what_cannot_be_measured_is_not_and_says_why(measured, tmp_path, weights):
    """Weights that ship, or that were trained for another selection, stand in for nobody's."""
    other = weights("merged", {"by": "merge", "keep": 0.1})
    tables = measured(refiners=[other], only=["room/dense/*", "room/p*/*", "room/splat*/*"])
    ways = {way for way, _ in cells_of(tables)}
    assert (
        not ways & {"pointsplat", "pointsplat-own", "paper-splatformer", "splat-transform"}
        and "paper" in ways
    )
    said = json.loads((tmp_path / "tables" / "tables.json").read_text())["not_measured"]
    assert said == tables.missing
    assert said["room/pointsplat/30%"].startswith(
        "no weights were given (--refiners) of a dual encoder, trained on"
    )
    assert (
        said["room/splat-transform/30%"]
        == "splat-transform cannot be run (/no/such/program: FileNotFoundError)"
    )
    rows = [
        line
        for line in (tmp_path / "tables" / "tables.md").read_text().splitlines()
        if "| PointSplat, " in line
    ]
    assert rows and all("| not measured | - |" in line for line in rows)


TRAIN = (
    "to train them: ns-train pointsplat --data OTHER_SCENES --pipeline.model.encoder dual "
    "--pipeline.model.by paper --pipeline.model.keep 0.3 --pipeline.model.opacity-weight 0.3"
)


@pytest.mark.parametrize(
    ("trained", "why"),
    [
        ({"keep": 20_000}, TRAIN),
        ({"keep": 0.1, "more_keeps": [0.2]}, TRAIN),
        ({"keep": 0.3, "scenes": ["hall", "room"]}, "were trained on this scene"),
        ({"keep": 0.3, "scenes": ""}, "do not say which scenes they were trained on"),
    ],
)
def test_weights_of_another_budget_or_that_know_the_scene_fill_no_row(
    measured, weights, trained, why
):
    other = weights("other", {"by": "paper", **trained})
    tables = measured(refiners=[other], only=["room/pointsplat/30%", "room/paper/30%"])
    assert [*cells_of(tables)] == [("paper", 0.3)] and why in tables.missing["room/pointsplat/30%"]


@pytest.mark.parametrize(
    ("trained", "why"),
    [
        ({"scenes": "hall"}, "were not trained on this scene"),
        ({"scenes": "hall, room", "supervision": "dense"}, "were trained on dense targets, not on"),
        ({"scenes": "hall, room", "supervision": "photos"}, ""),
    ],
)
def test_rows_of_own_photos_take_weights_of_these_photos_alone(measured, weights, trained, why):
    own = weights("own", {"by": "paper", "keep": 0.3, **trained})
    tables = measured(refiners=[own], only=["room/pointsplat-own/30%"])
    assert why in tables.missing.get("room/pointsplat-own/30%", "")
    assert [*cells_of(tables)] == ([] if why else [("pointsplat-own", 0.3)])


def test_of_folders_above_runs_the_newest_of_each_name_counts(weights, tmp_path):
    file = weights("any", {"by": "paper", "keep": 0.3})
    for number, folder in enumerate(("a/pointsplat/2", "a/pointsplat/1", "deep/b/pointsplat/run")):
        target = tmp_path / "outputs" / folder / "refiner.safetensors"
        target.parent.mkdir(parents=True)
        target.write_bytes(file.read_bytes())
        os.utime(target, (number, number))
    newest = ["a/pointsplat/1", "deep/b/pointsplat/run"]
    for given in (tmp_path / "outputs", tmp_path):
        found = [each.path for each in Refiners([given]).all]
        assert found == [tmp_path / "outputs" / each for each in newest]
    [one] = Refiners([tmp_path / "outputs" / "a"]).all
    assert one.path == tmp_path / "outputs" / newest[0]
    [shipped] = Refiners([Path("shipped")]).all
    assert shipped.path == Path("shipped"), "commands are the same on every machine"
    assert shipped.network == WAYS.pointsplat.network and "room35" not in shipped.trained_on


def test_fine_tuning_has_the_rounds_and_rates_of_the_publications(measured, monkeypatch):
    tables = measured(only=["room/pup-tuned/10%", "room/lightgaussian-tuned/10%"], keeps=(0.1,))
    cells = cells_of(tables)
    two_rounds = [step for step, _ in cells["pup-tuned", 0.1]["curve"]]
    assert two_rounds == [0, 1, 2, 2, 3, 4]
    curve = cells["lightgaussian-tuned", 0.1]["curve"]
    assert [step for step, _ in curve] == [0, 1, 2] and curve[0][1] != curve[2][1]
    assert cells["pup-tuned", 0.1]["point"]["gaussians"] == 40
    late = FINE_TUNING["lightgaussian"].rates(4999, reach=2.0)
    assert late["opacities"] == pytest.approx(0.05 * 0.95**12)
    assert late["means"] == pytest.approx(2 * 1.6e-6)
    assert FINE_TUNING["pup"].rates(4999, reach=2.0)["opacities"] == 0.05


def test_an_interrupted_run_goes_on_and_loses_nothing(measured, tmp_path, monkeypatch):
    few = ("dense", "paper", "lightgaussian")
    every = Ways.cells
    monkeypatch.setattr(
        Ways, "cells", lambda *given: [cell for cell in every(*given) if cell[0].name in few]
    )
    figures = Judge.figures
    asked = []

    def interrupted(self, scene, timed):
        asked.append(scene)
        if len(asked) == 4:
            raise KeyboardInterrupt
        return figures(self, scene, timed)

    with monkeypatch.context() as patch:
        patch.setattr(Judge, "figures", interrupted)
        with pytest.raises(KeyboardInterrupt):
            measured()
    before = Tables.read(tmp_path / "tables").cells
    assert [*before] == ["room/dense/100%", "room/paper/10%", "room/paper/30%"]
    assert "3DGS (dense)" in (tmp_path / "tables" / "tables.md").read_text()
    after = measured().cells
    assert {
        key: after[key] for key in before
    } == before  # also their times: they are not measured again
    monkeypatch.setattr(
        Judge, "figures", lambda *args: pytest.fail("nothing is left to be measured")
    )
    measured()


def test_tables_are_of_all_scenes_of_the_folder(measured, tmp_path, room):
    ps.save(box_room(1, 300), tmp_path / "hall.ply")
    only = ["*/paper/30%", "*/dense/*"]
    measured(only=only, groups=["halls=room"])
    assert measured(tmp_path / "hall.ply", only=only).groups() == {
        "halls": ["room"],
        "scenes": ["hall"],
    }
    both = measured(tmp_path / "hall.ply", room, only=only, groups=["both=room,hall"])
    assert both.groups() == {"both": ["hall", "room"]}


@pytest.mark.parametrize(
    "options, said",
    [
        (
            {"only": ["room/magic/10%"]},
            "room/magic/10%: no such cell; expected a name such as fox/merge/10%",
        ),
        ({"keeps": (0.3, 1.5)}, "keeps are 0.3, 1.5; expected shares"),
        ({"views": 0}, "views: 0; expected at least 1"),
        ({"fine_tune": -1}, "fine tune: -1; expected at least 1"),
        ({"groups": ["rooms"]}, "group 'rooms': expected NAME=SCENE,SCENE"),
        ({"groups": ["rooms=hall"]}, "groups name hall; expected some of the scenes room"),
        ({"refiners": [Path("/no/such.safetensors")]}, "no such file"),
    ],
)
def test_options_that_mean_nothing_are_refused(measured, options, said):
    with pytest.raises(PointSplatError, match=said):
        measured(**options)


@pytest.mark.parametrize(
    "content", ["", "[]", "[" * 100_000, '{"format": "pointsplat-tables"}', '{"format": 3}']
)
def test_damaged_cells_are_refused_in_one_line(measured, tmp_path, content):
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "tables.json").write_text(content)
    with pytest.raises(
        SceneError, match="tables.json: not the cells of tables .*--force"
    ) as refused:
        measured()
    assert "\n" not in str(refused.value)


def test_files_of_others_are_not_overwritten(measured, tmp_path):
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "tables.md").write_text("mine")
    with pytest.raises(SceneError, match="tables.md: exists already"):
        measured()
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="is a file"):
        measured(folder=tmp_path / "file")
    assert (tmp_path / "tables" / "tables.md").read_text() == "mine"


def test_a_version_is_found_in_what_is_said(tmp_path):
    found = SplatTransform(peer(tmp_path, "3.7.0", "warning: old\nv10.0.0-beta.1"))
    assert found.version == "10.0.0-beta.1" and len(found.modes) == 2
