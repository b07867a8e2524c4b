"""RAD files are read: the levels that are written here, and every encoding that Spark writes."""

import json
import struct
import zlib

import numpy as np
import pytest
import torch
from nested_levels import nested, rows_of
from refusing import fails, run

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.scene.formats import rad
from pointsplat_ns.scene.reading import kind_of, source_file
from pointsplat_ns.tools.levels.paged import write_paged


@pytest.mark.parametrize("page", [100, 65536])
@pytest.mark.parametrize(("counts", "degree"), [((40,), 1), ((300, 40), 0), ((700, 60, 9), 3)])
def test_levels_that_are_written_come_back_as_the_finest(
    counts, degree, page, tmp_path, monkeypatch
):
    monkeypatch.setattr(rad, "_PAGE", page)
    levels, parents = nested(counts, degree)
    levels = [level.replace(offset=(4e5, 0.0, -2.5)) for level in levels]
    write_paged(tmp_path / "a.rad", levels, parents)
    back = ps.load(tmp_path / "a.rad")
    assert kind_of(tmp_path / "a.rad") == "RAD" and back.offset == (4e5, 0.0, -2.5)
    assert back.sh_degree == degree
    rows = rows_of(back.means, levels[0], 0.0)
    kept = set(range(counts[0])) - set(range(8, counts[0], 9)) if parents else set(rows)
    assert len(rows) == len(set(rows)) and set(rows) == kept
    part = levels[0][rows]
    assert (back.scales - part.scales).abs().max() <= 2e-3
    assert (back.alphas - part.alphas).abs().max() <= 5e-4
    turned = rotation_matrices(back.quats) - rotation_matrices(part.quats)
    assert turned.abs().max() < 0.03
    steps = float(part.features_rest.abs().max()) / 127 if degree else 0
    assert not degree or (back.features_rest - part.features_rest).abs().max() <= steps
    colours = 0.5 + SH_C0 * part.features_dc
    span = float(colours.max() - colours.min().clamp_max(0))
    assert (0.5 + SH_C0 * back.features_dc - colours).abs().median() < span / 255


def deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def described(magic: bytes, content: dict) -> bytes:
    text = json.dumps(content, indent=1).encode()
    return magic + struct.pack("<I", len(text)) + text + bytes(-len(text) % 8)


def page_of(columns: dict, count: int, base: int = 0, **more: object) -> bytes:
    """A page of encoded columns: name to encoding, bytes and range."""
    properties, payload = [], b""
    for name, (encoding, data, bounds) in columns.items():
        packed = deflated(data)
        about = {"offset": len(payload), "bytes": len(packed), "property": name}
        properties.append({**about, "encoding": encoding, "compression": "gz", **bounds})
        payload += packed + bytes(-len(packed) % 8)
    about = {"version": 1, "base": base, "count": count, "payloadBytes": len(payload)}
    page = described(b"RADC", {**about, "properties": properties, **more})
    return page + struct.pack("<Q", len(payload)) + payload


def file_of(
    pages: list[bytes],
    count: int,
    degree: int,
    names: list[str] | None = None,
    repeated: int = 1,
) -> bytes:
    starts = np.cumsum([0, *map(len, pages)]).tolist()
    chunks = [
        {"offset": start, "bytes": len(page)} for start, page in zip(starts, pages, strict=False)
    ]
    if names is not None:
        chunks = [
            {**chunk, "offset": 0, "filename": n} for chunk, n in zip(chunks, names, strict=True)
        ]
    head = {"version": 1, "type": "gsplat", "count": count, "maxSh": degree, "chunkSize": 65536}
    head.update(allChunkBytes=starts[-1], chunks=repeated * chunks)
    return described(b"RAD0", head) + (b"" if names is not None else b"".join(pages))


def planes(table: np.ndarray, kind: str) -> bytes:
    return np.ascontiguousarray(table.T.astype(kind)).tobytes()


def byte_planes(table: np.ndarray, kind: str) -> bytes:
    """All lowest bytes first, of each of them component by component."""
    raw = np.ascontiguousarray(table.T.astype(kind)).view(np.uint8)
    return np.ascontiguousarray(raw.reshape(*table.T.shape, -1).transpose(2, 0, 1)).tobytes()


