"""Levels of detail: how many Gaussians, that they are nested, and that the manifest is true."""

import hashlib
import json
from pathlib import Path

import pytest
import torch
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball, same
from pointsplat_ns.pipeline.quality import Judge
from pointsplat_ns.pipeline.repair_budget import STEPS
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.formats.sog_stream import read_sog_stream
from pointsplat_ns.tools.levels import folder as level_folder
from pointsplat_ns.tools.levels.stream import Node, partition

pytestmark = pytest.mark.usefixtures("quick")

ASKED = ("50%", "25%", "10%", "3%")


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    """A ball of which one Gaussian in ten is too faint to be drawn. Shared, so do not write to
    it."""
    scene = ball(400, opacity=1.0, bright=1.0)
    scene.opacities[::10] = -9.0
    return scene


@pytest.fixture(scope="module")
def views(scene) -> ps.Views:
    return ps.sample_views(scene, 3, 48, 36)


@pytest.fixture(scope="module")
def levels(scene, views) -> ps.Levels:
    return ps.lod(scene, ASKED, views=views)


@pytest.fixture(scope="module")
def folder(scene, views, tmp_path_factory) -> Path:
    """What is written while levels are made from a file."""
    place = tmp_path_factory.mktemp("lod")
    ps.save(scene, place / "ball.ply")
    ps.lod(place / "ball.ply", ASKED, views=views, folder=place / "out")
    return place / "out"


