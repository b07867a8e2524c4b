"""The pointsplat method through nerfstudio: prune, refine, train, resume, evaluate, export."""

from __future__ import annotations

import copy
import json
import math
import shutil
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import same, small_config
from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.io import read_ply, read_scene
from pointsplat_ns.metrics import ImageError
from pointsplat_ns.metrics.lpips import ReportedLpips, load_lpips
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import RATES, pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.losses import PhotoLoss
from pointsplat_ns.nerfstudio_plugin.pointsplat.results import REFINER_NAME
from pointsplat_ns.pruning import METHODS, prune, score_of, select
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.refiner import read_refiner
from pointsplat_ns.refiner.weights import read_metadata

VARIANTS = ("dense", "pruned", "refined")


def fast_config(data: Path, output_dir: Path, steps: int = 10, **model):
    """The method at a size for tests, at rates for the few steps that they take."""
    config = small_config(data, output_dir, steps, **model)
    for group in config.optimizers.values():
        group["optimizer"].lr *= 10
    return config


def pipeline_of(data: Path, eval_scenes: tuple[str, ...] = (), test_mode: str = "test", **model):
    config = fast_config(data, Path("unused"), **model)
    config.pipeline.datamanager.eval_scenes = eval_scenes
    return config.pipeline.setup(device="cpu", test_mode=test_mode).eval()


def run_of(folder: Path, name: str) -> Path:
    (path,) = (folder / name / "splatfacto-cpu").iterdir()
    return path


@pytest.fixture(scope="module")
def trained(trained_walls, run_training, tmp_path_factory):
    """A short training on wall-a with wall-b held out: its config, its trainer, and which scenes gave photos."""
    config = fast_config(trained_walls, tmp_path_factory.mktemp("refined"))
    config.pipeline.datamanager.eval_scenes = ("wall-b",)
    config.steps_per_eval_image = 4
    from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModel

    used, losses = [], PointSplatModel.losses

    def recorded(self, index, frames):
        used.append((self.training, index))
        return losses(self, index, frames)

    with mock.patch.object(PointSplatModel, "losses", recorded):
        trainer, _ = run_training(config)
    return config, trainer, used


# pruning and the untrained network


def test_by_default_scenes_are_merged(trained_walls):
    assert pointsplat_config().pipeline.model.by == "merge"
    pipeline = pipeline_of(trained_walls, by="merge", keep=0.25)
    dense = read_scene(run_of(trained_walls, "wall-a"))
    wanted = prune(dense, 0.25, "merge")
    made = pipeline.model.pruned_scene(0).pruned
    assert len(made) == len(dense) // 4
    assert same(made, wanted)


def test_untrained_the_refined_scene_is_the_pruned_one_to_the_bit(trained_walls):
    pipeline = pipeline_of(trained_walls)
    for index, scene in enumerate(pipeline.datamanager.scenes):
        dense = scene.read_dense()
        made = pipeline.model.pruned_scene(index)
        assert len(made.pruned) == math.floor(len(dense) / 2 + 0.5) and made.dense_count == len(dense)
        kept = select(score_of(dense, METHODS["paper"], opacity_weight=0.3), len(made.pruned))
        assert same(made.pruned, dense[kept]), "kept rows are the dense ones"
        assert same(pipeline.model.refine(index), made.pruned)
        assert made.pruned.sh_degree == dense.sh_degree


@pytest.mark.parametrize(("keep", "kept"), [(17, 17), (2, 2), (1.0, None)])
def test_keep_is_a_ratio_up_to_1_and_a_count_above(trained_walls, keep, kept):
    pipeline = pipeline_of(run_of(trained_walls, "wall-a"), keep=float(keep))
    made = pipeline.model.pruned_scene(0)
    assert len(made.pruned) == (kept or made.dense_count)


@pytest.mark.parametrize("keep", [0.0, -0.5, 1.5, math.nan, math.inf])
def test_a_keep_that_means_nothing_is_refused_before_training(trained_walls, keep):
    with pytest.raises(BudgetError, match="keep is .*expected a ratio above 0"):
        pipeline_of(trained_walls, keep=keep)


