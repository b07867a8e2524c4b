"""A PLY that is read in pieces: the same Gaussians as in whole, and the same refusals."""

import pytest

import pointsplat_ns as ps
from making import cloud, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import ply, read_ply, write_ply


def test_rows_of_any_order_and_type_are_read_in_pieces_as_in_whole(tmp_path):
    scene = cloud(50, seed=3, sh_degree=1)
    table = ply.row_table(scene).astype(">f8")
    names = [line.split()[2] for line in ply.header_bytes(50, 1).decode().splitlines() if line.startswith("property")]
    turned = [names.index(name) for name in reversed(names)]
    lines = ["ply", "format binary_big_endian 1.0", "element camera 2", "property uchar id", "element vertex 50"]
    header = "\n".join([*lines, *(f"property double {names[i]}" for i in turned), "end_header", ""]).encode()
    (tmp_path / "a.ply").write_bytes(header + b"ab" + table[:, turned].tobytes())
    rows = ply.PlyRows.open(tmp_path / "a.ply")
    assert rows is not None and (len(rows), rows.sh_degree) == (50, 1)
    assert same_bits(ps.Gaussians.cat([rows.read(0, 20), rows.read(20, 50)]), scene)
    assert same_bits(rows.pick([49, 3]), scene[[49, 3]])
    assert same_bits(read_ply(tmp_path / "a.ply"), scene)


def test_rows_are_refused_as_whole_files_are_and_when_a_file_shrinks(tmp_path):
    write_ply(cloud(50), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    rows = ply.PlyRows.open(tmp_path / "a.ply")
    assert rows is not None
    (tmp_path / "a.ply").write_bytes(data[:-9])
    with pytest.raises(SceneError, match="truncated while it was read; expected 50 Gaussians"):
        rows.read(40, 50)
    with pytest.raises(SceneError, match="declares 50 Gaussians of .* the file holds 49"):
        ply.PlyRows.open(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(data.replace(b"vertex 50", b"vertex 1000000000000000"))
    with pytest.raises(SceneError, match="declares 1000000000000000 Gaussians"):
        ply.PlyRows.open(tmp_path / "a.ply")
    with pytest.raises(SceneError, match="no such file"):
        ply.PlyRows.open(tmp_path / "b.ply")
