"""Levels as a streamed SOG: leaves hold the same part of every level, and sizes are kept."""

import json

import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.cli import main
from pointsplat_ns.compression.level_stream import Chunks, Node, partition
from pointsplat_ns.io.formats.sog_stream import read_sog_stream


@pytest.fixture(scope="module")
def levels() -> ps.Levels:
    """Of a ball of which one Gaussian in ten is too faint to be drawn. Shared, so do not write to it."""
    scene = ball(400, opacity=1.0, bright=1.0)
    scene.opacities[::10] = -9.0
    return ps.lod(scene, ["100%", "50%", "10%"], views=ps.sample_views(scene, 2, 32, 24))


def leaves_of(node: Node) -> list[Node]:
    return [leaf for child in node.children for leaf in leaves_of(child)] if node.children else [node]


def parents_of(levels: ps.Levels) -> list[torch.Tensor]:
    return [level.parents.long() for level in levels.levels[1:]]


def test_each_gaussian_that_is_drawn_is_in_one_leaf_with_its_parent(levels):
    parents = parents_of(levels)
    leaves = leaves_of(partition(levels.scenes, parents, Chunks(100)))
    assert len(leaves) > 3
    for index, scene in enumerate(levels.scenes):
        rows = torch.cat([leaf.rows[index] for leaf in leaves])
        kept = torch.arange(len(scene)) if index else (parents[0] >= 0).nonzero()[:, 0]
        assert torch.equal(rows.sort().values, kept)
    for leaf in leaves:
        for finer, coarser, of in zip(leaf.rows, leaf.rows[1:], parents, strict=False):
            assert set(of[finer].tolist()) == set(coarser.tolist()), "no gap and nothing twice between levels"


def test_leaves_have_at_most_as_many_gaussians_as_asked_for(levels):
    parents = parents_of(levels)
    largest = int(torch.bincount(parents[1][parents[0][parents[0] >= 0]]).max())  # one family is not cut
    leaves = leaves_of(partition(levels.scenes, parents, Chunks(50)))
    assert max(len(leaf.rows[0]) for leaf in leaves) <= max(50, largest)
    assert len(leaves_of(partition(levels.scenes, parents, Chunks(400)))) == 1


def test_wide_leaves_of_many_gaussians_are_cut(levels):
    leaves = leaves_of(partition(levels.scenes, parents_of(levels), Chunks(extent=0.5, least=40)))
    for leaf in leaves:
        means = levels[-1].scene.means[leaf.rows[-1]]
        assert len(leaf.rows[0]) <= 40 or float((means.amax(dim=0) - means.amin(dim=0)).max()) <= 0.5
    assert len(leaves) > 3


def test_gaussians_of_one_place_are_cut_too():
    scene = ball(64)
    scene.means[:] = 1.0
    leaves = leaves_of(partition([scene], [], Chunks(10, 1.0)))
    assert max(len(leaf.rows[0]) for leaf in leaves) <= 10 and sum(len(leaf.rows[0]) for leaf in leaves) == 64


@pytest.mark.parametrize("sizes", [{"count": 0}, {"extent": 0.0}, {"extent": float("nan")}])
def test_sizes_are_positive(sizes):
    with pytest.raises(ps.BudgetError, match="positive"):
        Chunks(**sizes)


def test_the_command_writes_the_scene_and_its_levels(tmp_path, capsys):
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    arguments = ["lod", str(tmp_path / "room.ply"), "--stream", "--levels", "25%", "50%"]
    main(arguments)
    folder = tmp_path / "room_stream"
    assert "level_2" in capsys.readouterr().out and not (folder / "lod.json").exists()
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == [400, 200, 100]
    assert [len(read_sog_stream(folder, level)) for level in range(3)] == [400, 200, 100]
    main(["convert", str(folder), str(tmp_path / "finest.ply")])
    assert len(ps.load(tmp_path / "finest.ply")) == 400
    with pytest.raises(SystemExit):
        main(arguments)
    assert "exists already" in capsys.readouterr().err
    main([*arguments, "--force", "--json"])
    assert [level["count"] for level in json.loads(capsys.readouterr().out)["levels"]] == [400, 200, 100]
