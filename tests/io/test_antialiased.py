"""That a scene was trained with antialiasing: read, drawn by, kept on the way, and written again."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import pointsplat_ns as ps
from making import ball, cloud, run_of, same_bits, small_refiner
from pointsplat_ns.gaussians import Traits
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.io.ply import PlyRows
from pointsplat_ns.pruning import Megabytes
from pointsplat_ns.rasterizer.drawing import Drawing
from pointsplat_ns.rasterizer.scene import pixels_of
from pointsplat_ns.rasterizer.tiles import Region

HOLDING = (".ply", ".compressed.ply", ".spz", ".sog", "meta.json")


def named(folder, suffix):
    return folder / (suffix if not suffix.startswith(".") else f"a{suffix}")


def trained_so(scene):
    return scene.replace(antialiased=True)


@pytest.mark.parametrize("suffix", HOLDING)
def test_files_that_can_say_it_keep_it(tmp_path, suffix):
    for scene in (cloud(20), trained_so(cloud(20))):
        ps.save(scene, named(tmp_path, suffix))
        back = ps.load(named(tmp_path, suffix))
        assert back.antialiased is scene.antialiased and len(back) == 20


def test_spz_of_version_4_keeps_it(tmp_path):
    (tmp_path / "a.spz").write_bytes(encode_spz(trained_so(cloud(20)), version=4))
    assert ps.load(tmp_path / "a.spz").antialiased


def test_only_the_comment_tells_two_ply_files_apart(tmp_path):
    ps.save(cloud(20), tmp_path / "a.ply")
    ps.save(trained_so(cloud(20)), tmp_path / "b.ply")
    a, b = (tmp_path / "a.ply").read_bytes(), (tmp_path / "b.ply").read_bytes()
    assert b == a.replace(b" 1.0\n", b" 1.0\ncomment SplatRenderMode: mip\n", 1)
    assert same_bits(ps.load(tmp_path / "a.ply"), ps.load(tmp_path / "b.ply"))
    rows = PlyRows.open(tmp_path / "b.ply")
    assert rows is not None and rows.traits.antialiased and rows.read(3, 5).antialiased


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode: MIP "], True),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["SplatRenderMode: default"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),  # the last one holds, as in Brush
        (["SplatRenderMode: default", "antialiased 1"], True),
        (["not antialiased 1", "antialiased", "antialiased 12", "SplatRenderMode:"], False),
    ],
)
def test_the_last_comment_of_a_ply_tells(tmp_path, suffix, comments, antialiased):
    ps.save(cloud(3), tmp_path / f"a{suffix}")
    lines = "".join(f"comment {comment}\n" for comment in comments).encode()
    (tmp_path / f"a{suffix}").write_bytes(
        (tmp_path / f"a{suffix}").read_bytes().replace(b" 1.0\n", b" 1.0\n" + lines, 1)
    )
    assert ps.load(tmp_path / f"a{suffix}").antialiased is antialiased


@pytest.mark.parametrize("suffix", [".splat", ".glb"])
def test_files_that_cannot_say_it_are_warned_of(tmp_path, suffix, caplog):
    ps.save(cloud(3, sh_degree=0), tmp_path / f"a{suffix}")
    assert not caplog.text
    ps.save(trained_so(cloud(3, sh_degree=0)), tmp_path / f"a{suffix}")
    assert "the mark of antialiased training; .sog keeps it" in caplog.text


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".glb"])
def test_the_size_of_a_file_is_known_to_the_byte_and_a_budget_holds(tmp_path, suffix):
    scene, path = trained_so(cloud(600)), tmp_path / f"a{suffix}"
    size = format_to_write(path).bytes_of
    ps.save(scene[:400], path)
    assert path.stat().st_size == size(400, 1, scene.traits)
    assert size(400, 1, scene.traits) - size(400, 1, cloud(1).traits) == (29 if "ply" in suffix else 0)
    kept = ps.prune(scene, Megabytes(size(400, 1, scene.traits) / 1e6, suffix), by="coverage")
    assert len(kept) == 400 and kept.antialiased
    just_too_small = Megabytes((size(400, 1, scene.traits) - 1) / 1e6, suffix)
    assert len(ps.prune(scene, just_too_small, by="coverage")) < 400


def test_it_is_drawn_so_from_any_view():
    scene = ball(500, 1, log_size=-5.0)
    views = ps.sample_views(scene, 2, 48, 32)
    antialiased = dataclasses.replace(views, rasterize_mode="antialiased")
    classic = ps.render(scene, views)
    wanted = ps.render(scene, antialiased)
    assert float((wanted - classic).abs().max()) > 0.01
    assert torch.equal(ps.render(trained_so(scene), views), wanted)
    assert torch.equal(ps.render(trained_so(scene), antialiased), wanted)
    assert torch.equal(pixels_of(trained_so(scene), views[0]), pixels_of(scene, antialiased[0]))
    drawing = Drawing(trained_so(scene), views[0])
    torch.testing.assert_close(drawing.draw(Region(0, 4, 0, 6)), wanted[0], rtol=0, atol=2e-6)
    for by in ("lightgaussian", "pup"):
        kept, expected = (ps.prune(s, 0.5, by, views=v) for s, v in ((trained_so(scene), views), (scene, antialiased)))
        assert same_bits(kept, expected)


def test_gradients_are_those_of_the_antialiased_picture():
    scene = ball(60, 1, log_size=-4.0).to(torch.float64)
    views = ps.sample_views(scene, 1, 24, 16)
    found = []
    for antialiased, mode in ((True, "classic"), (False, "antialiased")):
        leaves = scene.map(lambda value: value.clone().requires_grad_())
        picture = ps.render(leaves.replace(antialiased=antialiased), dataclasses.replace(views, rasterize_mode=mode))
        picture.square().sum().backward()
        found.append([value.grad for value in leaves.tensors()])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_it_and_the_declared_up_stay_on_every_way_through_the_package():
    scene = trained_so(ball(400, 1)).replace(up="-x")
    half = scene[:200]
    small = {
        "parts": half,
        "joined": ps.Gaussians.cat([half, half.replace(antialiased=False)]),
        "moved": scene.to(torch.float64).detach().map(torch.clone),
        "placed": ps.place(scene, up="z:y", scale=2.0),
        "merged": ps.prune(scene, 0.3),
        "by score": ps.prune(scene, 0.3, by="paper"),
        "refined": ps.refine(scene, small_refiner()),
        "compact": ps.compact(scene, 0.3, effort="quick", resolution=(64, 48)).scene,
        "levels": ps.lod(scene, [0.5, 0.2])[-1].scene,
    }
    wanted = dict.fromkeys(small, Traits(True, "-x")) | {"placed": Traits(True, "y")}
    assert {name: found.traits for name, found in small.items()} == wanted
    assert "antialiased" in repr(half) and "antialiased" not in repr(ball(3))
    assert ps.info(scene).antialiased


def test_a_run_says_how_it_was_trained(trained_walls, tmp_path):
    for name, antialiased in (("wall-a", False), ("wall-b", True)):
        run = run_of(trained_walls, name)
        (checkpoint,) = (run / "nerfstudio_models").glob("*.ckpt")
        for path in (run, run / "config.yml", checkpoint):
            assert ps.load(path).antialiased is antialiased
        lone = tmp_path / f"{name}.ckpt"
        lone.write_bytes(checkpoint.read_bytes())
        assert not ps.load(lone).antialiased
