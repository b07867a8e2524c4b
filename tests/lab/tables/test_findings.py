"""What the page of the record says of the paper's claims, from rows that are known in advance."""

import json

import pytest

from lab.judge import tables_record
from lab.tables import sources
from lab.tables.cells import Tables
from lab.tables.curves import last_gain, mean_curve, plot_curves
from lab.tables.findings import CLAIMS, OURS, Claim, Outcome, Verdict, outcomes, paragraph
from lab.tables.ways import WAYS, cell_key

UNSEEN = WAYS.pointsplat.protocols[0]
GAIN = Claim("refining helps", UNSEEN, (WAYS.paper,))
LESS = Claim("it draws fewer", UNSEEN, (WAYS.lightgaussian, WAYS.pup), "fill")


def cells_of(scene, **figures):
    """Cells at 10 % by the names of ways: PSNR, fill."""
    found = {}
    for way, (psnr, fill) in figures.items():
        key = f"{scene}/{way.replace('_', '-')}/10%"
        found[key] = {"point": {"against_photos": {"psnr": psnr}, "fill": fill}}
    return found


@pytest.mark.parametrize(
    ("gains", "verdict"),
    [
        ((1.0, 2.0), Verdict.HOLDS),
        ((-1.0, -2.0), Verdict.FAILS),
        ((-1.0, 2.0), Verdict.OPEN),
        ((0.5,), Verdict.HOLDS),
        ((), Verdict.UNKNOWN),
    ],
)
def test_a_claim_holds_if_its_mean_is_beyond_its_spread(gains, verdict):
    cells = {}
    for number, gain in enumerate(gains):
        cells |= cells_of(f"scene{number}", paper=(20.0, 9.0), pointsplat=(20.0 + gain, 9.0))
    names = [f"scene{number}" for number in range(max(1, len(gains)))]
    [outcome] = outcomes([GAIN], cells, names)
    assert outcome.verdict is verdict and outcome.differences == pytest.approx(gains)
    assert verdict.value in paragraph([GAIN], cells, names)


def test_less_fill_is_better_and_the_best_of_the_others_counts():
    cells = cells_of("fox", pointsplat=(20.0, 6.0), lightgaussian=(20.0, 12.0), pup=(20.0, 8.0))
    [outcome] = outcomes([LESS], cells, ["fox"])
    assert outcome.differences == pytest.approx((25.0,))
    assert outcome.text() == "it draws fewer (+25 ± 0 %)"
    del cells["fox/pup/10%"]
    assert outcomes([LESS], cells, ["fox"])[0].verdict is Verdict.UNKNOWN


def test_the_papers_own_differences_stand_beside():
    text = Outcome(CLAIMS[0], (1.0, 2.0, 3.0)).text()
    assert text.endswith("(+2.0 ± 1.0 dB; paper: +1.6 on ScanNet++, +12.2 on Replica)")
    assert not any("paper:" in Outcome(claim, (1.0,)).text() for claim in OURS)


def test_every_row_of_a_claim_is_a_row_of_the_tables():
    rows = {way for way, _ in WAYS.cells((0.1,))}
    for claim in (*CLAIMS, *OURS):
        assert {claim.better, *claim.than} <= rows, claim.text


def test_curves_are_means_over_scenes_with_the_same_steps(tmp_path):
    way = WAYS.lightgaussian_tuned
    cells = {
        cell_key(name, way, 0.1): {
            "point": {"share": 0.1},
            "curve": [[0, 20.0 + n], [5, 21.0 + n], [10, 21.5 + n]],
        }
        for n, name in enumerate(("fox", "can"))
    }
    cells["fox/dense/100%"] = {"point": {"share": 1.0}}
    curve = mean_curve(cells, ["fox", "can"], way, 0.1)
    assert curve == [(0, 20.5), (5, 21.5), (10, 22.0)] and last_gain(curve) == 0.5
    assert mean_curve(cells, ["fox", "tin"], way, 0.1) == []
    assert plot_curves(cells, ["fox", "can"], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert not plot_curves(cells, ["tin"], tmp_path / "none.png")


def test_every_setting_of_the_paper_is_cited_or_unknown():
    for setting in sources.SETTINGS:
        cited = any(word in setting.source for word in ("paper", "released code", "github.com"))
        assert cited or setting.source.startswith("neither") or "its rows" in setting.source
        if setting.value == sources.UNKNOWN:
            assert setting.source.startswith("neither")
    page = (tables_record.FOLDER / "results.md").read_text("utf-8")
    assert all(f"| {setting.name} |" in page for setting in sources.SETTINGS)


def test_the_page_names_what_was_not_measured_with_a_command():
    tables = tables_record.read(tables_record.FOLDER / "results_320.json")
    gone = {key: cell for key, cell in tables.cells.items() if cell["way"] != "pointsplat"}
    less = Tables(tables.scenes, gone, {"room35/pointsplat/10%": "no weights (--refiners)"})
    page = tables_record.page([less], ["less.json"], tables_record.FOLDER)
    assert "Not measured: " in page and "10 % PointSplat, unseen" in page
    assert "python -m lab.tables.networks other_outputs -o networks" in page
    assert f"What {Verdict.UNKNOWN.value}: refining improves the selection in scenes" in " ".join(
        page.split()
    )


def test_the_page_shows_how_to_measure_a_cell_of_each_table_and_what_it_is():
    tables = tables_record.read(tables_record.FOLDER / "results.json")
    page = (tables_record.FOLDER / "results.md").read_text("utf-8")
    cells = tables_record.repeated(tables)
    assert [cell["way"] for cell in cells] == ["pointsplat", "merge", "paper"]
    for cell in cells:
        point = cell["point"]
        assert f"--only {point['key']}" in " ".join(page.replace("\\\n", " ").split())
        psnr = point["against_photos"]["psnr"]
        assert f"| {point['key']} | {point['gaussians']:,} | {psnr:.2f} |" in page


def test_a_claim_is_said_once_by_the_first_file_that_decides_it():
    small = tables_record.read(tables_record.FOLDER / "results_320.json")
    few = {key: cell for key, cell in small.cells.items() if cell["way"] in ("dense", "paper")}
    few |= {key: cell for key, cell in small.cells.items() if cell["way"] == "pointsplat"}
    text = " ".join(tables_record.findings([Tables(small.scenes, few), small]).split())
    for claim in (*CLAIMS, *OURS):
        assert text.count(f"{claim.text} (") + text.count(f"{claim.text};") <= 1
        assert claim.text in text
    assert text.index(CLAIMS[0].text) < text.rindex("Finding") < text.index("Merging and compact")


def test_the_record_has_merge_and_compact_in_tables_1_and_2():
    page = (tables_record.FOLDER / "results.md").read_text("utf-8")
    tables = page.rpartition("## Tables")[2]
    for number in (1, 2):
        part = tables.partition(f"**Table {number}.")[2].partition("**Table")[0]
        assert "| merge (our default) |" in part and "| compact |" in part
    assert json.loads((tables_record.FOLDER / "results.json").read_text("utf-8"))["cells"]
