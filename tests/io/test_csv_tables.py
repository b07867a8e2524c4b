"""Tables for spreadsheets: no text in them is a formula."""

import csv

import pytest

import pointsplat_ns as ps
from making import normal_scene
from pointsplat_ns.folders import convert_folder
from pointsplat_ns.io.csv_tables import write_csv


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