def levels_of(table: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.clip(np.rint((table - low) / (high - low) * 255), 0, 255).astype(np.uint8)


def signed(table: np.ndarray, most: float) -> np.ndarray:
    return np.clip(np.rint(table / most * 127), -127, 127).astype(np.int8)


def differences(table: np.ndarray) -> np.ndarray:
    return np.diff(table.view(np.uint8), axis=0, prepend=np.zeros((1, table.shape[1]), np.uint8))


SCENE = cloud(90, 6, 2)
TRUTH = {
    "center": SCENE.means.numpy(),
    "alpha": SCENE.alphas[:, None].numpy(),
    "rgb": (0.5 + SH_C0 * SCENE.features_dc).numpy(),
    "stds": SCENE.stds.numpy(),
    "sh1": SCENE.features_rest[:, :3].reshape(90, 9).numpy(),
    "sh2": SCENE.features_rest[:, 3:].reshape(90, 15).numpy(),
}
UNIT = SCENE.quats / SCENE.quats.norm(dim=1, keepdim=True)
XYZ = (UNIT * torch.where(UNIT[:, :1] < 0, -1.0, 1.0))[:, 1:].numpy()
LOG = np.log(TRUTH["stds"])
MOST = max(float(np.abs(TRUTH[name]).max()) for name in ("sh1", "sh2"))
LOW, HIGH = float(LOG.min()), float(LOG.max())
LN8 = (1 + np.rint((LOG - LOW) / (HIGH - LOW) * 254)).astype(np.uint8)
EIGHT = {"min": -1.0, "max": 2.0}

ENCODINGS = {
    "floats": {
        "center": ("f32", planes(TRUTH["center"], "<f4"), {}),
        "alpha": ("f32", planes(TRUTH["alpha"], "<f4"), {}),
        "rgb": ("f32", planes(TRUTH["rgb"], "<f4"), {}),
        "scales": ("f32", planes(TRUTH["stds"], "<f4"), {}),
        "orientation": ("f32", planes(XYZ, "<f4"), {}),
        "sh1": ("f32", planes(TRUTH["sh1"], "<f4"), {}),
        "sh2": ("f16", planes(TRUTH["sh2"], "<f2"), {}),
    },
    "halves": {
        "center": ("f16_lebytes", byte_planes(TRUTH["center"], "<f2"), {}),
        "alpha": ("f16", planes(TRUTH["alpha"], "<f2"), {}),
        "rgb": ("f16", planes(TRUTH["rgb"], "<f2"), {}),
        "scales": ("ln_f16", planes(LOG, "<f2"), {}),
        "orientation": ("f16", planes(XYZ, "<f2"), {}),
        "sh1": (
            "r8",
            planes(levels_of(TRUTH["sh1"], -MOST, MOST), "u1"),
            {"min": -MOST, "max": MOST},
        ),
        "sh2": ("s8", planes(signed(TRUTH["sh2"], MOST), "i1"), {"min": -MOST, "max": MOST}),
    },
    "as Spark chooses": {
        "center": ("f32_lebytes", byte_planes(TRUTH["center"], "<f4"), {}),
        "alpha": ("r8", planes(levels_of(TRUTH["alpha"], 0, 2), "u1"), {"min": 0.0, "max": 2.0}),
        "rgb": ("r8_delta", planes(differences(levels_of(TRUTH["rgb"], -1, 2)), "u1"), EIGHT),
        "scales": ("ln_0r8", planes(LN8, "u1"), {"min": LOW, "max": HIGH}),
        "orientation": ("f16", planes(XYZ, "<f2"), {}),
        "sh1": ("s8_delta", planes(differences(signed(TRUTH["sh1"], MOST)), "u1"), {"max": MOST}),
        "sh2": ("s8", planes(signed(TRUTH["sh2"], MOST), "i1"), {"min": -MOST, "max": MOST}),
    },
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_every_encoding_is_read(name, tmp_path):
    (tmp_path / "a.rad").write_bytes(file_of([page_of(ENCODINGS[name], 90)], 90, 2))
    back = ps.load(tmp_path / "a.rad")
    assert len(back) == 90 and back.sh_degree == 2
    exact = name == "floats"
    assert np.abs(back.means.numpy() - TRUTH["center"]).max() < (1e-6 if exact else 3e-3)
    assert np.abs(back.alphas.numpy() - TRUTH["alpha"][:, 0]).max() < (1e-6 if exact else 4.1e-3)
    assert np.abs(back.scales.numpy() - LOG).max() < (1e-5 if exact else (HIGH - LOW) / 250)
    rgb = (0.5 + SH_C0 * back.features_dc).numpy()
    within = (TRUTH["rgb"] > -1) & (TRUTH["rgb"] < 2)
    assert np.abs(rgb - TRUTH["rgb"])[within].max() < (1e-5 if exact else 3 / 500)
    step = 2e-3 if exact else MOST / 125
    rest = np.concatenate([TRUTH["sh1"], TRUTH["sh2"]], axis=1)
    assert np.abs(back.features_rest.reshape(90, 24).numpy() - rest).max() < step
    turned = rotation_matrices(back.quats) - rotation_matrices(SCENE.quats)
    assert turned.abs().max() < 0.05


def test_a_palette_of_sh_is_read_for_all_pages(tmp_path):
    floats = ENCODINGS["floats"]
    labels = np.arange(90) % 7

    def rows(part: slice) -> dict:
        kept = {k: v[part] for k, v in (("center", TRUTH["center"]), ("alpha", TRUTH["alpha"]))}
        columns = {name: ("f32", planes(table, "<f4"), {}) for name, table in kept.items()}
        columns["rgb"] = ("f32", planes(TRUTH["rgb"][part], "<f4"), {})
        columns["scales"] = ("f32", planes(TRUTH["stds"][part], "<f4"), {})
        columns["orientation"] = ("f32", planes(XYZ[part], "<f4"), {})
        columns["sh_label"] = ("u16", labels[part].astype("<u2").tobytes(), {})
        return columns

    first = rows(slice(0, 50))
    first["sh1_code"] = ("f32", planes(TRUTH["sh1"][:7], "<f4"), {})
    first["sh2_code"] = ("f32", planes(TRUTH["sh2"][:7], "<f4"), {})
    pages = [page_of(first, 50), page_of(rows(slice(50, 90)), 40, 50)]
    (tmp_path / "a.rad").write_bytes(file_of(pages, 90, 2))
    back = ps.load(tmp_path / "a.rad")
    assert torch.equal(back.features_rest, SCENE.features_rest[labels])
    assert np.array_equal(back.means, TRUTH["center"]) and floats


def test_only_leaves_are_read_and_pages_may_be_files(tmp_path):
    children = np.zeros(90, "<u2")
    children[:10] = 8
    tree = {"child_count": ("u16", children.tobytes(), {})}
    tree["child_start"] = ("u32", np.zeros(90, "<u4").tobytes(), {})
    page = page_of({**ENCODINGS["as Spark chooses"], **tree}, 90)
    (tmp_path / "a-lod-0.radc").write_bytes(page)
    (tmp_path / "a.rad").write_bytes(file_of([page], 90, 2, ["a-lod-0.radc"]))
    assert np.array_equal(ps.load(tmp_path / "a.rad").means, TRUTH["center"][10:])
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert source_file(tmp_path / "a.rad")[:2] == ("a.rad", size)
    for name in ("../a-lod-0.radc", "/etc/passwd", "http://a/b"):
        (tmp_path / "a.rad").write_bytes(file_of([page], 90, 2, [name]))
        fails(lambda: ps.load(tmp_path / "a.rad"), "own folder", error=ps.SceneError)
    fails(lambda: ps.load(tmp_path / "a-lod-0.radc"), "name its .rad")


def test_damage_is_refused_in_one_line(tmp_path):
    path = tmp_path / "a.rad"
    page = page_of(ENCODINGS["floats"], 90)
    lies = {
        "declared as 91": file_of([page], 91, 2),
        "more than": file_of([page], 10**9, 2),
        "pages of": file_of([page], 90 * 400, 2, repeated=400),
        "not RAD": file_of([b"XXXX" + page[4:]], 90, 2),
        "lacks 'scales'": file_of(
            [page_of({k: v for k, v in ENCODINGS["floats"].items() if k != "scales"}, 90)], 90, 2
        ),
        "center of": file_of(
            [page_of({**ENCODINGS["floats"], "center": ("f32", bytes(12 * 91), {})}, 90)], 90, 2
        ),
        "'center' as 'f64'": file_of([page_of({"center": ("f64", bytes(12 * 90), {})}, 90)], 90, 2),
        "expected gsplat 1": file_of([page], 90, 2).replace(b"gsplat", b"gsplut"),
    }
    for said, data in lies.items():
        path.write_bytes(data)
        fails(lambda: ps.load(path), said, error=ps.SceneError)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("a.rad", "pointsplat lod SCENE -o room.rad"),
        ("tileset.json", "pointsplat lod SCENE --tiles"),
        ("lod-meta.json", "pointsplat lod SCENE --stream"),
    ],
)
def test_convert_to_levels_names_the_command_that_writes_them(name, command, tmp_path, capsys):
    ps.save(cloud(9), tmp_path / "a.ply")
    with pytest.raises(SystemExit):
        run("convert", tmp_path / "a.ply", tmp_path / name)
    said = capsys.readouterr().err
    assert f"{name}: cannot write a" in said and command in said and said.count("\n") == 1
