"""A trained refiner is loaded from a file of weights or from a run, without nerfstudio."""

import os
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import normal_scene, small_refiner
from pointsplat_ns.errors import BudgetError, SceneError
from pointsplat_ns.pipeline.trained_refiner import load_refiner, open_refiner_run, scenes_of_run
from pointsplat_ns.pruning import PruneSettings, prune
from pointsplat_ns.refinement import WeightsError, save_refiner

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize(
    ("metadata", "settings"),
    [
        ({}, PruneSettings(0.1, "merge")),
        ({"keep": 0.3, "by": "coverage", "steps": 5}, PruneSettings(0.3, "coverage")),
        ({"keep": "0.3", "by": "paper", "opacity_weight": "0.7"}, PruneSettings(0.3, "paper", 0.7)),
        ({"keep": 0.3, "by": "merge", "opacity_weight": 0.3}, PruneSettings(0.3, "merge")),
        ({"keep": 500}, PruneSettings(500, "merge")),
    ],
)
def test_a_file_of_weights_says_what_it_was_trained_with(metadata, settings, tmp_path):
    save_refiner(small_refiner(), tmp_path / "r.safetensors", metadata)
    loaded = load_refiner(tmp_path / "r.safetensors")
    assert loaded.settings == settings
    assert loaded.source == tmp_path / "r.safetensors"
    assert not loaded.network.training


@pytest.mark.parametrize(
    "metadata",
    [
        {"keep": 1.5},
        {"keep": 10**400},
        {"by": "best"},
        {"opacity_weight": []},
        {"opacity_weight": -(10**400)},
    ],
)
def test_metadata_that_make_no_sense_are_refused_in_one_line(metadata, tmp_path):
    save_refiner(small_refiner(), tmp_path / "r.safetensors", metadata)
    with pytest.raises(WeightsError, match="r.safetensors: metadata not understood") as caught:
        load_refiner(tmp_path / "r.safetensors")
    assert "\n" not in str(caught.value)


def test_anything_else_is_no_refiner(tmp_path):
    (tmp_path / "scene.ply").touch()
    with pytest.raises(
        WeightsError, match="scene.ply: a .ply file; expected a trained pointsplat run"
    ):
        load_refiner(tmp_path / "scene.ply")
    with pytest.raises(SceneError, match="no such file"):
        load_refiner(tmp_path / "gone")
    with pytest.raises(WeightsError, match="no such file"):
        load_refiner(tmp_path / "gone.safetensors")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "config.yml").touch()  # of a run in the same folder
    with pytest.raises(
        WeightsError, match="pipe: not a regular file; expected a trained pointsplat run"
    ):
        load_refiner(tmp_path / "pipe")


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_scene_of_any_size_and_degree_is_pruned_and_refined(
    make_refined_run, trained_walls, tmp_path, degree
):
    loaded = load_refiner(
        make_refined_run(tmp_path, trained_walls, moved=0.25, keep=0.4, by="opacity")
    )
    assert loaded.settings == PruneSettings(0.4, "opacity")
    dense = normal_scene(60, degree, seed=7)
    small = loaded(loaded.settings.prune(dense))
    pruned = prune(dense, 0.4, "opacity")
    assert len(small) == 24 and small.sh_degree == degree
    assert torch.equal(small.opacities, pruned.opacities + 0.25) and torch.equal(
        small.means, pruned.means
    )
    assert not small.means.requires_grad and not loaded.network.training
    assert (
        len(ps.compact(dense, 7, loaded).scene) == 7
        and len(ps.compact(dense, 0.1, loaded).scene) == 6
    )
    with pytest.raises(BudgetError, match="keep is 0 Gaussians; expected at least 1"):
        ps.compact(dense, 0, loaded)


