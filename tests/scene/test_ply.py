"""3DGS PLY files: exact to the bit on the way out and back, and clear about damage."""

import math
import os
from unittest import mock

import numpy as np
import psutil
import pytest
import torch
from plyfile import PlyData, PlyElement
from plys import columns_of, write_columns
from refusing import fails as refused

from making import normal_scene, same_bits
from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.discovery import find_scenes
from pointsplat_ns.scene.ply import column_names, read_ply, write_ply
from pointsplat_ns.scene.reading import read_scene


def rows_of(path):
    return np.array(PlyData.read(str(path), mmap=False)["vertex"].data)


def rewrite(path, rows, **kwargs):
    PlyData([PlyElement.describe(rows, "vertex")], **kwargs).write(str(path))


@pytest.mark.parametrize(
    ("n", "degree"), [(0, 1), (1, 0), (5, 2), (16_384 + 3, 3)]
)  # the last: two chunks
def test_round_trip_is_exact_to_the_bit(tmp_path, n, degree):
    scene = normal_scene(n, degree)
    write_ply(scene, tmp_path / "a.ply")
    back = read_ply(tmp_path / "a.ply")
    assert back.sh_degree == degree and same_bits(scene, back)
    assert all(value.is_contiguous() for value in back.tensors())


def test_no_infinite_value_is_read_or_written_and_what_is_drawn_stays(tmp_path, caplog):
    scene = normal_scene(8, 0)
    write_ply(scene, tmp_path / "a.ply")
    rows = rows_of(tmp_path / "a.ply")
    rows["opacity"][:2] = (math.inf, -math.inf)
    rows["scale_1"][2] = -math.inf
    rows["scale_0"][3] = math.inf
    rows["x"][4] = math.nan
    rows["f_dc_2"][5] = math.inf
    rows["rot_0"][6] = -math.inf
    rewrite(tmp_path / "a.ply", rows)
    found = read_scene(tmp_path / "a.ply")
    assert "dropped 4 of 8" in caplog.text and len(found) == 4
    assert all(bool(value.isfinite().all()) for value in found.tensors())
    assert found.alphas[:2].tolist() == pytest.approx([1.0, 0.0], abs=1e-12)
    assert 0 < float(found.stds[2, 1]) < 1e-37  # float32 has no smaller normal numbers
    scene.opacities[0] = math.inf
    scene.opacities[1] = -math.inf
    scene.scales[2, 1] = -math.inf
    write_ply(scene, tmp_path / "b.ply")
    written = rows_of(tmp_path / "b.ply")
    assert (
        all(np.isfinite(written[name]).all() for name in written.dtype.names) and len(written) == 8
    )


def test_a_sparse_file_that_would_fill_the_memory_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(normal_scene(1, 3), path)
    content = path.read_bytes().replace(b"vertex 1\n", b"vertex 200000000\n")
    path.write_bytes(content)
    try:
        os.truncate(path, len(content) + 199_999_999 * 248)
    except OSError:
        pytest.skip("the file system has no sparse files")
    before = psutil.Process().memory_info().rss
    with mock.patch("psutil.virtual_memory", return_value=mock.Mock(available=10**9)):
        with pytest.raises(SceneError, match="a.ply: takes 47.2 GB of memory, 1.0 GB are free"):
            read_ply(path)
    assert psutil.Process().memory_info().rss < before + 2**28


def test_what_a_gaussian_has_no_place_for_is_said(tmp_path, caplog):
    path = tmp_path / "a.ply"
    scene = normal_scene(5, 1)
    write_ply(scene, path)
    assert same_bits(scene, read_ply(path)) and not caplog.records
    faces = PlyElement.describe(np.zeros(2, [("area", "f4")]), "face")
    more = {"red": np.zeros(5, "u1"), "class": np.ones(5, "i4")}
    write_columns(path, columns_of(scene) | more, before=[faces])
    assert same_bits(scene, read_ply(path))
    assert caplog.messages == [
        f"{path}: not read: the vertex properties red, class; the element 'face'"
    ]


