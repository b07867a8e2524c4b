"""What nerfstudio's viewer and the exporters get of the model."""

import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import same
from pointsplat_ns.io import read_ply


def test_the_viewer_gets_what_it_reads_of_a_splatfacto_model(evaluated, trained_walls):
    model = evaluated.model
    assert isinstance(model, SplatfactoModel)
    camera, _ = evaluated.datamanager.scenes[1].eval_frames[0]
    outputs = model.get_outputs_for_camera(camera)
    sizes = {name: tuple(value.shape) for name, value in outputs.items()}
    assert sizes == {"rgb": (48, 64, 3), "depth": (48, 64, 1), "accumulation": (48, 64, 1), "background": (48, 64, 3)}
    assert all(value.isfinite().all() and not value.requires_grad for value in outputs.values())
    assert outputs["accumulation"].max() > 0.5
    names = {"means", "scales", "quats", "features_dc", "features_rest", "opacities"}
    assert set(model.gauss_params) == names and model.num_points == len(model.pruned_scene(1).pruned)
    assert torch.equal(model.shs_rest, model.gauss_params["features_rest"])
    assert torch.equal(model.shs_0, model.gauss_params["features_dc"])
    assert model.colors.shape == (model.num_points, 3)
    assert len(evaluated.datamanager.train_dataset) == 9 and len(evaluated.datamanager.eval_dataset) == 2
    half = OrientedBox.from_params((-50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (100.0, 100.0, 100.0))
    inside = model.gaussians[model.gaussians.means[:, 0] < 0]
    expected = model.draw(inside, evaluated.datamanager.scenes[1], camera)
    torch.testing.assert_close(model.get_outputs_for_camera(camera, obb_box=half)["rgb"], expected["rgb"])
    far = OrientedBox.from_params((900.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera, obb_box=far)
    assert torch.equal(empty["rgb"], torch.ones(48, 64, 3)), "wall-b was trained over white"
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], outputs["rgb"]), "the crop box does not stay"


def test_both_exporters_write_the_refined_scene_with_the_photos_gone(trained, trained_walls, wall_scene, tmp_path):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    from pointsplat_ns.cli.export import export

    config, trainer, _ = trained
    expected = trainer.pipeline.eval().model.gaussians
    photos, hidden = wall_scene, wall_scene.with_name("hidden")
    photos.rename(hidden)
    try:
        ExportGaussianSplat(load_config=config.get_base_dir() / "config.yml", output_dir=tmp_path).main()
        export(config.get_base_dir(), tmp_path / "ours.ply")
    finally:
        hidden.rename(photos)
    theirs, ours = read_ply(tmp_path / "splat.ply"), read_ply(tmp_path / "ours.ply")
    assert same(ours, expected)
    drawn = expected[expected.opacities[:, 0] >= -5.5373]  # ns-export drops opacities below 1/255
    assert len(drawn) > 0 and same(theirs, drawn)
