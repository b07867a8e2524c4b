"""Tables as Markdown and LaTeX: their structure, what is in them, and what is never in them."""

import json
import re

import pytest

from pointsplat_ns.tables import outputs
from pointsplat_ns.tables.layout import Layout, Table, latex_table, markdown_table
from pointsplat_ns.tables.means import read_groups
from pointsplat_ns.tables.outputs import medians, write_tables
from table_cells import write_scene

SMALL = Table(
    3,
    "Lambda: my_rooms, 2 scenes",
    ("lambda", "method", "PSNR"),
    ((("0.1", "PointSplat*", "20.00"), ("0.1", "PointSplat", "not measured")), (("0.3", "PointSplat*", "19.00"),)),
    ("Not measured: PointSplat: 50 % of_it | <b>",),
)

MARKDOWN = r"""**Table 3. Lambda: my\_rooms, 2 scenes**

| lambda | method | PSNR |
|---|---|---|
| 0.1 | PointSplat\* | 20.00 |
| 0.1 | PointSplat | not measured |
| 0.3 | PointSplat\* | 19.00 |

- Not measured: PointSplat: 50 % of\_it \| \<b\>
"""

LATEX = r"""% Table 3 of the paper
\begin{table*}
\centering
\caption{Lambda: my\_rooms, 2 scenes}
\begin{tabular}{llr}
\toprule
lambda & method & PSNR \\
\midrule
0.1 & PointSplat* & 20.00 \\
0.1 & PointSplat & not measured \\
\midrule
0.3 & PointSplat* & 19.00 \\
\bottomrule
\end{tabular}
% Not measured: PointSplat: 50 % of_it | <b>
\end{table*}
"""


@pytest.fixture()
def plain_figure(monkeypatch):
    monkeypatch.setattr(outputs, "plot_figure", lambda groups, path: path.write_text("a figure"))


def test_a_table_in_markdown():
    assert markdown_table(SMALL) == MARKDOWN


def test_a_table_in_latex():
    assert latex_table(SMALL) == LATEX


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


def test_without_photos_their_columns_are_left_out(tmp_path):
    write_scene(tmp_path, "splat", photos=False)
    [group] = read_groups(tmp_path)
    for table in Layout(group, (0.3,), {}).tables():
        assert "PSNR" not in table.header
        assert all(len(row) == len(table.header) for section in table.sections for row in section)


def test_rows_that_are_missing_somewhere_say_where_and_why(tmp_path):
    write_scene(tmp_path, "fox", without=("pointsplat", "pup"))
    write_scene(tmp_path, "kitchen", without=("pointsplat",))
    [group] = read_groups(tmp_path)
    why = {f"{scene}/pointsplat/{share}%": "no weights" for scene in ("fox", "kitchen") for share in (30, 10)}
    table = Layout(group, (0.3,), why).tables()[0]
    rows = rows_of(table)
    assert rows["30 %", "PointSplat"] == ("not measured", *("-",) * 7)
    assert rows["30 %", "PUP-3DGS*"][-1] == "1 of 2" and rows["30 %", "merge (our default)"][-1] == "2"
    assert table.notes == ("Not measured on fox: PUP-3DGS*: not yet", "Not measured: PointSplat: no weights")


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
    assert one.header[-3:] == three.header[-3:] == ("PSNR (paper)", "SSIM (paper)", "LPIPS (paper)")
    assert rows_of(one)["10 %", "PointSplat"][-3:] == ("29.81", "0.902", "0.276")
    assert rows_of(one)["10 %", "merge (our default)"][-3:] == ("-", "-", "-")
    assert "paper" not in str(two.header) and "paper" not in str(four.header)  # the paper does not say of which scenes
    assert rows_of(Layout(first, (0.3,), {}).tables()[3])["V", "yes"][-3:] == ("23.46", "0.855", "0.374")
    assert "do not say of which scenes they are" in (tmp_path / "tables.md").read_text()
    assert json.loads((tmp_path / "tables.json").read_text())["paper"]["Replica"]["table 1, pup, 10%"]["psnr"] == 17.34


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