@pytest.mark.parametrize(
    ("before", "inserted"),
    [
        (b"element vertex", "comment \u5ba4\n".encode()),
        (b"end_header", b"element face 1000000000000000\nproperty list uchar int vertex_indices\n"),
    ],
    ids=["a comment", "an element that follows"],
)
@pytest.mark.parametrize("text", [False, True])
def test_comments_in_any_encoding_and_later_elements_are_skipped(tmp_path, text, before, inserted):
    scene = normal_scene(5, 0)
    write_ply(scene, tmp_path / "a.ply")
    rewrite(tmp_path / "b.ply", rows_of(tmp_path / "a.ply"), text=text, byte_order="<")
    (tmp_path / "b.ply").write_bytes(
        (tmp_path / "b.ply").read_bytes().replace(before, inserted + before, 1)
    )
    assert same_bits(scene, read_ply(tmp_path / "b.ply"))


def test_lists_before_the_gaussians_are_skipped_in_ascii_alone(tmp_path):
    scene = normal_scene(5, 0)
    write_ply(scene, tmp_path / "a.ply")
    faces = PlyElement.describe(np.array([([1, 2, 3],), ([4],)], [("vertex_indices", "O")]), "face")
    for text in (True, False):
        vertex = PlyElement.describe(rows_of(tmp_path / "a.ply"), "vertex")
        PlyData([faces, vertex], text=text, byte_order="<").write(str(tmp_path / f"{text}.ply"))
    assert same_bits(scene, read_ply(tmp_path / "True.ply"))
    fails(tmp_path / "False.ply", "element 'face' of lists stands before 'vertex'")


def fails(path, *fragments):
    assert refused(lambda: read_ply(path), *fragments, error=SceneError).startswith(str(path))


@pytest.mark.parametrize("cut", [1, 247, 248, 1000])
def test_truncated_data_is_said_with_both_counts(tmp_path, cut):
    write_ply(normal_scene(7, 3), tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-cut])
    fails(
        tmp_path / "a.ply", "truncated", "declares 7 Gaussians", f"holds {7 - math.ceil(cut / 248)}"
    )


def columns(*without):
    return [(name, "f4") for name in column_names(45) if name not in without]


def test_2d_gaussians_are_read_as_flat_ones(tmp_path, caplog):
    scene = normal_scene(20_000, 1)  # more than one chunk
    found = {name: array for name, array in columns_of(scene).items() if name != "scale_2"}
    flat = read_scene(write_columns(tmp_path / "flat.ply", found))
    assert "2D Gaussians" in caplog.text and "scale_2" in caplog.text
    assert (
        torch.equal(flat.scales[:, :2], scene.scales[:, :2])
        and float(flat.stds[:, 2].max()) < 1e-30
    )
    assert torch.equal(flat.quats, scene.quats) and torch.equal(
        flat.features_rest, scene.features_rest
    )


@pytest.mark.parametrize(
    ("element", "properties", "fragments"),
    [
        ("vertex", columns("f_rest_7"), ["lacks the vertex property 'f_rest_7'"]),
        (
            "vertex",
            columns("f_rest_44", "f_rest_43"),
            ["has 43 f_rest properties", "0, 9, 24, 45 or 72"],
        ),
        (
            "vertex",
            [*columns()[:3], *columns()[-8:], ("red", "u1")],
            ["lacks the vertex property 'f_dc_0' and 2 more"],
        ),
        (
            "vertex",
            [*columns()[:3], ("red", "u1"), ("green", "u1"), ("blue", "u1")],
            ["points, no Gaussians", "can start from points"],
        ),
        (
            "vertex",
            [("packed_position", "u4"), ("packed_rotation", "u4")],
            ["compressed PLY", "expected a plain one"],
        ),
        (
            "vertex",
            [*columns(), ("filter_3D", "f4")],
            ["expected both fused, as its create_fused_ply.py writes them"],
        ),
        ("point", columns()[:1], ["no element 'vertex' (found point)"]),
    ],
    ids=str,
)
def test_a_file_without_what_a_gaussian_needs_is_refused_by_what_it_lacks(
    tmp_path, element, properties, fragments
):
    PlyData([PlyElement.describe(np.zeros(4, properties), element)], byte_order="<").write(
        str(tmp_path / "a.ply")
    )
    fails(tmp_path / "a.ply", *fragments)


JUNK = "element junk 1000000000000000\nproperty double a\nelement vertex 1"


