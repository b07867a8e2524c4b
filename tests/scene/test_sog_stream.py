"""SOG streams, and scenes at the extremes in any format."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from refusing import fails

import pointsplat_ns as ps
from making import normal_scene, same, same_bits
from pointsplat_ns.scene.formats.sog_stream import Node, read_sog_stream, write_sog_stream
from pointsplat_ns.scene.reading import kind_of
from pointsplat_ns.scene.usable import keep_usable

FINE = 300
COARSE = 60


@pytest.fixture()
def folder(tmp_path) -> Path:
    """Two levels in three leaves; of the finer level, the first two fill a file."""
    levels = [normal_scene(FINE, seed=1), normal_scene(COARSE, seed=2)]
    rows = [
        (torch.arange(100 * i, 100 * i + 100), torch.arange(20 * i, 20 * i + 20)) for i in range(3)
    ]
    first, second, third = (Node(rows=leaf) for leaf in rows)
    meta = write_sog_stream(
        levels,
        Node(children=(Node(children=(first, second)), third)),
        tmp_path / "lod-meta.json",
        150,
    )
    assert meta["filenames"] == ["0_0/meta.json", "1_0/meta.json", "0_1/meta.json"]
    return tmp_path


def test_each_level_is_read_whole_the_finest_by_default(folder):
    assert len(ps.load(folder)) == FINE and same(ps.load(folder), ps.load(folder / "lod-meta.json"))
    assert len(read_sog_stream(folder, 1)) == COARSE
    assert kind_of(folder) == "streamed SOG" == ps.info(folder).format


def test_a_box_holds_one_standard_deviation_of_every_gaussian(folder):
    leaf = json.loads((folder / "lod-meta.json").read_text())["tree"]["children"][1]
    parts = [normal_scene(FINE, seed=1)[200:], normal_scene(COARSE, seed=2)[40:]]
    low = torch.cat([part.means - part.stds.amin(dim=1, keepdim=True) for part in parts]).amin(
        dim=0
    )
    far = torch.cat(
        [part.means - 3**0.5 * part.stds.amax(dim=1, keepdim=True) for part in parts]
    ).amin(dim=0)
    found = torch.tensor(leaf["bound"]["min"])
    assert bool((found <= low + 1e-5).all()) and bool((found >= far - 1e-5).all())


def test_an_older_stream_is_replaced_and_nothing_is_left_of_a_failure(folder, monkeypatch):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    scene = normal_scene(30)
    leaf = Node(rows=(torch.arange(30),))
    with monkeypatch.context() as patch:
        patch.setattr("pointsplat_ns.scene.formats.sog_stream.sog_parts", lambda *a, **k: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            write_sog_stream([scene], leaf, folder / "lod-meta.json", 10)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    write_sog_stream([scene], leaf, folder / "lod-meta.json", 10)
    assert len(ps.load(folder)) == 30


LIES = {
    "another version": ({"version": 2}, "version 1"),
    "no level": ({"lodLevels": 0}, "0 levels"),
    "one name twice": ({"filenames": ["0_0/meta.json"] * 3}, "filenames"),
    "a file elsewhere": (
        {"filenames": ["/etc/meta.json", "b/meta.json", "c/meta.json"]},
        "own folder",
    ),
    "an address": (
        {"filenames": ["https://a.b/meta.json", "b/meta.json", "c/meta.json"]},
        "own folder",
    ),
    "a file of another kind": (
        {"filenames": ["passwd", "b/meta.json", "c/meta.json"]},
        "meta.json or a .sog",
    ),
    "no tree": ({"tree": None}, "node of the tree"),
    "a file beyond the last": (
        {"tree": {"lods": {"0": {"file": 3, "offset": 0, "count": 1}}}},
        "file 3 of 3",
    ),
    "rows that are infinite": (
        {"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 1e400}}}},
        "whole numbers",
    ),
    "too many rows": (
        {"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 201}}}},
        "200 Gaussians",
    ),
    "more than memory holds": (
        {"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 10**15}}}},
        "memory",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_one_error(folder, lie):
    (changes, said) = LIES[lie]
    path = folder / "lod-meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    fails(lambda: ps.load(path), said, error=ps.SceneError)


def test_a_deep_tree_and_a_missing_file_are_one_error(folder):
    deep = (
        '{"lodLevels":1,"filenames":[],"tree":' + '{"children":[' * 100_000 + "]}" * 100_000 + "}"
    )
    (folder / "0_1" / "quats.webp").unlink()
    fails(lambda: ps.load(folder), "quats.webp", error=ps.SceneError)
    (folder / "lod-meta.json").write_text(deep)
    fails(lambda: ps.load(folder), "damaged streamed SOG", error=ps.SceneError)
    (folder / "lod-meta.json").write_text('{"lodLevels":2,"filenames":[],"tree":{}}')
    fails(lambda: read_sog_stream(folder, 2), "no level 2", error=ps.SceneError)


EXTREMES = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    1e-45,
    1e-38,
    88.0,
    -104.0,
    8388607.0,
    1e20,
    -3.4e38,
    3.4e38,
    np.inf,
    -np.inf,
    np.nan,
]

NUMBERS = st.one_of(st.sampled_from(EXTREMES), st.floats(-5, 5, width=32))

QUICK = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@st.composite
def scenes(draw):
    """Scenes of up to five Gaussians of any degree, in which any number may be extreme."""
    n = draw(st.integers(0, 5))
    degree = draw(st.integers(0, 3))
    tails = ((3,), (3,), (4,), (1,), (3,), ((degree + 1) ** 2 - 1, 3))
    tables = (
        draw(arrays.arrays(np.float64, (n, *tail), elements=NUMBERS)).astype(np.float32)
        for tail in tails
    )
    return ps.Gaussians(*(torch.from_numpy(table) for table in tables))


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".splat"])
@given(scene=scenes())
@QUICK
def test_what_can_be_drawn_of_an_extreme_scene_is_written_and_read_back(tmp_path, suffix, scene):
    path = tmp_path / f"a{suffix}"
    usable = scene[scene.usable()]
    try:
        ps.save(scene, path, overwrite=True)
    except ps.SceneError as error:  # SPZ reaches to 2^23 units
        assert (
            suffix == ".spz"
            and float(usable.means.abs().max()) > 2**23 - 1
            and "\n" not in str(error)
        )
        return
    again = ps.load(path)
    assert len(again) == len(usable) and all(
        bool(value.isfinite().all()) for value in again.tensors()
    )
    assert suffix != ".ply" or same_bits(again, keep_usable(scene, path))
    ps.save(again, path, overwrite=True)  # what was read is written again
    assert len(ps.load(path)) == len(again)