def manifest_of(folder: Path) -> dict:
    """The manifest, read as strictly as a browser does."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads((folder / "lod.json").read_text("utf-8"), parse_constant=refuse)


def test_a_level_alone_is_what_prune_and_compact_give(scene, views, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 60)
    alone = ps.lod(scene, ["50%"], views=views)[0].scene
    assert same(alone, ps.prune(scene, "50%", views=views))
    assert not same(alone, ps.prune(scene, "50%")), "merging looks from the views"
    [repaired] = ps.lod(scene, ["10%"], views=views, effort="quick")
    expected = ps.compact(scene, "10%", views=views, effort="quick")
    assert repaired.repair.accepted and repaired.facts(400)["repaired"] and expected.repair_accepted
    assert same(repaired.scene, expected.scene)


def test_levels_after_an_interrupted_repair_are_only_merged(scene, levels, views, monkeypatch):
    monkeypatch.setitem(STEPS, "quick", 4)

    def report(what: str, share: float) -> None:
        if what == "level 1: repairing" and share > 0:
            raise KeyboardInterrupt

    made = ps.lod(scene, ["100%", *ASKED], views=views, effort="quick", progress=report)
    assert made.interrupted and [level.repair is not None for level in made] == [
        False,
        True,
        False,
        False,
        False,
    ]
    assert all(map(same, made.scenes[2:], levels.scenes[1:]))


def test_the_manifest_is_true_of_the_files(folder, scene, views):
    manifest = manifest_of(folder)
    assert (manifest["format"], manifest["version"]) == ("pointsplat-lod", 2)
    source = (folder.parent / "ball.ply").read_bytes()
    assert manifest["source"] == {
        "file": "ball.ply",
        "bytes": len(source),
        "sha256": hashlib.sha256(source).hexdigest(),
        "count": 400,
        "sh_degree": 1,
    }
    named = {"lod.json"}
    for level, count in zip(manifest["levels"], (200, 100, 40, 12), strict=True):
        content = (folder / level["file"]).read_bytes()
        assert (level["bytes"], level["sha256"]) == (
            len(content),
            hashlib.sha256(content).hexdigest(),
        )
        named.add(level["file"])
        read = ps.load(folder / level["file"])
        assert (len(read), read.sh_degree) == (level["count"], level["sh_degree"]) == (count, 1)
        assert level["share"] == count / 400
        psnrs = DenseReference(scene, views).psnr(read)
        assert (level["psnr"], level["worst_psnr"]) == pytest.approx(psnrs, abs=1e-6)
        assert level["quality"].startswith(f"{level['psnr']:.1f} dB, SSIM {level['ssim']:.2f}: ")
    assert manifest["views"]["origin"] == "given views"
    assert [manifest["views"][key] for key in ("count", "width", "height")] == [3, 48, 36]
    assert {path.name for path in folder.iterdir()} == named
    corners = {"min": scene.means.amin(dim=0).tolist(), "max": scene.means.amax(dim=0).tolist()}
    assert manifest["bounds"]["all"] == corners
    content = manifest["bounds"]["content"]
    inside = (
        (scene.means >= torch.tensor(content["min"]))
        & (scene.means <= torch.tensor(content["max"]))
    ).double()
    assert all(0.85 < share < 0.95 for share in inside.mean(dim=0).tolist())


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("where", [(Judge, "quality"), (level_folder, "write_ply")])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ps.SceneError])
def test_levels_that_fail_leave_nothing_and_the_old_ones_stay(
    where, error, scene, views, tmp_path, monkeypatch
):
    def failing(*_, **__):
        raise error("now")

    ps.lod(scene, ["5%"], views=views, folder=tmp_path / "old")
    before = contents(tmp_path / "old")
    monkeypatch.setattr(*where, failing)
    for name in ("new", "old"):
        with pytest.raises(error):
            ps.lod(scene, ["50%", "25%"], views=views, folder=tmp_path / name, force=True)
    assert contents(tmp_path / "old") == before and not (tmp_path / "new").exists()


@pytest.mark.parametrize("taken", ["lod.json", "level_3.ply"])
def test_existing_files_are_only_overwritten_by_force(taken, scene, levels, tmp_path):
    (tmp_path / "other.txt").write_text("mine")
    (tmp_path / taken).write_text("precious")
    for refused in (
        lambda: ps.lod("not_there.ply", ASKED, folder=tmp_path),
        lambda: levels.save(tmp_path),
    ):
        with pytest.raises(
            ps.SceneError, match=f"{taken}: exists already; name another folder, or .* --force"
        ):
            refused()
    assert {name: text.decode() for name, text in contents(tmp_path).items()} == {
        "other.txt": "mine",
        taken: "precious",
    }
    levels.save(tmp_path, force=True)
    assert (tmp_path / taken).read_bytes() != b"precious" and (
        tmp_path / "other.txt"
    ).read_text() == "mine"


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (["0"], "level 0: keep is 0 Gaussians; expected at least 1"),
        ([0.5, 1.5], r"level 1\.5: keep is 1.5"),
        (["0.0001MB"], "level 0.0001MB: keep is 0.0001MB, too small for one Gaussian"),
        ([True], "level True: keep is True"),
        ("", "no level given"),
    ],
)
def test_levels_that_do_not_fit_are_refused_and_nothing_is_written(asked, message, scene, tmp_path):
    with pytest.raises(ps.BudgetError, match=message):
        ps.lod(scene, asked, folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ps.PointSplatError, match="sh is '4'"):
        ps.lod("not_there.ply", sh="4")


def test_bands_are_cut_for_all_levels_and_the_error_is_against_all_bands(scene, views):
    cut = ps.lod(scene, ["100%", "10%"], sh="0", views=views)
    assert [level.scene.sh_degree for level in cut] == [0, 0] and cut.dense.sh_degree == 1
    assert 0 < cut[1].quality.psnr < cut[0].quality.psnr
    assert any(note.startswith("SH degree 1 cut to 0") for note in cut.notes)
    assert same(cut[1].scene, ps.prune(scene, "10%", sh="0", views=views))


@pytest.fixture()
def ply(tmp_path) -> Path:
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    return tmp_path / "room.ply"


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), {}),
        (("--levels", "10%", "0.5", "20", "--sh", "0"), {"levels": [0.5, "10%", 20], "sh": "0"}),
        (("--levels", "0.01MB"), {"levels": ["0.01MB"]}),
    ],
)
def test_pointsplat_lod_writes_what_lod_gives_bit_for_bit(arguments, options, ply, tmp_path):
    run("lod", ply, *arguments, "-o", tmp_path / "by_command")
    ps.lod(ply, **options).save(tmp_path / "by_api")
    assert contents(tmp_path / "by_command") == contents(tmp_path / "by_api")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--levels", "50%", "200"), "levels 50% and 200 both mean 200 of 400 Gaussians"),
        (("--levels", "auto:35"), "level auto:35: expected a ratio"),
        (
            ("-o", "levels.ply"),
            "levels.ply: levels are several files; expected the name of a folder",
        ),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line_and_writes_nothing(
    arguments, message, ply, tmp_path, capsys
):
    assert message in refusal(capsys, tmp_path, "lod", ply, *arguments)


@pytest.fixture(scope="module")
def three_levels(scene, views) -> ps.Levels:
    return ps.lod(scene, ["100%", "50%", "10%"], views=views)


def leaves_of(node: Node) -> list[Node]:
    return (
        [leaf for child in node.children for leaf in leaves_of(child)] if node.children else [node]
    )


def test_each_gaussian_that_is_drawn_is_in_one_leaf_with_its_parent(three_levels):
    parents = three_levels.parents
    leaves = leaves_of(partition(three_levels.scenes, parents, 100))
    assert len(leaves) > 3
    for index, scene in enumerate(three_levels.scenes):
        rows = torch.cat([leaf.rows[index] for leaf in leaves])
        kept = torch.arange(len(scene)) if index else (parents[0] >= 0).nonzero()[:, 0]
        assert torch.equal(rows.sort().values, kept)
    for leaf in leaves:
        for finer, coarser, of in zip(leaf.rows, leaf.rows[1:], parents, strict=False):
            assert set(of[finer].tolist()) == set(coarser.tolist()), (
                "no gap and nothing twice between levels"
            )
    largest = int(
        torch.bincount(parents[1][parents[0][parents[0] >= 0]]).max()
    )  # one family is not cut
    assert max(len(leaf.rows[0]) for leaf in leaves) <= max(100, largest)
    assert len(leaves_of(partition(three_levels.scenes, parents, 400))) == 1


def test_wide_leaves_of_many_gaussians_are_cut(three_levels):
    leaves = leaves_of(
        partition(three_levels.scenes, three_levels.parents, 400, extent=0.5, least=40)
    )
    for leaf in leaves:
        means = three_levels[-1].scene.means[leaf.rows[-1]]
        assert (
            len(leaf.rows[0]) <= 40 or float((means.amax(dim=0) - means.amin(dim=0)).max()) <= 0.5
        )
    assert len(leaves) > 3


def test_the_command_writes_a_stream_of_the_scene_and_its_levels(ply, tmp_path, capsys):
    words = ("lod", ply, "--stream", "--levels", "25%", "50%")
    run(*words)
    folder = tmp_path / "room_stream"
    assert "level_2" in capsys.readouterr().out and not (folder / "lod.json").exists()
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == [400, 200, 100]
    assert [len(read_sog_stream(folder, level)) for level in range(3)] == [400, 200, 100]
    assert "exists already" in refusal(capsys, tmp_path, *words)