def test_what_one_scene_cannot_give_names_the_scene(trained_walls):
    pipeline = pipeline_of(trained_walls, keep=1e6)
    with pytest.raises(BudgetError, match=r"wall-a.*\.ckpt: keep is 1000000 Gaussians; expected 1 to"):
        pipeline.model.pruned_scene(0)
    with pytest.raises(PointSplatError, match="no method is called 'beauty'; expected one of merge"):
        pipeline_of(trained_walls, by="beauty")
    with pytest.raises(PointSplatError, match="opacity_weight is 1.5; expected 0 to 1"):
        pipeline_of(trained_walls, opacity_weight=1.5).model.pruned_scene(0)


def test_a_scene_is_drawn_as_it_was_trained(trained_walls):
    pipeline = pipeline_of(trained_walls)
    modes = []

    def recorded(**arguments):
        modes.append((arguments["rasterize_mode"], arguments["sh_degree"]))
        return rasterization(**arguments)

    place = "pointsplat_ns.nerfstudio_plugin.rasterizer_options.rasterization"
    with mock.patch(place, recorded), torch.no_grad():
        for index in (0, 1):
            pipeline.model.losses(index, [next(pipeline.datamanager.held_out(index))])
    assert modes == [("classic", 3), ("antialiased", 1)]


# training


def view_loss(model, manager, index: int) -> float:
    with torch.no_grad():
        _, losses, _ = model.losses(index, [f for f in manager.scenes[index].train_frames])
    return float(losses["l1"])


def test_training_lowers_the_loss_on_all_views(trained, trained_walls):
    _, trainer, _ = trained
    untrained = pipeline_of(trained_walls)
    model = trainer.pipeline.eval().model
    assert view_loss(model, trainer.pipeline.datamanager, 0) < 0.9 * view_loss(
        untrained.model, untrained.datamanager, 0
    )


def test_the_held_out_scene_is_never_trained_on(trained):
    _, trainer, used = trained
    assert {index for training, index in used if training} == {0}
    assert len([1 for training, _ in used if training]) == 10
    assert trainer.pipeline.model.shown == 1


def test_the_checkpoint_holds_the_network_and_nothing_else(trained):
    config, trainer, _ = trained
    (path,) = config.get_checkpoint_dir().iterdir()
    state = torch.load(path, map_location="cpu", weights_only=True)
    refiner = trainer.pipeline.model.refiner
    names = {f"_model.refiner.{name}" for name in refiner.state_dict()}
    assert set(state["pipeline"]) == names | {"_model.device_indicator_param", "_extra_state"}
    assert [name.split("/")[0] for name in state["pipeline"]["_extra_state"]["trained_on"]] == ["wall-a"]
    assert all(torch.equal(state["pipeline"][f"_model.refiner.{n}"], v) for n, v in refiner.state_dict().items())
    parameters = sum(p.numel() for p in refiner.parameters())
    assert path.stat().st_size < 4 * 3 * parameters + 500_000, "three floats a parameter: itself and Adam's two"
    assert set(state["optimizers"]) == set(RATES)
    trained_numbers = {p for g in trainer.optimizers.optimizers.values() for s in g.param_groups for p in s["params"]}
    assert trained_numbers == set(refiner.parameters()), "every parameter has a learning rate"


def test_the_network_is_saved_by_itself_at_the_end(trained):
    config, trainer, _ = trained
    path = config.get_base_dir() / REFINER_NAME
    loaded = read_refiner(path).state_dict()
    expected = trainer.pipeline.model.refiner.state_dict()
    assert loaded.keys() == expected.keys() and all(torch.equal(loaded[n], v) for n, v in expected.items())
    assert read_metadata(path) == {
        "step": "9",
        "scenes": "wall-a",
        "keep": "0.5",
        "by": "paper",
        "opacity_weight": None,
    }
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000009.ckpt"]


def test_an_evaluation_while_training_is_logged(trained):
    _, trainer, _ = trained
    trainer.pipeline.train()
    metrics, images = trainer.pipeline.get_eval_image_metrics_and_images(step=4)
    assert {"psnr_pruned", "psnr_refined", "ssim_refined", "num_rays"} <= metrics.keys()
    assert images["photo_pruned_refined"].shape == (48, 3 * 64, 3)
    assert trainer.pipeline.training and trainer.pipeline.model.training, "training goes on as it was"


