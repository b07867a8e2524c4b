"""Pruning files, and streamed levels."""

import dataclasses
import json
import math

import pytest
import torch

import pointsplat_ns as ps
from making import ball, box_room, same
from pointsplat_ns.cli import main
from pointsplat_ns.comparing.closeness import DenseReference
from pointsplat_ns.compression.pictures import opacity_quantiles, plot_distributions, size_quantiles
from pointsplat_ns.compression.prune import Pruned, prune_scene
from pointsplat_ns.compression.requests import PruneRequest
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats.sog_stream import read_sog_stream
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.levels.stream import Node, partition
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.merging import MERGING
from pointsplat_ns.pruning import METHODS, Keep, WithinPsnr, select
from pointsplat_ns.system.progress import silent
from pointsplat_ns.views import Views


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return ball(400)


@pytest.fixture(scope="module")
def views(scene) -> Views:
    return sample_views(scene, 3, 48, 36)


def pruned(
    scene: Gaussians, views: Views | ViewSource | None, keep: Keep | str, by: str = "merge", progress=silent, **options
) -> Pruned:
    """Pruned with renders compared in the given views."""
    source = ViewSource(scene, given=views) if isinstance(views, Views) else views
    return prune_scene(scene, PruneRequest(keep, by, **options), source, progress)


@pytest.mark.parametrize("by", sorted(name for name, method in METHODS.items() if method.needs_views))
def test_a_score_that_looks_at_the_scene_is_computed_once_and_chooses(by, scene, views, monkeypatch):
    calls = []
    method = METHODS[by]

    def counted(*args, **options):
        calls.append(1)
        return method.score(*args, **options)

    monkeypatch.setitem(METHODS, by, dataclasses.replace(method, score=counted))
    result = pruned(scene, views, WithinPsnr(20.0), by)
    assert calls == [1]
    assert same(result.scene, scene[select(method.score(scene, views), len(result.scene))])


def test_a_psnr_in_a_format_is_reached_by_its_rounded_scene(scene, views):
    plain, small = (pruned(scene, views, WithinPsnr(22.0, suffix), "coverage").scene for suffix in (".ply", ".spz"))
    assert len(encode_spz(small)) < len(encode_spz(plain))
    assert DenseReference(scene, views).psnr(small)[0] >= 22.0


def test_auto_sh_keeps_bands_that_are_seen_and_drops_those_that_are_not(scene, views):
    faint = scene.replace(features_rest=scene.features_rest * 1e-3)
    assert pruned(faint, views, 1.0, "paper", sh="auto").scene.sh_degree == 0
    strong = scene.replace(features_rest=scene.features_rest * 10)
    result = pruned(strong, views, 1.0, "paper", sh="auto")
    assert result.scene.sh_degree == 1
    assert result.notes == ("views: given views", "SH degree 1 kept")


def test_distributions_are_numbers_and_a_picture(scene, tmp_path):
    assert opacity_quantiles(scene)[1] == pytest.approx(float(scene.alphas.median()), abs=0.01)
    assert size_quantiles(scene) == sorted(size_quantiles(scene))
    assert all(math.isnan(value) for value in size_quantiles(scene[:0]) + opacity_quantiles(scene[:0]))
    flat = scene.replace(scales=torch.full_like(scene.scales, -math.inf))
    for i, after in enumerate((scene[:50], scene[:1], scene[:0], flat)):
        plot_distributions({"before": scene, "after": after}, tmp_path / f"{i}.png")
        assert (tmp_path / f"{i}.png").read_bytes().startswith(b"\x89PNG")


def test_merging_stands_upright_in_views_that_are_sampled_for_it():
    scene = box_room(0, 3000)
    source = ViewSource(scene, resolution=(64, 48), up=up_named("x"))
    looked = source.for_merging().views(MERGING.sampled_views, MERGING.view_seed)
    assert (looked.width, looked.height) == (64, 48)
    steep = (looked.viewmats[:, 2, :3] @ source.sampler.up.direction).abs() > 0.99  # level has no meaning there
    level = looked.viewmats[~steep, 0, :3] @ source.sampler.up.direction  # no camera is rolled about its axis
    assert int(steep.sum()) <= 6 and float(level.abs().max()) < 1e-6


@pytest.fixture(scope="module")
def levels() -> ps.Levels:
    """Of a ball of which one Gaussian in ten is too faint to be drawn. Shared, so do not write to it."""
    scene = ball(400, opacity=1.0, bright=1.0)
    scene.opacities[::10] = -9.0
    return ps.lod(scene, ["100%", "50%", "10%"], views=ps.sample_views(scene, 2, 32, 24))


def leaves_of(node: Node) -> list[Node]:
    return [leaf for child in node.children for leaf in leaves_of(child)] if node.children else [node]


def test_each_gaussian_that_is_drawn_is_in_one_leaf_with_its_parent(levels):
    parents = levels.parents
    leaves = leaves_of(partition(levels.scenes, parents, 100))
    assert len(leaves) > 3
    for index, scene in enumerate(levels.scenes):
        rows = torch.cat([leaf.rows[index] for leaf in leaves])
        kept = torch.arange(len(scene)) if index else (parents[0] >= 0).nonzero()[:, 0]
        assert torch.equal(rows.sort().values, kept)
    for leaf in leaves:
        for finer, coarser, of in zip(leaf.rows, leaf.rows[1:], parents, strict=False):
            assert set(of[finer].tolist()) == set(coarser.tolist()), "no gap and nothing twice between levels"
    largest = int(torch.bincount(parents[1][parents[0][parents[0] >= 0]]).max())  # one family is not cut
    assert max(len(leaf.rows[0]) for leaf in leaves) <= max(100, largest)
    assert len(leaves_of(partition(levels.scenes, parents, 400))) == 1


def test_wide_leaves_of_many_gaussians_are_cut(levels):
    leaves = leaves_of(partition(levels.scenes, levels.parents, 400, extent=0.5, least=40))
    for leaf in leaves:
        means = levels[-1].scene.means[leaf.rows[-1]]
        assert len(leaf.rows[0]) <= 40 or float((means.amax(dim=0) - means.amin(dim=0)).max()) <= 0.5
    assert len(leaves) > 3


def test_the_command_writes_the_scene_and_its_levels(tmp_path, capsys):
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    arguments = ["lod", str(tmp_path / "room.ply"), "--stream", "--levels", "25%", "50%"]
    main(arguments)
    folder = tmp_path / "room_stream"
    assert "level_2" in capsys.readouterr().out and not (folder / "lod.json").exists()
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == [400, 200, 100]
    assert [len(read_sog_stream(folder, level)) for level in range(3)] == [400, 200, 100]
    with pytest.raises(SystemExit):
        main(arguments)
    assert "exists already" in capsys.readouterr().err
