"""The splatfacto-cpu model against nerfstudio's own, and its whole life: train, resume, evaluate,
export."""

import math
from dataclasses import replace
from unittest import mock

import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox, SceneBox
from nerfstudio.models import splatfacto as stock
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.utils import writer

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import (
    fitted_schedules,
    splatfacto_cpu_config,
)
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModelConfig
from pointsplat_ns.nerfstudio_plugin.trainer import STATE
from pointsplat_ns.rendering import rasterization

SEED = 20


def build(config, seeds=None, num_train_data: int = 3):
    box = SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    # Stock Splatfacto asks the network for LPIPS weights here; ours must not notice that there is
    # none.
    with mock.patch(
        "torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity",
        lambda **_: torch.nn.Identity(),
    ):
        return config.setup(scene_box=box, num_train_data=num_train_data, seed_points=seeds)


def random_seeds(num: int = 40):
    generator = torch.Generator().manual_seed(SEED)
    points = torch.rand((num, 3), generator=generator) - 0.5
    return points, torch.randint(0, 256, (num, 3), generator=generator).float()


def camera_at(z: float = 2.0) -> Cameras:
    pose = torch.eye(4)[None, :3].clone()
    pose[0, 2, 3] = z
    kind = {"camera_type": CameraType.PERSPECTIVE, "metadata": {"cam_idx": 1}}
    return Cameras(pose, 50.0, 55.0, 21.0, 15.0, 43, 31, **kind)


def pair(**settings):
    """Our model and nerfstudio's with one set of parameters."""
    ours = build(SplatfactoCpuModelConfig(**settings), random_seeds())
    theirs = build(SplatfactoModelConfig(num_random=40, **settings))
    with torch.no_grad():
        ours.gauss_params["features_rest"].normal_(generator=torch.Generator().manual_seed(SEED))
        for name, value in ours.gauss_params.items():
            theirs.gauss_params[name].copy_(value)
        for model in (ours, theirs):
            model.optimizers = {}
            model.step = 5000
            if settings.get("camera_optimizer"):
                model.camera_optimizer.pose_adjustment.fill_(0.01)
    return ours, theirs


def stock_outputs(model, camera):
    """Outputs of nerfstudio's own code with its two calls into CUDA replaced."""
    with (
        mock.patch.object(stock, "rasterization", rasterization),
        mock.patch.object(stock, "get_viewmat", viewmats_from_opengl),
        mock.patch.object(torch.Tensor, "cuda", lambda self: self),
    ):
        torch.manual_seed(SEED)
        return model.get_outputs(camera)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"sh_degree": 0, "background_color": "white"},
        {
            "rasterize_mode": "antialiased",
            "output_depth_during_training": True,
            "background_color": "black",
        },
        {"use_bilateral_grid": True, "camera_optimizer": CameraOptimizerConfig(mode="SO3xR3")},
    ],
)
@pytest.mark.parametrize("training", [True, False])
def test_outputs_are_those_of_nerfstudio(settings, training):
    ours, theirs = pair(**settings)
    ours.train(training), theirs.train(training)
    ours.step = theirs.step = 3000  # in training: half resolution, all SH degrees
    torch.manual_seed(SEED)
    got = ours.get_outputs(camera_at())
    expected = stock_outputs(theirs, camera_at())
    assert got.keys() == expected.keys()
    assert got["rgb"].shape == ((15, 21, 3) if training else (31, 43, 3))
    assert got["accumulation"].max() > 0.05, "an empty picture proves nothing"
    for name, value in expected.items():
        # One and the same rasterizer and formulas: only the rounding of halved intrinsics may
        # differ.
        assert value is got[name] is None or torch.allclose(
            got[name], value, atol=1e-5, rtol=1e-5
        ), name