def test_a_resumed_training_ends_where_an_unbroken_one_does(trained_walls, run_training, tmp_path):
    config = fast_config(trained_walls, tmp_path / "whole", steps=6)
    config.steps_per_save, config.save_only_latest_checkpoint = 3, False
    whole, losses = run_training(config)
    rest = fast_config(trained_walls, tmp_path / "rest", steps=2)
    rest.load_dir, rest.load_step = config.get_checkpoint_dir(), 3  # after steps 0 to 3
    resumed, last_losses = run_training(rest)
    assert resumed._start_step == 4 and last_losses == losses[4:]
    for name, value in whole.pipeline.model.refiner.state_dict().items():
        assert torch.equal(resumed.pipeline.model.refiner.state_dict()[name], value), name
    rates = [t.optimizers.optimizers["encoder"].param_groups[0]["lr"] for t in (whole, resumed)]
    assert rates[0] == rates[1]


@pytest.mark.parametrize("steps", [1, 2, 3, 2000])
def test_learning_rates_rise_fall_and_never_rise_again(steps):
    config = fast_config(Path("unused"), Path("unused"), steps=steps)
    schedule = config.optimizers["encoder"]["scheduler"]
    with mock.patch.object(config, "_target", lambda fitted, **_: fitted):
        fitted = config.setup().optimizers["encoder"]["scheduler"]
    assert schedule.max_steps == 0, "the config itself, which is saved, is left alone"
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    scheduler = fitted.setup().get_scheduler(optimizer, 1.0)
    rates = []
    for _ in range(steps + 1):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step(), scheduler.step()
    peak = max(range(len(rates)), key=rates.__getitem__)
    assert rates[peak] == 1.0 and peak == max(1, round(0.05 * steps))
    assert all(a >= b for a, b in zip(rates[peak:], rates[peak + 1 :], strict=False))
    assert rates[-1] == pytest.approx(0.02) or steps == 1


def test_a_training_that_cannot_start_leaves_no_folder(trained_walls, tmp_path):
    config = fast_config(trained_walls, tmp_path / "outputs")
    config.pipeline.datamanager.eval_scenes = ("no_such_scene",)
    (tmp_path / "outputs" / "of another run").mkdir(parents=True)
    config.save_config()
    with pytest.raises(SceneError, match="no_such_scene"):
        config.setup(local_rank=0, world_size=1).setup()
    assert [path.name for path in (tmp_path / "outputs").iterdir()] == ["of another run"]


def test_weights_of_another_network_are_refused(trained, trained_walls):
    config, _, _ = trained
    state = torch.load(next(config.get_checkpoint_dir().iterdir()), weights_only=True)["pipeline"]
    for other in ({"size": "small"}, {"encoder": "concat"}):
        with pytest.raises(SceneError, match="does not hold a network of size"):
            pipeline_of(trained_walls, **other).load_pipeline(state, 9)


def test_a_loss_that_is_not_finite_is_shown(trained_walls):
    pipeline = pipeline_of(trained_walls)
    camera, data = next(pipeline.datamanager.held_out(1))
    data["image"] = torch.full(data["image"].shape, math.nan)
    assert pipeline.model.losses(1, [(camera, data)])[1]["l1"].isnan()


def test_a_mask_hides_what_it_covers_from_the_loss(trained_walls):
    pipeline = pipeline_of(trained_walls)
    camera, data = next(pipeline.datamanager.held_out(0))
    mask = torch.zeros((48, 64, 1), dtype=torch.bool)
    with torch.no_grad():
        assert float(pipeline.model.losses(0, [(camera, {**data, "mask": mask})])[1]["l1"]) == 0
        assert float(pipeline.model.losses(0, [(camera, data)])[1]["l1"]) > 0


def test_lpips_is_part_of_the_loss_where_it_can_be_had(trained_walls, some_lpips):
    pipeline = pipeline_of(trained_walls, lpips_weight=0.1, lpips_net="alex").train()
    frame = next(pipeline.datamanager.held_out(0))
    _, losses, _ = pipeline.model.losses(0, [frame])
    sum(losses.values()).backward()
    assert all(p.grad.isfinite().all() for p in pipeline.model.refiner.parameters() if p.grad is not None)
    if not some_lpips:
        assert set(losses) == {"l1"} and "no network" in pipeline.model.loss.no_lpips_reason
        return
    with torch.no_grad():
        outputs = pipeline.model.draw(pipeline.model.pruned_scene(0).pruned, pipeline.datamanager.scenes[0], frame[0])
        expected = 0.1 * load_lpips("alex")(outputs["rgb"], frame[1]["image"] / 255)
    assert float(losses["lpips"]) == pytest.approx(float(expected), rel=1e-4)  # float32 sums in another order
    assert not any("lpips" in name for name in pipeline.state_dict())


