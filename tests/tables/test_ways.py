"""Names of cells and rows, and the paper's figures."""

import shlex

import pytest

from pointsplat_ns.pruning import METHODS
from pointsplat_ns.tables import ways
from pointsplat_ns.tables.ways import PROTOCOL, WAYS, Network, cell_key, published
from pointsplat_ns.tradeoff.points import ImageMetrics

CELLS = WAYS.cells(PROTOCOL.shares)


def test_no_two_cells_have_one_name_and_a_shell_reads_each_as_it_is():
    keys = [cell_key("fox", way, share) for way, share in CELLS]
    assert len(set(keys)) == len(keys) and shlex.split(" ".join(keys)) == keys
    assert "fox/merge/10%" in keys and "fox/dense/100%" in keys


def test_every_row_has_a_cell():
    cells = {(way.name, share) for way, share in CELLS}
    assert {(way.name, share) for way in WAYS.table_1 for share in PROTOCOL.shares} <= cells
    assert {(way.name, 0.1) for way in (*WAYS.table_4, *(way for _, way in WAYS.table_3))} <= cells


def test_every_row_is_made_in_exactly_one_way():
    for way in {way for way, _ in CELLS if way.name != "dense"}:
        assert (way.by in METHODS) != (way.mode is not None), way
        assert sum([way.fine_tuned, way.network is not None, way.repair != "none", way.mode is not None]) <= 1, way


def test_networks_are_told_apart_by_all_that_tables_vary():
    wanted = {way.network for way, _ in CELLS if way.network}
    assert len(wanted) == 2 + 5 + 3  # SplatFormer's two, five lambdas, and the ablations of Table 4
    text = str(Network(use_appearance=False, use_position=False))
    assert text.startswith("dual encoder without appearance branch and position encoding, trained on scenes pruned by")


def test_the_middle_lambda_is_the_row_of_table_1():
    assert WAYS.selected(0.3) in WAYS.table_1 and WAYS.selected(0.5) not in WAYS.table_1


def test_every_figure_of_the_paper_has_a_row():
    cells = {(way.name, share) for way, share in CELLS}
    assert {*ways._PUBLISHED[1]} <= cells and {*ways._PUBLISHED[3]} <= cells
    assert [way.name for way in WAYS.table_4] == [name for name, _ in ways._PUBLISHED[4]]
    assert len(ways._PUBLISHED[1]) == 1 + 8 * 3 and len(ways._PUBLISHED[3]) == 10


@pytest.mark.parametrize(
    "table, dataset, way, share, expected",
    [
        (1, "ScanNet++", "dense", 1.0, ImageMetrics(29.73, 0.925, 0.165)),
        (1, "Replica", "splatformer", 0.1, ImageMetrics(8.37, 0.388, 0.677)),
        (1, "ScanNet++", "pup-tuned", 0.3, ImageMetrics(30.85, 0.931, 0.172)),
        (3, "Replica", "pointsplat-0.9", 0.1, ImageMetrics(26.58, 0.882, 0.290)),
        (4, "ScanNet++", "pointsplat-iii", 0.1, ImageMetrics(22.76, 0.847, 0.385)),
        (4, "Replica", "pointsplat-iii", 0.1, None),
        (1, "Replica", "merge", 0.1, None),
    ],
)
def test_figures_are_the_papers(table, dataset, way, share, expected):
    assert published(table, dataset, way, share) == expected