@pytest.mark.parametrize(
    ("form", "elements"),
    [
        ("binary_little_endian", f"element vertex {10**15}"),
        ("ascii", f"element vertex {'9' * 400}"),
        ("binary_little_endian", JUNK),
    ],
)
def test_an_absurd_count_is_refused_before_memory_is_taken(tmp_path, form, elements):
    header = f"ply\nformat {form} 1.0\n{elements}\n"
    header += "".join(f"property float {name}\n" for name in column_names(0)) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + bytes(100))
    fails(tmp_path / "a.ply", "truncated", *([] if elements == JUNK else ["holds"]))


@pytest.mark.parametrize(
    ("line", "fragment"),
    [
        ("element vertex -5", "line 3 is not understood: 'element vertex -5'"),
        ("element vertex 1\nproperty quad x", "line 4 is not understood: 'property quad x'"),
        (
            "element vertex 1\nproperty float x\nproperty float x",
            "declares vertex property 'x' twice",
        ),
        ("element vertex 1\nelement vertex 1", "declares element 'vertex' twice"),
        ("element vertex 1\nproperty list uchar int lists", "vertex property 'lists' is a list"),
        (None, "names no format"),
    ],
)
def test_a_damaged_header_line_is_quoted(tmp_path, line, fragment):
    lines = "element vertex 0" if line is None else f"format binary_little_endian 1.0\n{line}"
    (tmp_path / "a.ply").write_text(f"ply\n{lines}\nend_header\n")
    fails(tmp_path / "a.ply", fragment)


@pytest.mark.parametrize(
    ("damage", "fragment"),
    [
        (
            lambda lines: [*lines[:-1], lines[-1].rsplit(" ", 1)[0] + "\n"],
            "row 2: property 'rot_3': early end-of-line",
        ),
        (
            lambda lines: [*lines[:-1], "what " + lines[-1].split(" ", 1)[1]],
            "row 2: property 'x': malformed input",
        ),
        (lambda lines: lines[:-1], "row 2: early end-of-file"),
    ],
)
def test_damaged_ascii_is_said_with_its_row(tmp_path, damage, fragment):
    write_ply(normal_scene(3, 0), tmp_path / "a.ply")
    rewrite(tmp_path / "b.ply", rows_of(tmp_path / "a.ply"), text=True)
    lines = (tmp_path / "b.ply").read_text().splitlines(keepends=True)
    (tmp_path / "b.ply").write_text("".join(damage(lines)))
    fails(tmp_path / "b.ply", "damaged PLY", fragment, "expected 3 Gaussians of 17 numbers")


@pytest.mark.parametrize(
    ("newline", "end", "text"), [(b"\r\n", b"end_header ", False), (b"\r", b"end_header\t  ", True)]
)
def test_every_line_end_and_spaces_after_the_last_keyword_are_read(tmp_path, newline, end, text):
    scene = normal_scene(5, 1)
    write_ply(scene, tmp_path / "a.ply")
    if text:
        rewrite(tmp_path / "a.ply", rows_of(tmp_path / "a.ply"), text=True)
    header, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    header = (header + end + b"\n").replace(b"\n", newline)
    (tmp_path / "b.ply").write_bytes(header + (data.replace(b"\n", newline) if text else data))
    assert same_bits(scene, read_ply(tmp_path / "b.ply"))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("prefix", ["scalar_", "scal_", "scalar_scal_"])
def test_names_with_prefixes_of_cloudcompare_are_read_to_the_bit(tmp_path, prefix, text, caplog):
    scene = normal_scene(6, 2)
    plain = {"x", "y", "z", "nx", "ny", "nz"}
    found = {
        name if name in plain else prefix + name: array for name, array in columns_of(scene).items()
    }
    # A name that is there with and without a prefix is read without.
    more = {"opacity": found.pop(f"{prefix}opacity"), f"{prefix}opacity": np.zeros(6, np.float32)}
    path = write_columns(tmp_path / "a.ply", {**found, **more, "red": np.zeros(6, "u1")}, text)
    assert same_bits(read_ply(path), scene)
    assert f"not read: the vertex properties {prefix}opacity, red" in caplog.text
    assert [*find_scenes(tmp_path).values()] == [path]
