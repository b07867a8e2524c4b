"""Files as other programs write them are read as those programs mean them, or refused by name.

The files in ``cases`` were made from the example room, in the form that the named program writes.
"""

import io
import json
import zipfile
from pathlib import Path

import pytest
import torch
from refusing import fails

import pointsplat_ns as ps
from making import cloud, same_bits
from pointsplat_ns.scene.camera_files import read_named_views
from pointsplat_ns.scene.formats.sog import encode_sog

CASES = Path(__file__).parent / "cases"


def test_every_image_of_a_colmap_model_without_lines_of_points_is_read():
    found = read_named_views(CASES / "colmap_no_blank_lines")
    assert found.names == [f"{index:03d}.png" for index in range(16)]


@pytest.mark.parametrize(
    "points",
    [
        None,
        b"",
        b"1.5 2.5 -1",
        b"1.5 2.5 -1 nan nan 7 " * 4,
        b"1.5 2.5 -1 " * 3000,
        b"# no points",
    ],
)
def test_lines_of_points_may_be_there_empty_or_missing(points, tmp_path):
    """Twelve words are as many as the line of an image may have."""
    (tmp_path / "cameras.txt").write_bytes(b"1 PINHOLE 64 48 50 50 32 24\n")
    after = b"" if points is None else points + b"\n"
    names = [b"1", b"2 of 9", b"a b c.png"]
    lines = [b"%d 1 0 0 0 0 0 0 1 %s\n" % (index, name) for index, name in enumerate(names)]
    (tmp_path / "images.txt").write_bytes(after.join(lines) + after)
    assert read_named_views(tmp_path).names == [name.decode() for name in names]


def without_count(data: bytes, **extra: object) -> bytes:
    """A SOG file whose palette has no ``count``."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(stream, "w") as new:
        for name in old.namelist():
            part = old.read(name)
            if name == "meta.json":
                meta = json.loads(part)
                del meta["shN"]["count"]
                part = json.dumps({**meta, "shN": {**meta["shN"], **extra}}).encode()
            new.writestr(name, part)
    return stream.getvalue()


def test_a_palette_of_lichtfeld_has_its_size_under_another_name():
    scene = ps.load(CASES / "lichtfeld_palette_size.sog")
    written = ps.place(ps.example_room()[::300], up="z:-y")
    assert (len(scene), scene.sh_degree) == (len(written), 1)
    nearest = written[torch.cdist(scene.means, written.means).argmin(dim=1)]
    # 256 numbers in 256 rows
    assert float((scene.features_rest - nearest.features_rest).abs().max()) < 0.01
    assert float(nearest.features_rest.abs().max()) > 0.05


@pytest.mark.parametrize("extra", [{}, {"palette_size": 2048, "coeffs": 8}])
def test_images_tell_the_size_of_a_palette_without_a_count(tmp_path, extra):
    data = encode_sog(cloud(3000, sh_degree=2))
    (tmp_path / "with.sog").write_bytes(data)
    (tmp_path / "without.sog").write_bytes(without_count(data, **extra))
    assert same_bits(ps.load(tmp_path / "with.sog"), ps.load(tmp_path / "without.sog"))


def test_a_palette_of_no_size_is_refused(tmp_path):
    (tmp_path / "a.sog").write_bytes(without_count(encode_sog(cloud(9)), palette_size="64"))
    assert "a palette of '64' entries" in fails(lambda: ps.load(tmp_path / "a.sog"))
