"""Tables for spreadsheets: no text in them is a formula."""

import csv

import pytest

import pointsplat_ns as ps
from making import normal_scene
from pointsplat_ns.folders import convert_folder
from pointsplat_ns.io.files import write_csv


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\N{FULLWIDTH EQUALS SIGN}1"])
def test_a_text_that_is_a_formula_gets_an_apostrophe(text, tmp_path):
    write_csv([{"name": text, "loss": -1.5, "note": "a=b", "none": None}], tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as stream:
        assert [*csv.DictReader(stream)] == [{"name": f"'{text}", "loss": "-1.5", "note": "a=b", "none": ""}]


def test_the_table_of_a_folder_holds_no_formula_of_a_file_name(tmp_path):
    name = '=HYPERLINK("http:evil.example")'
    ps.save(normal_scene(4), tmp_path / "in" / f"{name}.ply")
    (result,) = convert_folder(tmp_path / "in", tmp_path / "out", ".ply")
    assert result.name == name
    with (tmp_path / "out" / "scenes.csv").open(newline="") as stream:
        assert [row["name"] for row in csv.DictReader(stream)] == [f"'{name}"]


def test_links_among_the_tables_of_a_folder_are_not_written_through(tmp_path):
    ps.save(normal_scene(4), tmp_path / "in" / "a.ply")
    (tmp_path / "diary.txt").write_text("precious")
    (tmp_path / "out").mkdir()
    for name in ("scenes.csv", "a.ply.json"):
        (tmp_path / "out" / name).symlink_to(tmp_path / "diary.txt")
    (result,) = convert_folder(tmp_path / "in", tmp_path / "out", ".ply")
    assert result.status == "done" and (tmp_path / "diary.txt").read_text() == "precious"
    assert not any(path.is_symlink() for path in (tmp_path / "out").iterdir())