def test_what_is_shown_follows_the_weights(trained, trained_walls):
    pipeline = pipeline_of(trained_walls)
    model = pipeline.model

    def shown_is_current() -> bool:
        with torch.no_grad():
            return same(model.eval().gaussians, model.refiner(model.pruned_scene(0).pruned))

    untrained = model.gaussians
    assert shown_is_current()
    optimizer = torch.optim.SGD(model.refiner.parameters(), lr=10.0)
    _, losses, _ = pipeline.train().get_train_loss_dict(0)
    losses["l1"].backward()
    optimizer.step()
    assert shown_is_current() and not same(model.gaussians, untrained)
    state = torch.load(next(trained[0].get_checkpoint_dir().iterdir()), weights_only=True)["pipeline"]
    stepped = model.gaussians
    pipeline.load_pipeline(state, 9)
    assert shown_is_current() and not same(model.gaussians, stepped)


# ns-eval


@pytest.fixture(scope="module")
def evaluated(trained):
    """The pipeline as ns-eval opens it."""
    config, _, _ = trained
    return eval_setup(config.get_base_dir() / "config.yml")[1]


def test_a_scene_trained_again_since_is_not_the_one_that_the_network_has_seen(trained, trained_walls, tmp_path):
    config, _, _ = trained
    moved = tmp_path / "moved"
    shutil.copytree(trained_walls, moved)
    (again,) = (moved / "wall-a" / "splatfacto-cpu").iterdir()
    text = (again / "config.yml").read_text()
    other = copy.deepcopy(config)
    other.pipeline.datamanager.data = moved
    pipeline = other.pipeline.setup(device="cpu", test_mode="test")
    state = torch.load(next(config.get_checkpoint_dir().iterdir()), weights_only=True)
    pipeline.load_pipeline(state["pipeline"], state["step"])
    seen = [scene.identity in pipeline.training_state.trained_on for scene in pipeline.datamanager.scenes]
    assert seen == [True, False], "a run is the same wherever its folder is"
    timestamp = pipeline.datamanager.scenes[0].run.timestamp
    (again / "config.yml").write_text(text.replace(timestamp, "2031-01-01_000000"))
    pipeline = other.pipeline.setup(device="cpu", test_mode="test")
    pipeline.load_pipeline(state["pipeline"], state["step"])
    assert not any(scene.identity in pipeline.training_state.trained_on for scene in pipeline.datamanager.scenes)


def test_photos_too_small_for_lpips_are_trained_on_with_l1_alone(evaluated):
    def too_small(*_):
        raise ImageError("images of 8 x 8 pixels are too small")

    index, frames = evaluated.datamanager.next_eval(0)
    loss = PhotoLoss("l1", 0.1, "auto")
    nets = mock.patch("pointsplat_ns.nerfstudio_plugin.pointsplat.losses.cached_lpips", lambda *_: too_small)
    with nets, mock.patch.object(evaluated.model, "loss", loss):
        assert set(evaluated.model.losses(index, frames)[1]) == {"l1"}
    assert loss.no_lpips_reason == "images of 8 x 8 pixels are too small"


def test_the_evaluation_compares_dense_pruned_and_refined(evaluated, some_lpips, tmp_path):
    report = evaluated.get_average_eval_image_metrics(output_path=tmp_path, get_std=True)
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert set(report["scenes"]) == {"wall-a", "wall-b"}
    for index, (name, block) in enumerate(report["scenes"].items()):
        made = evaluated.model.pruned_scene(index)
        assert block["seen_in_training"] == (name == "wall-a") and block["views"] == 2
        assert block["dense"]["gaussians"] == made.dense_count
        assert block["pruned"]["gaussians"] == block["refined"]["gaussians"] == len(made.pruned)
        assert block["pruned"]["megabytes"] == pytest.approx(made.pruned.megabytes)
        assert all(block[v]["fps"] > 0 and 0 < block[v]["ssim"] <= 1 for v in VARIANTS)
        assert block["dense"]["psnr"] > block["pruned"]["psnr"], "half the Gaussians of a wall leave holes"
        assert block["seconds"].keys() == {"prune", "refine"}
        if some_lpips:
            assert all(0 < block[v]["lpips"] < 2 for v in VARIANTS)
        else:
            assert all(block[v]["lpips"] is None for v in VARIANTS) and "no network" in report["lpips_note"]
    both = [report["scenes"][name]["refined"]["psnr"] for name in ("wall-a", "wall-b")]
    assert report["average"]["refined"]["psnr"] == pytest.approx(sum(both) / 2)
    assert report["average_seen"]["refined"]["psnr"] == both[0]
    assert report["psnr"] == report["average_unseen"]["refined"]["psnr"] == both[1]
    assert report["psnr_std"] > 0 and ("lpips_note" in report) != some_lpips
    assert not evaluated.training and not evaluated.model.training, "the viewer and the exporter go on as they were"
    network = {"size": "tiny", "encoder": "dual", "use_appearance": True, "use_position": True, "norm": "scene"}
    assert report["settings"] == {**network, "keep": 0.5, "by": "paper", "opacity_weight": None}
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"wall-{s}_000{i}.png" for s in "ab" for i in (0, 1)]
    assert cv2.imread(str(tmp_path / "wall-a_0000.png")).shape == (48, 4 * 64, 3)


