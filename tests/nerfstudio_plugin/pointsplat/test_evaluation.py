"""ns-eval: dense, pruned and refined scenes against held-out photos."""

import copy
import json
import math
import shutil
from pathlib import Path
from unittest import mock

import cv2
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import SHARED_DATA, pipeline_of, run_of
from pointsplat_ns.metrics.lpips import LpipsUnavailable, ReportedLpips

LPIPS_WEIGHTS = SHARED_DATA / "weights"
VARIANTS = ("dense", "pruned", "refined")


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


@pytest.fixture(scope="module")
def report(evaluated, tmp_path_factory) -> tuple[dict, Path]:
    """An evaluation, with LPIPS where its weights are at hand, and the folder of its pictures."""
    folder = tmp_path_factory.mktemp("pictures")
    with pytest.MonkeyPatch.context() as patch:
        if LPIPS_WEIGHTS.exists():
            patch.setenv("POINTSPLAT_LPIPS_WEIGHTS", str(LPIPS_WEIGHTS))
        else:
            unavailable = mock.Mock(side_effect=LpipsUnavailable("no weights here"))
            patch.setattr("pointsplat_ns.metrics.lpips.cached_lpips", unavailable)
        return evaluated.get_average_eval_image_metrics(output_path=folder, get_std=True), folder


def test_a_report_says_of_each_scene_its_sizes_quality_speed_and_whether_it_was_trained_on(evaluated, report):
    found, folder = report
    for index, (name, seen) in enumerate((("wall-a", True), ("wall-b", False))):
        scene, block = evaluated.model.pruned_scene(index), found["scenes"][name]
        assert (block["views"], block["seen_in_training"]) == (2, seen)
        assert block["seconds"].keys() == {"prune", "refine"} and block["dense"]["gaussians"] == scene.dense_count
        assert block["pruned"]["gaussians"] == block["refined"]["gaussians"] == len(scene.pruned)
        assert block["pruned"]["megabytes"] == pytest.approx(scene.pruned.megabytes)
        assert all(block[v]["fps"] > 0 and 0 < block[v]["ssim"] <= 1 for v in VARIANTS)
        assert block["dense"]["psnr"] > block["pruned"]["psnr"], "half the Gaussians of a wall leave holes"
        values = [block[variant]["lpips"] for variant in VARIANTS]
        if LPIPS_WEIGHTS.exists():
            assert all(0 < value < 2 for value in values) and "lpips_note" not in found
        else:
            assert values == [None] * 3 and found["lpips_note"] == "no weights here"
    seen, unseen = (found["scenes"][name]["refined"]["psnr"] for name in ("wall-a", "wall-b"))
    means = {key: found[key]["refined"]["psnr"] for key in ("average", "average_seen", "average_unseen")}
    assert means == {"average": pytest.approx((seen + unseen) / 2), "average_seen": seen, "average_unseen": unseen}
    assert found["psnr"] == unseen and found["psnr_std"] > 0
    network = {"size": "tiny", "encoder": "dual", "use_appearance": True, "use_position": True, "norm": "scene"}
    assert found["settings"] == {**network, "keep": 0.5, "by": "paper", "opacity_weight": None}
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert not evaluated.training and not evaluated.model.training, "the model is left as it was"
    assert sorted(path.name for path in folder.iterdir()) == [f"wall-{s}_000{i}.png" for s in "ab" for i in (0, 1)]
    assert cv2.imread(str(folder / "wall-a_0000.png")).shape == (48, 4 * 64, 3), "photo, dense, pruned, refined"


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


def test_a_distorted_scene_of_degree_0_is_judged_as_its_own_run_judges_it(lens_run, no_lpips):
    own = eval_setup(lens_run / "config.yml")[1].get_average_eval_image_metrics()
    pipeline = pipeline_of(lens_run)
    assert pipeline.datamanager.scenes[0].read_dense().sh_degree == 0
    report = pipeline.get_average_eval_image_metrics()
    # dB; float32 rounding, for a colour logit has become a SH coefficient of the same colour
    assert report["average"]["dense"]["psnr"] == pytest.approx(own["psnr"], abs=1e-3)
    assert not torch.equal(pipeline.datamanager.scenes[0].run.transform, torch.eye(4)[:3]), "proves too little"
