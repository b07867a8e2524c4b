"""Merging cell by cell: the count, the seams, damaged steps, and what is the same as in memory."""

import math
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lab.common.timing import start_of_peak
from making import box_room, cloud, photographed, same_bits
from pointsplat_ns.errors import BudgetError, SceneError
from pointsplat_ns.pipeline import prune_file
from pointsplat_ns.pruning.merging import MERGING, MergeSettings, merge, state
from pointsplat_ns.pruning.merging.by_cells import lowest, merge_file
from pointsplat_ns.pruning.merging.cells import Scratch, divided
from pointsplat_ns.pruning.merging.state import Participants, drawable
from pointsplat_ns.pruning.merging.visibility import views_and_weights
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import PlyRows, header_bytes, read_ply, row_table, write_ply
from pointsplat_ns.view_sampling.sampler import Sampler, sample_views
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings

pytestmark = pytest.mark.usefixtures("quick")


def rows_of(scene: Gaussians, folder: Path) -> PlyRows:
    folder.mkdir(exist_ok=True)
    write_ply(scene, folder / "scene.ply")
    return PlyRows.open(folder / "scene.ply")


BLIND = replace(MERGING, min_count_rendered=10**9)
"""Settings without sampled views, to be quick."""


def merged(
    rows: PlyRows, k: int, most: int, folder: Path, settings: MergeSettings = BLIND
) -> Gaussians:
    """The scene of ``k`` Gaussians from cells of at most ``most``."""
    scratch = Scratch(folder / f"cells-{k}-{most}", {})
    found = merge_file(rows, lambda n: k, folder / "small.ply", most, scratch, settings=settings)
    assert found == (rows.count, k)
    return read_ply(folder / "small.ply")


@pytest.mark.parametrize("k", [5, 1499])
def test_the_count_is_exact_for_any_budget_and_number_of_cells(k, tmp_path):
    rows = rows_of(cloud(1500, seed=4, sh_degree=1), tmp_path)
    assert all(len(merged(rows, k, most, tmp_path)) == k for most in (5000, 350))


def test_fewer_gaussians_than_cells_are_refused(tmp_path):
    with pytest.raises(
        BudgetError, match="cannot merge 5 parts of a scene into 4 Gaussians; expected 5"
    ):
        merged(rows_of(cloud(3000), tmp_path), 4, 700, tmp_path)


def test_what_is_not_merged_stays_as_it_is_to_the_bit(tmp_path):
    scene = cloud(900, seed=5, sh_degree=2).replace(antialiased=True)
    kept = merged(rows_of(scene, tmp_path), 900, 300, tmp_path)
    assert kept.antialiased
    order, wanted = (s.means[:, 0].argsort() for s in (kept, scene))
    assert same_bits(kept[order], scene[wanted])


def test_cells_hold_equally_many_gaussians_even_at_one_position(tmp_path):
    scene = cloud(4000, seed=2)
    scene.means[::2] = 0.25  # half of them at one point
    cells = divided(
        rows_of(scene, tmp_path), 1000, Scratch(tmp_path / "cells", {}), lambda share: None
    )
    assert sum(cells.counts) == 4000 and max(cells.counts) <= 1010
    assert len(pickle.dumps(cells)) < 20_000, "processes get no Gaussians"
    read = Gaussians.cat([cells.read(cell) for cell in range(len(cells))])
    order, wanted = (s.features_dc.double().sum(1).argsort() for s in (read, scene))
    assert same_bits(read[order], scene[wanted])


POINTS = box_room(3, 4000)
POINTS = POINTS.replace(scales=POINTS.scales - 5)
"""A room of Gaussians narrower than their blur."""


@pytest.mark.parametrize(
    ("scene", "tolerance"), [(box_room(3, 4000), 0.02), (photographed(4000), 0.1), (POINTS, 0.02)]
)
def test_views_and_weights_are_those_of_merging_in_memory(scene, tolerance, tmp_path, monkeypatch):
    """A tolerance for the size of the content, and for the median of traces, both by a sample."""
    scene.opacities[::7] = -9.0  # too faint
    monkeypatch.setattr(state, "SAMPLED", 1 << 9)
    settings = replace(MERGING, sampled_views=4, min_count_rendered=0, max_count_drawn=600)
    with use_settings(replace(DEFAULT_SETTINGS, sampled_count=900)):
        _, (weights, blurs) = views_and_weights(
            Participants.of(scene, drawable(scene, 400)), Sampler(scene), settings
        )
        merged(rows_of(scene, tmp_path), 400, 900, tmp_path, settings)
    overview = Scratch(tmp_path / "cells-400-900", {}).known("overview")
    assert torch.allclose(
        overview["weights"].log(), weights[:: int(overview["step"])].log(), atol=tolerance
    )
    assert (blurs is not None) == (scene is POINTS)
    blurs = torch.zeros_like(weights) if blurs is None else blurs
    assert torch.allclose(overview["blurs"], blurs[:: int(overview["step"])], rtol=tolerance)