def test_dense_is_judged_as_its_own_run_judges_it(evaluated, trained_walls, no_lpips):
    report = evaluated.get_average_eval_image_metrics()
    for name in ("wall-a", "wall-b"):
        own = eval_setup(run_of(trained_walls, name) / "config.yml")[1].get_average_eval_image_metrics()
        # dB; the same pictures but for rounding of float32, in which a SH coefficient's colour is computed
        assert report["scenes"][name]["dense"]["psnr"] == pytest.approx(own["psnr"], abs=1e-3)
        assert report["scenes"][name]["dense"]["ssim"] == pytest.approx(own["ssim"], abs=1e-4)


@pytest.mark.parametrize("get_std", [True, False])
def test_one_view_and_no_lpips_still_give_valid_json(evaluated, no_lpips, get_std):
    manager = evaluated.datamanager
    frames = {i: list(manager.held_out(i))[:1] for i in (0, 1)}
    with mock.patch.object(manager, "held_out", frames.get):
        report = evaluated.get_average_eval_image_metrics(get_std=get_std)
        log = evaluated.get_average_eval_image_metrics(step=3, get_std=get_std)
    json.dumps(report, allow_nan=False)
    assert report["lpips"] is None and "no network" in report["lpips_note"]
    assert ("psnr_std" in report) == get_std and report.get("psnr_std") is None
    assert report["psnr"] > 5 and log["psnr"] == report["psnr"]
    assert all(isinstance(value, float) and math.isfinite(value) for value in log.values())


def test_an_exact_picture_has_no_finite_psnr_and_is_null(evaluated, no_lpips):
    from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import evaluate_scene, summarize

    model, scene = evaluated.model, evaluated.datamanager.scenes[0]
    camera, _ = next(evaluated.datamanager.held_out(0))
    gaussians = scene.read_dense()
    with torch.no_grad():
        exact = model.draw(gaussians, scene, camera)["rgb"]
    variants = dict.fromkeys(VARIANTS, gaussians)
    report = evaluate_scene(model, scene, variants, [(camera, {"image": exact})], 1, ReportedLpips())
    summary = summarize([report], with_std=True)
    json.dumps(summary, allow_nan=False)
    assert summary["psnr"] is None and summary["ssim"] == pytest.approx(1.0)


def test_lpips_that_fails_at_one_view_is_null_for_all(evaluated):
    from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import evaluate_scene

    model, scene = evaluated.model, evaluated.datamanager.scenes[0]
    calls = []

    def fails_at_the_third(rgb, photo):
        calls.append(1)
        if len(calls) == 3:
            raise ImageError("too small")
        return torch.tensor(0.5)

    dense = scene.read_dense()
    variants = {"dense": dense, "refined": dense}
    frames, lpips = evaluated.datamanager.held_out(0), ReportedLpips()
    with mock.patch("pointsplat_ns.metrics.lpips.cached_lpips", lambda *_: fails_at_the_third):
        report = evaluate_scene(model, scene, variants, frames, 2, lpips)
    assert lpips.reason == "too small"
    assert report.variants["dense"]["lpips"] is None and report.variants["refined"]["lpips"] is None


# lens distortion, transforms and SH degree 0


