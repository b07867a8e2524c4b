"""Scene files that are cut short or lie: one SceneError each, and no memory for what is not there.
Of garbled ones, ``tests/lab/fuzz_corpus`` has those that reach every branch."""

import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib

import pytest
import torch
import zstandard
from compressed_plys import encode_compressed_ply
from foreign import encode_spz4
from refusing import fails

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.scene.formats.gltf import encode_glb, encode_gltf, encode_spz_glb
from pointsplat_ns.scene.formats.rad import encode_rad
from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.formats.splat import encode_splat
from pointsplat_ns.scene.formats.spz import encode_spz

FILES = {
    ".compressed.ply": encode_compressed_ply(cloud(300, 5, 1)),
    ".spz": encode_spz(cloud(300, 5, 1), version=3),
    "4.spz": encode_spz4(cloud(300, 5, 1)),
    ".sog": encode_sog(cloud(300, 5, 1)),
    ".glb": encode_glb(cloud(300, 5, 1)),
    ".gltf": encode_gltf(cloud(300, 5, 1)).rstrip(),
    ".spz.glb": encode_spz_glb(cloud(300, 5, 1)),
    ".rad": encode_rad(cloud(300, 5, 1), torch.zeros(300), torch.zeros(300)),
    ".splat": encode_splat(cloud(300, 5, 0)),
}


def refused(path, *fragments):
    assert fails(lambda: ps.load(path), *fragments, error=ps.SceneError).startswith(str(path))


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_cut_short_is_refused(tmp_path, name):
    path = tmp_path / f"a{name}"
    for share in (0.0, 0.02, 0.3, 0.9, 0.999):
        path.write_bytes(FILES[name][: max(int(share * len(FILES[name])) // 32 * 32 - 25, 0)])
        if name != ".splat" or share:  # or it is a file of no Gaussians
            refused(path)


def most_memory(call, path):
    tracemalloc.start()
    try:
        call(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("count", [10**7, 2**32 - 1])
@pytest.mark.parametrize("name", [".spz", "4.spz"])
def test_an_spz_that_declares_more_than_it_holds_takes_no_memory(tmp_path, name, count):
    path = tmp_path / "a.spz"
    content = bytearray(gzip.decompress(FILES[name]) if name == ".spz" else FILES[name])
    struct.pack_into("<I", content, 8, count)
    path.write_bytes(gzip.compress(bytes(content)) if name == ".spz" else content)
    assert most_memory(refused, path) < 1e6
    refused(path, "more than")


def test_a_gzip_bomb_is_decompressed_no_further_than_its_header_says(tmp_path):
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    packed = [packer.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0))]
    packed += [packer.compress(bytes(1 << 20)) for _ in range(20)] + [packer.flush()]
    (tmp_path / "a.spz").write_bytes(b"".join(packed))
    assert len(ps.load(tmp_path / "a.spz")) == 10
    assert most_memory(ps.load, tmp_path / "a.spz") < 2e6  # 20 MB are in it


def sog_with(**changes):
    """The SOG file with parts replaced: bytes, or a function of what ``meta.json`` holds."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(FILES[".sog"])) as before, zipfile.ZipFile(out, "w") as after:
        for name in before.namelist():
            data = before.read(name)
            change = changes.get(name.partition(".")[0])
            if callable(change):
                content = json.loads(data)
                change(content)
                data = json.dumps(content).encode()
            elif change is not None:
                data = change
            after.writestr(name, data, zipfile.ZIP_DEFLATED)
    return out.getvalue()


def image(width, height):
    from PIL import Image

    stream = io.BytesIO()
    Image.new("RGBA", (width, height)).save(stream, "WEBP", lossless=True)
    return stream.getvalue()


@pytest.mark.parametrize(
    "change, fragment",
    [
        (dict(meta=lambda meta: meta.update(count=10**5)), "pixels"),
        (dict(meta=lambda meta: meta.update(count=10**8)), "compressed bytes can hold"),
        (dict(meta=lambda meta: meta.update(count="many")), "declares 'many'"),
        (
            dict(meta=lambda meta: meta["means"].update(files=["../../etc/passwd", "x"])),
            "beside meta.json",
        ),
        (
            dict(meta=lambda meta: meta["scales"].update(codebook=[0.0] * 10**4)),
            "a codebook of 10000",
        ),
        (dict(meta=lambda meta: meta["shN"].update(count=10**9)), "a palette of 1000000000"),
        (dict(meta=lambda meta: meta.pop("quats")), "lacks 'quats'"),
        (dict(meta=b"[" * 100_000), "damaged"),
        (dict(meta=bytes(5 << 20)), "meta.json has 5242880 bytes"),
        (dict(quats=image(5000, 5000)), "quats.webp has 5000 x 5000 pixels"),
        (dict(shN_centroids=image(64, 64)), "shN_centroids.webp has 64 x 64 pixels"),
        (dict(quats=b"no image"), "not a WebP image"),
    ],
)
def test_a_sog_that_lies_is_refused_by_what_is_wrong(tmp_path, change, fragment):
    (tmp_path / "a.sog").write_bytes(sog_with(**change))
    refused(tmp_path / "a.sog", fragment)


@pytest.mark.parametrize(
    "old, new, fragment",
    [
        (b"element vertex 300", b"element vertex 300000000", "chunks for 300000000"),
        (
            b"uint packed_rotation",
            b"float packed_rotation",
            "lacks the uint32 property 'packed_rotation'",
        ),
        (b"element sh 300", b"element sh 200", "'sh' has 200 rows"),
        (b"element chunk 2", b"element other 2", "lacks the element 'chunk'"),
        (b"binary_little_endian", b"binary_big_endian", "big-endian or ASCII"),
    ],
)
def test_a_compressed_ply_that_lies_is_refused_by_what_is_wrong(tmp_path, old, new, fragment):
    assert old in FILES[".compressed.ply"]
    (tmp_path / "a.ply").write_bytes(FILES[".compressed.ply"].replace(old, new, 1))
    refused(tmp_path / "a.ply", fragment)


@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_of_nothing_but_zeros_takes_no_memory(tmp_path, version):
    """What its header declares is there, in a thousandth of the bytes."""
    count = 10**6
    path = tmp_path / "a.spz"
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, 0, 12, 0, 5 if version == 4 else 0)
    sizes = [9 * count, count, 3 * count, 3 * count, 4 * count]
    if version == 3:
        path.write_bytes(gzip.compress(head + bytes(sum(sizes))))
    else:
        streams = [zstandard.ZstdCompressor().compress(bytes(size)) for size in sizes]
        table = b"".join(
            struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True)
        )
        path.write_bytes(
            head + struct.pack("<I12x", 32) + table + b"".join(streams) + bytes(20_000)
        )
    assert most_memory(refused, path) < 3e6  # 20 MB are in it, and 56 MB would be made of it
    refused(path, "more than")