def test_cells_lose_no_more_than_the_whole_and_leave_no_seam(tmp_path):
    scene = box_room(seed=3, count=3000, size=0.15)
    rows = rows_of(scene, tmp_path)
    k = 300
    settings = replace(MERGING, sampled_views=8, finish_views=2, min_count_rendered=0)
    with use_settings(DEFAULT_SETTINGS):
        whole = merge(scene, k, settings=settings).scene
        parts = merged(rows, k, 750, tmp_path, settings)
        reference = DenseReference(scene, sample_views(scene, 6, width=80, height=60, seed=9))
    assert (
        reference.psnr(parts)[0] > reference.psnr(whole)[0] - 0.6
    )  # as much as eight other views change
    # Density beside borders: share of the dense Gaussians near a border, and of those that remain.
    cells = divided(rows, 750, Scratch(tmp_path / "cells", {}), lambda share: None)
    cell = [torch.full((count,), number) for number, count in enumerate(cells.counts)]
    dense = Gaussians.cat([cells.read(number) for number in range(len(cells))])
    near = torch.cdist(dense.means, dense.means).topk(12, largest=False).indices
    own = torch.cat(cell)
    beside = (own[near] != own[:, None]).any(1)
    nearest = {
        name: torch.cdist(s.means, dense.means).argmin(1)
        for name, s in (("whole", whole), ("parts", parts))
    }
    share = {name: float(beside[rows].float().mean()) for name, rows in nearest.items()}
    assert float(beside.float().mean()) > 0.05
    assert abs(share["parts"] - share["whole"]) < 0.25 * share["whole"] + 0.01, share


def test_other_work_begins_anew_and_damaged_steps_are_told(tmp_path):
    first = Scratch(tmp_path / "cells", {"keep": 1})
    first.tensors("a", lambda: {"x": torch.ones(3)})
    assert Scratch(tmp_path / "cells", {"keep": 1}).known("a")["x"].tolist() == [1, 1, 1]
    Scratch(tmp_path / "cells", {"keep": 2})
    with pytest.raises(SceneError, match=r"cells: damaged .*remove it"):
        first.known("a")


def test_gaussians_that_cannot_be_drawn_are_dropped_and_counted_once(tmp_path, caplog):
    scene = cloud(2000, seed=1)
    scene.means[::10] = torch.nan
    (tmp_path / "scene.ply").write_bytes(
        header_bytes(len(scene), scene.sh_degree) + row_table(scene).tobytes()
    )
    rows = PlyRows.open(tmp_path / "scene.ply")
    with caplog.at_level("WARNING"):
        found = merge_file(
            rows,
            lambda n: n // 2,
            tmp_path / "small.ply",
            700,
            Scratch(tmp_path / "cells", {}),
            settings=BLIND,
        )
    assert found == (1800, 900) and len(read_ply(tmp_path / "small.ply")) == 900
    assert [r.getMessage() for r in caplog.records if "dropped" in r.getMessage()] == [
        f"{tmp_path / 'scene.ply'}: dropped 200 of 2000 Gaussians with NaN or infinite values"
    ]


MEMORY = """
import sys
from dataclasses import replace
from pathlib import Path
from pointsplat_ns.scene.ply import PlyRows
from pointsplat_ns.pruning.merging import cells, state
from pointsplat_ns.pruning.merging.by_cells import lowest, merge_file
from pointsplat_ns.pruning.merging.settings import MERGING
from lab.common.timing import start_of_peak, status_bytes
from pointsplat_ns.system.memory import give_back_freed_memory
cells.ROWS_AT_ONCE, state.SAMPLED = 1 << 13, 1 << 12
peaks = []
for name, most in (("few", 1000), ("many", int(sys.argv[2]))):  # the first for imports and kernels
    folder = Path(sys.argv[1]) / name
    give_back_freed_memory()
    start_of_peak()
    peaks.append(status_bytes("VmHWM"))
    rows = PlyRows.open(folder / "scene.ply")
    blind = replace(MERGING, min_count_rendered=10**9, max_count_drawn=state.SAMPLED)
    merge_file(rows, lambda n: n // 10, folder / "small.ply", most, cells.Scratch(folder / "cells", {}), settings=blind)
    peaks.append(status_bytes("VmHWM"))
print(peaks[3] - peaks[2])
"""


def test_memory_is_that_of_a_cell_and_not_of_the_scene(tmp_path):
    try:
        start_of_peak()
    except OSError:
        pytest.skip("this system does not tell the most memory that was held")
    most = 5_000
    sh_bytes = 236
    rows_of(cloud(2000, seed=7), tmp_path / "few")
    rows_of(cloud(35_000, seed=7, sh_degree=3), tmp_path / "many")
    command = [
        sys.executable,
        "-c",
        MEMORY,
        str(tmp_path),
        str(most),
    ]  # a process of its own: no other test's memory
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    # Of a cell, 8 times as much, with what the C library and mapped files hold; of one cell for
    # all, five times that.
    assert grown < 14 * most * (prune_file.MEMORY.cell + sh_bytes)


@pytest.mark.parametrize("kind", ["spread", "few", "equal", "extreme"])
def test_the_lowest_of_all_parts_are_those_of_a_stable_sort(kind):
    generator = torch.Generator().manual_seed(4)
    numbers = torch.rand(5000, generator=generator)
    if kind == "few":
        numbers = (numbers * 7).floor()
    elif kind == "equal":
        numbers = torch.full((5000,), 0.25)
    elif kind == "extreme":
        numbers = 10 ** (numbers.double() * 83 - 45).float()  # from the least above 0 to infinity
        numbers[::9] = 0.0
        numbers[::11] = math.inf
    parts = [*numbers.split([0, 1, 1999, 0, 3000])]
    for most in (0, 1, 17, 2500, 4999, 5000, 6000):
        wanted = torch.zeros(5000, dtype=torch.bool)
        wanted[numbers.sort(stable=True).indices[:most]] = True
        chosen = lowest(parts, most)
        assert [len(part) for part in chosen] == [0, 1, 1999, 0, 3000] and torch.equal(
            torch.cat(chosen), wanted
        )