def test_crop_box_keeps_what_is_inside_and_an_empty_one_gives_background():
    ours, theirs = (model.eval() for model in pair(background_color="black"))
    box = OrientedBox.from_params((0.25, 0.0, 0.0), (0.0, 0.0, 0.0), (0.5, 1.0, 1.0))
    whole = ours.get_outputs_for_camera(camera_at())
    got = ours.get_outputs_for_camera(camera_at(), obb_box=box)
    theirs.set_crop(box)
    torch.testing.assert_close(got["rgb"], stock_outputs(theirs, camera_at())["rgb"])
    assert not torch.allclose(got["rgb"], whole["rgb"])
    far = OrientedBox.from_params((90.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = ours.get_outputs_for_camera(camera_at(), obb_box=far)
    assert (
        empty["rgb"].shape == (31, 43, 3)
        and empty["depth"].shape == (31, 43, 1)
        and not empty["rgb"].any()
    )


def test_extreme_seeds_have_finite_sizes_or_are_dropped():
    points = torch.tensor([[0.0, 0, 0], [1e-30, 0, 0], [1e6, 0, 0], [1e6 + 1, 0, 0], [-1e18, 0, 0]])
    assert build(SplatfactoCpuModelConfig(), (points, torch.zeros(5, 3))).scales.isfinite().all()
    points, colors = random_seeds(6)
    points[2, 1] = math.nan
    points[4, 0] = math.inf
    assert build(SplatfactoCpuModelConfig(), (points, colors)).num_points == 4
    nothing = torch.full((3, 3), math.nan), colors[:3]
    assert build(SplatfactoCpuModelConfig(num_random=9), nothing).num_points == 9, "random ones"


def test_a_short_training_densifies_by_gradient_alone():
    """Rates begin (30,000 / steps) ** 0.5 times higher, and the gradient of densification rises by
    the root of that."""
    config = splatfacto_cpu_config()
    config.max_num_iterations = 1875
    short = fitted_schedules(config)
    assert short.pipeline.model.stop_screen_size_at == 0
    assert (
        short.pipeline.model.densify_grad_thresh
        == 2 * SplatfactoCpuModelConfig().densify_grad_thresh
    )
    assert short.optimizers["means"]["scheduler"].first == 4
    config.pipeline.model.stop_screen_size_at = 7
    assert fitted_schedules(config).pipeline.model.stop_screen_size_at == 7, "set by hand"
    config.max_num_iterations = 30_000
    config.pipeline.model = SplatfactoCpuModelConfig()
    assert fitted_schedules(config).pipeline.model == SplatfactoCpuModelConfig()


def test_black_seeds_start_from_random_colours_that_can_be_trained():
    points, colors = random_seeds(50)
    for degree in (0, 3):
        config = SplatfactoCpuModelConfig(sh_degree=degree, background_color="black")
        black = build(config, (points, torch.zeros(50, 3)))
        assert (
            torch.equal(black.means.detach(), points.float())
            and len(black.features_dc.unique()) > 100
        )
        black.eval()
        black.get_outputs(camera_at())["rgb"].sum().backward()
        assert black.features_dc.grad.abs().max() > 0
        one = torch.zeros(50, 3)
        one[0, 1] = 200.0
        assert len(build(config, (points, one)).features_dc.unique()) == 2, (
            "dark points among others stay"
        )


@pytest.fixture(scope="module")
def trained(wall_scene, wall_config, run_training, tmp_path_factory):
    config = wall_config(wall_scene, tmp_path_factory.mktemp("outputs"), steps=50)
    return config, *run_training(config)


def test_training_lowers_the_loss_and_densifies(trained):
    _, trainer, losses = trained
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    assert trainer.pipeline.model.num_points > 300
    assert all(value.isfinite().all() for value in trainer.pipeline.model.gauss_params.values())


def test_checkpoint_has_splatfactos_layout_and_loads_weights_only(trained):
    config, trainer, _ = trained
    state = torch.load(
        next(config.get_checkpoint_dir().glob("*.ckpt")), map_location="cpu", weights_only=True
    )
    assert set(state) == {"step", "pipeline", "optimizers", "schedulers", "scalers", STATE}
    theirs = build(SplatfactoModelConfig(num_random=5))
    assert set(state["pipeline"]) == {f"_model.{name}" for name in theirs.state_dict()}
    theirs.load_state_dict(
        {name.removeprefix("_model."): value for name, value in state["pipeline"].items()}
    )
    assert torch.equal(theirs.means, trainer.pipeline.model.means)
    assert set(state["optimizers"]) == set(theirs.get_param_groups())


def test_a_training_that_was_cut_off_goes_on_as_if_it_had_not_been(
    wall_scene, wall_config, run_training, tmp_path
):
    config = wall_config(wall_scene, tmp_path, steps=32)
    config.steps_per_save = 18
    config.save_only_latest_checkpoint = False
    whole, losses = run_training(config)
    saved = config.get_checkpoint_dir()
    for place in (
        {"load_dir": saved, "load_step": 18},
        {"load_checkpoint": saved / "step-000000018.ckpt"},
    ):
        rest = wall_config(wall_scene, tmp_path / [*place][0], steps=32 - 19)  # after steps 0 to 18
        resumed, last_losses = run_training(replace(rest, **place))
        assert resumed._start_step == 19 and last_losses == losses[19:], (
            "to the bit, over two that densify"
        )
        assert writer.GLOBAL_BUFFER["max_iter"] == 32, "what shares done and times left are told by"
        assert torch.equal(resumed.pipeline.model.means, whole.pipeline.model.means)
        assert (
            resumed.config.pipeline.model.stop_split_at == whole.config.pipeline.model.stop_split_at
        )


def test_a_checkpoint_is_whole_before_it_has_its_name(trained, tmp_path, monkeypatch):
    _, trainer, _ = trained
    for name in ("base_dir", "checkpoint_dir"):
        monkeypatch.setattr(trainer, name, tmp_path / name.removesuffix("_dir"))
    trainer.base_dir.mkdir()
    trainer.save_checkpoint(3)
    old = trainer.checkpoint_dir / "step-000000003.ckpt"
    before = old.read_bytes()

    def half(content, path):
        path.write_bytes(before[:1000])
        # nerfstudio reads a step from the name of every file beside checkpoints.
        assert [file.name for file in trainer.checkpoint_dir.iterdir()] == [old.name]
        raise RuntimeError("[enforce fail] PytorchStreamWriter failed writing file")

    monkeypatch.setattr(torch, "save", half)
    with pytest.raises(SceneError, match="step-000000004.ckpt: cannot be written .*failed writing"):
        trainer.save_checkpoint(4)
    assert old.read_bytes() == before and list(trainer.base_dir.iterdir()) == []


def test_what_is_not_finite_is_null_in_a_report_and_not_in_the_log(trained, some_lpips):
    _, trainer, _ = trained
    pipeline = trainer.pipeline
    frames = list(pipeline.datamanager.fixed_indices_eval_dataloader)[:1]
    with mock.patch.object(pipeline.datamanager, "fixed_indices_eval_dataloader", frames):
        report = pipeline.get_average_eval_image_metrics(get_std=True)
        log = pipeline.get_average_eval_image_metrics(step=3, get_std=True)
    assert report["psnr"] > 15 and 0 < report["ssim"] <= 1 and report["fps"] > 0
    assert (0 < report["lpips"] < 1) if some_lpips else (report["lpips"] is None)
    assert report["psnr_std"] is None, "one image has no standard deviation"
    assert all(isinstance(value, float) and math.isfinite(value) for value in log.values())
    assert "psnr" in log and "psnr_std" not in log
    with (
        mock.patch.object(pipeline.datamanager, "eval_dataset", []),
        pytest.raises(DataError, match="held out"),
    ):
        pipeline.get_average_eval_image_metrics()