@pytest.fixture(scope="module")
def lens_run(wall_scene, wall_config, run_training, tmp_path_factory) -> Path:
    """A run of SH degree 0 over black on the wall's photos, read by nerfstudio-data, as if through a lens."""
    scene = tmp_path_factory.mktemp("lens") / "scene"
    shutil.copytree(wall_scene / "results", scene / "images", ignore=shutil.ignore_patterns("depth*"))
    frames = []
    for i, line in enumerate((wall_scene / "traj.txt").read_text().splitlines()):
        pose = np.array(line.split(), dtype=float).reshape(4, 4) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/frame{i:06d}.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV", "k1": 0.15, "k2": 0.02, "p1": 0.004, "p2": -0.003}
    camera = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 24.5, "w": 64, "h": 48, **lens}
    (scene / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))
    config = wall_config(scene, scene.parent / "outputs", steps=15)
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig()
    config.pipeline.model.sh_degree, config.pipeline.model.background_color = 0, "black"
    config.pipeline.model.num_random, config.pipeline.model.random_scale = 300, 2.0
    run_training(config)
    return config.get_base_dir()


def test_a_distorted_scene_of_degree_0_is_judged_as_its_own_run_judges_it(lens_run, no_lpips):
    own = eval_setup(lens_run / "config.yml")[1].get_average_eval_image_metrics()
    pipeline = pipeline_of(lens_run)
    assert pipeline.datamanager.scenes[0].read_dense().sh_degree == 0
    report = pipeline.get_average_eval_image_metrics()
    # dB; float32 rounding, for a colour logit has become a SH coefficient of the same colour
    assert report["average"]["dense"]["psnr"] == pytest.approx(own["psnr"], abs=1e-3)
    assert not torch.equal(pipeline.datamanager.scenes[0].run.transform, torch.eye(4)[:3]), "proves too little"


def test_a_scene_of_degree_0_trains_and_is_viewed(lens_run, run_training, tmp_path):
    trainer, losses = run_training(fast_config(lens_run, tmp_path, steps=2))
    assert all(math.isfinite(loss) for loss in losses)
    model = trainer.pipeline.eval().model
    camera, _ = next(trainer.pipeline.datamanager.held_out(0))
    assert model.get_outputs_for_camera(camera)["rgb"].std() > 0.01
    assert model.gauss_params["features_rest"].shape == (len(model.means), 0, 3)


# the viewer and ns-export


def test_the_viewer_gets_what_it_reads_of_a_splatfacto_model(evaluated, trained_walls):
    model = evaluated.model
    assert isinstance(model, SplatfactoModel)
    camera, _ = next(evaluated.datamanager.held_out(1))
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
    assert model.get_outputs(mock.Mock(spec=[])) == {} and isinstance(camera, Cameras)


def test_a_crop_box_keeps_what_is_inside_and_an_empty_one_gives_background(evaluated):
    model = evaluated.model
    camera, _ = next(evaluated.datamanager.held_out(1))
    whole = model.get_outputs_for_camera(camera)["rgb"]
    half = OrientedBox.from_params((-50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (100.0, 100.0, 100.0))
    cropped = model.get_outputs_for_camera(camera, obb_box=half)
    inside = model.gaussians[model.gaussians.means[:, 0] < 0]
    assert 0 < len(inside) < model.num_points
    expected = model.draw(inside, evaluated.datamanager.scenes[1], camera)
    torch.testing.assert_close(cropped["rgb"], expected["rgb"])
    assert not torch.allclose(cropped["rgb"], whole)
    far = OrientedBox.from_params((900.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    empty = model.get_outputs_for_camera(camera, obb_box=far)
    assert torch.equal(empty["rgb"], torch.ones(48, 64, 3)), "wall-b was trained over white"
    assert empty["depth"].shape == (48, 64, 1) and not empty["accumulation"].any()
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], whole), "the crop box does not stay"


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


def test_the_cli_exports_any_scene_of_the_run(trained, trained_walls, tmp_path):
    from pointsplat_ns.cli.export import export

    config, trainer, _ = trained
    export(config.get_base_dir(), tmp_path / "a.ply", scene="wall-a")
    assert same(read_ply(tmp_path / "a.ply"), trainer.pipeline.eval().model.refine(0))
    assert not same(read_ply(tmp_path / "a.ply"), prune(read_scene(run_of(trained_walls, "wall-a")), 0.5))
    with pytest.raises(SceneError, match="scene 'wall-z': no such scene.*wall-a, wall-b"):
        export(config.get_base_dir(), tmp_path / "z.ply", scene="wall-z")
    assert not (tmp_path / "z.ply").exists()


def test_the_saved_config_trains_again(trained, run_training, tmp_path):
    config = copy.deepcopy(trained[0])
    config.output_dir, config.max_num_iterations = tmp_path, 1
    _, losses = run_training(config)
    assert len(losses) == 1