def test_scenes_are_known_by_name_and_the_first_held_out_is_the_default(
    make_refined_run, trained_walls, tmp_path
):
    def scenes_and_shown(
        folder: str, eval_scenes: tuple[str, ...] = ()
    ) -> tuple[dict[str, Path], str]:
        run = make_refined_run(tmp_path / folder, trained_walls, eval_scenes)
        return scenes_of_run(open_refiner_run(run, need_data=True))

    scenes, shown = scenes_and_shown("1")
    assert list(scenes) == ["wall-a", "wall-b"] and shown == "wall-a"
    assert all(path.suffix == ".ckpt" and path.is_file() for path in scenes.values())
    assert scenes_and_shown("2", ("wall-b",))[1] == "wall-b"
    # The viewer and ns-export show the first held-out scene by name, whatever the order on the
    # command line was.
    assert scenes_and_shown("3", ("wall-b", "wall-a"))[1] == "wall-a"


def test_the_refiner_alone_needs_no_scenes(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, Path("/not/on/this/machine"))
    assert load_refiner(run).settings == PruneSettings(0.5, "paper")
    with pytest.raises(SceneError, match="config.yml: its data .*is missing"):
        open_refiner_run(run, need_data=True)


def test_runs_of_another_method_are_refused(trained_walls):
    (splatfacto,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    with pytest.raises(
        SceneError, match="a run of the method splatfacto-cpu; expected a pointsplat run"
    ):
        load_refiner(splatfacto)


@pytest.mark.parametrize(
    ("found", "damaged", "message"),
    [
        ("size: tiny", "size: small", "not a usable pointsplat checkpoint"),
        ("size: tiny", "size: huge", "config.yml: .*huge"),
        ("size: tiny\n", "sighs: tiny\n", "config.yml: lacks 'size'"),
        ("keep: 0.5", "keep: 1.5", r"config.yml: keep is 1.5; expected a ratio"),
        ("keep: 0.5", "keep: half", "half"),
    ],
)
def test_a_damaged_configuration_is_refused_in_one_line(
    found, damaged, message, make_refined_run, trained_walls, tmp_path
):
    run = make_refined_run(tmp_path, trained_walls)
    text = (run / "config.yml").read_text()
    assert found in text
    (run / "config.yml").write_text(text.replace(found, damaged))
    with pytest.raises(SceneError, match=message) as caught:
        load_refiner(run)
    assert "\n" not in str(caught.value) and str(run) in str(caught.value)


def test_a_damaged_checkpoint_is_refused(make_refined_run, tmp_path):
    run = make_refined_run(tmp_path, Path("nowhere"))
    checkpoint = run / "nerfstudio_models" / "step-000000009.ckpt"
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match="no complete checkpoint"):
        load_refiner(run)
    torch.save({"step": 9, "pipeline": {}}, checkpoint)
    with pytest.raises(SceneError, match="step-000000009.ckpt: not a usable pointsplat checkpoint"):
        load_refiner(run)


@pytest.mark.parametrize("by", ["paper", "opacity"])
def test_the_network_that_ships_for_selections_brings_a_room_closer_that_it_never_saw(by):
    refiner = load_refiner("shipped", "cpu", by=by)
    assert refiner.settings.by == "paper" and refiner.network.config.units == "local"
    assert refiner.source.stat().st_size <= 10e6
    room = ps.example_room()
    views = ps.sample_views(room, 12, width=160, height=120)
    renders = [ps.render(room, view) for view in views]

    def psnr(scene: ps.Gaussians) -> float:
        each = [
            ps.psnr(ps.render(scene, view), image)
            for view, image in zip(views, renders, strict=True)
        ]
        return float(torch.stack(each).mean())

    small = prune(room, 0.1, by)
    # at 320 x 240, 6.8 and 3.4 dB were measured
    assert psnr(ps.refine(small, refiner, kept=0.1)) > psnr(small) + 2.0


def test_the_network_that_ships_for_merging_is_another():
    assert load_refiner("shipped", "cpu").settings.by == "merge"
    assert load_refiner(None, "cpu", by="merge").network.config.units == "scene"
