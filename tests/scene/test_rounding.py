"""Rounding, rows and palettes."""

import json
import math
import zipfile

import numpy as np
import pytest
import torch
from plyfile import PlyElement
from plys import columns_of, write_columns

import pointsplat_ns as ps
from making import cloud, same_bits, splats
from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.pruning.merging.covariance import covariances, unpack
from pointsplat_ns.scene import ply
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.formats.palette import codebook
from pointsplat_ns.scene.formats.rounding import ROUNDING, rounding_for, steps_of
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import read_ply, write_ply

pytestmark = pytest.mark.usefixtures("quick")

SILENT = lambda *told: None  # noqa: E731


def values(scene: Gaussians) -> torch.Tensor:
    """The Gaussian at the points of a grid, float64."""
    axis = torch.linspace(-1, 1, 61, dtype=torch.float64)
    points = torch.cartesian_prod(axis, axis, axis) - scene.means.double()
    powers = torch.einsum(
        "pi,ij,pj->p",
        points,
        unpack(covariances(scene.scales.double(), scene.quats.double()))[0].inverse(),
        points,
    )
    return (-0.5 * powers).exp()


@pytest.mark.parametrize(
    ("name", "change"),
    [("means", [0.0, 1.0, 0.0]), ("scales", [0.0, 1.0, 0.0]), ("quats", [0.0, 0.0, 0.0, 1.0])],
)
def test_a_step_changes_a_gaussian_by_its_tolerance_over_the_contrast(name, change):
    scene = splats(torch.zeros(1, 3), torch.tensor([0.2, 0.1, 0.1]).log(), 0.0)
    tolerance = 1e-3
    steps = {"means": "means", "scales": "log_scales", "quats": "quats"}
    error = getattr(steps_of(scene, tolerance), steps[name]) / math.sqrt(12)
    changed = scene.replace(**{name: getattr(scene, name) + error.float() * torch.tensor([change])})
    relative = float((values(changed) - values(scene)).norm() / values(scene).norm())
    assert relative == pytest.approx(tolerance / ROUNDING.contrast, rel=0.02)


def test_extremes_stay_finite_and_usable():
    scene = cloud(6)
    scene = scene.replace(
        scales=torch.tensor(
            [
                [-80.0, 0.0, 0.0],
                [-80.0] * 3,
                [60.0, -60.0, 0.0],
                [0.0] * 3,
                [5.0] * 3,
                [-30.0, 9, 9],
            ]
        ),
        opacities=torch.tensor([[-80.0], [80.0], [0.0], [20.0], [-20.0], [5.0]]),
        means=scene.means * torch.tensor([[1e-30], [1e9], [1.0], [1e3], [0.0], [1.0]]),
        quats=torch.tensor(
            [
                [0.0, 0, 0, 0],
                [1e-30, 0, 0, 0],
                [1e18, 1, 0, 0],
                [1.0, 1, 1, 1],
                [1, 0, 0, 0],
                [0, 0, 1, 1],
            ]
        ),
    )
    for suffix in (".spz", ".sog"):
        for tolerance in (1e-12, 0.01, 1.0, 1e6):
            small = format_to_write(suffix).rounded(scene, tolerance)
            assert len(small) == 6 and bool(small.usable().all()), (suffix, tolerance)


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_files_become_smaller_and_keep_what_was_rounded(suffix, tmp_path):
    room = ps.example_room()[::20]
    kind = format_to_write(suffix)
    sizes = []
    tolerances = (0.0, 0.01, 0.04)
    for tolerance in tolerances:
        small = kind.rounded(room, tolerance)
        kind.write(small, tmp_path / f"a{suffix}", SILENT)
        kind.write(ps.load(tmp_path / f"a{suffix}"), tmp_path / f"b{suffix}", SILENT)
        first, second = ((tmp_path / f"{name}{suffix}").stat().st_size for name in "ab")
        assert second == pytest.approx(first, rel=0.01)  # written anew, nothing is rounded further
        sizes.append(first)
    assert sizes[0] > 1.1 * sizes[1] > 1.1**2 * sizes[2]


def test_rows_of_any_order_and_type_are_read_in_pieces_as_in_whole(tmp_path):
    scene = cloud(50, seed=3, sh_degree=1)
    columns = {
        name: column.astype(np.float64) for name, column in reversed(columns_of(scene).items())
    }
    camera = PlyElement.describe(np.zeros(2, [("id", "u1")]), "camera")
    write_columns(tmp_path / "a.ply", columns, order=">", before=[camera])
    rows = ply.PlyRows.open(tmp_path / "a.ply")
    assert rows is not None and (len(rows), rows.sh_degree) == (50, 1)
    assert same_bits(ps.Gaussians.cat([rows.read(0, 20), rows.read(20, 50)]), scene)
    assert same_bits(rows.pick([49, 3]), scene[[49, 3]])
    assert same_bits(read_ply(tmp_path / "a.ply"), scene)


def test_rows_of_a_file_that_shrinks_are_refused(tmp_path):
    write_ply(cloud(50), tmp_path / "a.ply")
    rows = ply.PlyRows.open(tmp_path / "a.ply")
    assert rows is not None
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-9])
    with pytest.raises(SceneError, match="truncated while it was read; expected 50 Gaussians"):
        rows.read(40, 50)


@pytest.mark.parametrize("different", [1, 300, 700])
def test_sh_of_few_different_rows_keep_them(different):
    """A palette of twice the entries may then have no error at all."""
    generator = torch.Generator().manual_seed(0)
    centres = torch.randn(300, 9, generator=generator)[
        torch.randint(300, (different,), generator=generator)
    ]
    rows = centres + 0.01 * torch.randn(different, 9, generator=generator)
    rows = 3 * rows[torch.arange(4000) % different].reshape(4000, 3, 3)
    rounding = rounding_for(30.0, 1)
    rest = (
        format_to_write(".sog")
        .rounded(cloud(4000, sh_degree=1).replace(features_rest=rows), rounding)
        .features_rest
    )
    assert 0.95 * different <= len(rest.flatten(1).unique(dim=0)) <= different
    error = float((rest - rows).square().mean().sqrt())
    assert error < ROUNDING.palette_error * rounding / (SH_C0 * 3**0.5)


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
def test_codebooks_are_listed_in_few_digits_and_read_back_to_the_bit(tolerance, tmp_path):
    kind = format_to_write(".sog")
    scene = kind.rounded(ps.example_room()[::20], tolerance)
    kind.write(scene, tmp_path / "a.sog", SILENT)
    meta = json.loads(zipfile.ZipFile(tmp_path / "a.sog").read("meta.json"))
    for name, values in (("scales", scene.scales), ("sh0", scene.features_dc)):
        book, _ = codebook(values)
        listed = torch.tensor(meta[name]["codebook"])
        used = book < book[-1]
        assert (
            len(listed) == 256
            and torch.equal(listed[used], book[used])
            and float(book[-1]) in listed
        )
        assert all(len(repr(number)) <= 16 for number in meta[name]["codebook"])
