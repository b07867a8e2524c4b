"""The model: its settings, losses and evaluation, and what nerfstudio's viewer and exporters get of
it."""

import copy
import json
import math
import shutil
from pathlib import Path
from unittest import mock

import cv2
import pytest
import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.scripts.exporter import ExportGaussianSplat

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import SHARED_DATA, pipeline_of, same, small_config
from pointsplat_ns.cli.export import export
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.metrics import PIXEL_LOSSES
from pointsplat_ns.metrics.lpips import LpipsUnavailable, load_lpips
from pointsplat_ns.nerfstudio_plugin.pointsplat.evaluation import VARIANTS, print_summary
from pointsplat_ns.pruning import METHODS, score_of, select
from pointsplat_ns.rendering import rasterization
from pointsplat_ns.scene.gaussians import PARAMETERS
from pointsplat_ns.scene.ply import read_ply
from pointsplat_ns.scene.runs import open_run

pytestmark = pytest.mark.usefixtures("quick")


def test_untrained_the_refined_scene_is_the_pruned_one_to_the_bit(trained_walls):
    pipeline = pipeline_of(trained_walls)
    for index, scene in enumerate(pipeline.datamanager.scenes):
        dense = scene.read_dense()
        smaller = pipeline.model.pruned_scene(index)
        assert len(smaller.pruned) == math.floor(len(dense) / 2 + 0.5)
        kept = select(score_of(dense, METHODS["paper"], opacity_weight=0.3), len(smaller.pruned))
        assert same(smaller.pruned, dense[kept]), "kept rows are the dense ones"
        assert same(pipeline.model.refine(index), smaller.pruned)
        assert smaller.pruned.sh_degree == dense.sh_degree


def test_a_scene_is_drawn_as_it_was_trained(trained_walls):
    pipeline = pipeline_of(trained_walls)
    place = "pointsplat_ns.nerfstudio_plugin.cameras.rasterization"
    with mock.patch(place, side_effect=rasterization) as drawn, torch.no_grad():
        for index in (0, 1):
            pipeline.model.losses(index, [pipeline.datamanager.scenes[index].frames("test")[0]])
    modes = [
        (call.kwargs["rasterize_mode"], call.kwargs["sh_degree"]) for call in drawn.call_args_list
    ]
    assert modes == [("classic", 3), ("antialiased", 1)]


@pytest.mark.parametrize("other", [{"size": "small"}, {"norm": "batch"}], ids=str)
def test_weights_of_another_network_are_refused(trained, trained_walls, other):
    state = torch.load(next(trained[0].get_checkpoint_dir().iterdir()), weights_only=True)[
        "pipeline"
    ]
    with pytest.raises(
        SceneError, match="does not hold a network of size .* with encoder .*, use_appearance"
    ):
        pipeline_of(trained_walls, **other).load_pipeline(state, 9)


def test_a_mask_hides_what_it_covers_from_the_loss(trained_walls):
    pipeline = pipeline_of(trained_walls)
    camera, data = pipeline.datamanager.scenes[0].frames("test")[0]
    mask = torch.zeros((48, 64, 1), dtype=torch.bool)
    with torch.no_grad():
        assert float(pipeline.model.losses(0, [(camera, {**data, "mask": mask})])[1]["l1"]) == 0
        assert float(pipeline.model.losses(0, [(camera, data)])[1]["l1"]) > 0


def test_lpips_is_part_of_the_loss_where_it_can_be_had(trained_walls, some_lpips):
    pipeline = pipeline_of(trained_walls, lpips_weight=0.1, lpips_net="alex").train()
    frame = pipeline.datamanager.scenes[0].frames("test")[0]
    _, losses, _ = pipeline.model.losses(0, [frame])
    sum(losses.values()).backward()
    assert all(
        p.grad.isfinite().all() for p in pipeline.model.refiner.parameters() if p.grad is not None
    )
    if not some_lpips:
        assert set(losses) == {"l1"} and "no network" in pipeline.model.no_lpips_reason
        return
    with torch.no_grad():
        outputs = pipeline.model.draw(
            pipeline.model.pruned_scene(0).pruned, pipeline.datamanager.scenes[0], frame[0]
        )
        expected = 0.1 * load_lpips("alex")(outputs["rgb"], frame[1]["image"] / 255)
    assert float(losses["lpips"]) == pytest.approx(
        float(expected), rel=1e-4
    )  # float32 sums in another order
    assert not any("lpips" in name for name in pipeline.state_dict())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lpips_weight": math.nan}, "lpips-weight nan: expected a finite number, 0 or more"),
        ({"by": "pup"}, "pup needs views of the scene; expected a method that needs none"),
        (
            {"encoder": "concat", "use_position": False},
            "switches of the encoder 'dual'; encoder 'concat' expects both",
        ),
        ({"keep": 0.0}, "keep is .*expected a ratio above 0"),
        ({"more_keeps": (0.3, 1.5)}, "keep is 1.5"),
        ({"schedule": "step", "drop_at": 0.0}, "--drop-at 0"),
        ({"global_norm": math.nan}, "--global-norm nan"),
        ({"rate_factor": math.inf}, "--rate-factor"),
        ({"seconds": 0.0}, "--seconds 0: expected a finite number above 0"),
    ],
)
def test_contradictory_settings_are_refused(trained_walls, tmp_path, changes, message):
    config = small_config(trained_walls, tmp_path / "outputs", 1)
    for name, value in changes.items():
        setattr(config if hasattr(config, name) else config.pipeline.model, name, value)
    config.write_config()
    with pytest.raises(PointSplatError, match=message):
        config.setup(local_rank=0, world_size=1).setup()


LPIPS_WEIGHTS = SHARED_DATA / "weights"


def test_a_scene_that_was_trained_again_counts_as_unseen(trained, trained_walls, tmp_path):
    shutil.copytree(trained_walls, tmp_path / "moved")
    (again,) = (tmp_path / "moved" / "wall-a" / "splatfacto-cpu").iterdir()
    state = torch.load(next(trained[0].get_checkpoint_dir().iterdir()), weights_only=True)
    for change, wanted in (("", [True, False]), ("2031-01-01_000000", [False, False])):
        pipeline = pipeline_of(tmp_path / "moved")
        pipeline.load_pipeline(copy.deepcopy(state["pipeline"]), state["step"])
        seen = [scene.identity in pipeline.trained_on for scene in pipeline.datamanager.scenes]
        assert seen == wanted, f"a run is the same wherever its folder is; trained anew: {change!r}"
        text = (again / "config.yml").read_text()
        (again / "config.yml").write_text(
            text.replace(open_run(again).timestamp, "2031-01-01_000000")
        )


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


def test_the_printed_table_has_each_scene_and_mean(report, capsys):
    found, _ = report
    print_summary(found)
    shown = capsys.readouterr().out
    selection = "selection: PointSplat's score (eq. 3), lambda 0.3, 50 %"
    assert f"{selection}; refiner tiny; compared with photos" in shown
    assert "dB in its own scenes, " in shown
    assert ("no LPIPS: no weights here" in shown) == ("lpips_note" in found)
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]]
        for line in shown.splitlines()
        if "dense  " in line
    ]
    blocks = [
        *found["scenes"].values(),
        *(found[key] for key in ("average", "average_seen", "average_unseen")),
    ]
    assert [row[:2] for row in rows] == [
        ["wall-a", "yes"],
        ["wall-b", "never"],
        *(["average", seen] for seen in ("", "yes", "never")),
    ]
    for row, block in zip(rows, blocks, strict=True):
        dense = block["dense"]
        assert row[2] == (f"{block['views']}" if "views" in block else "")
        assert row[3:7] == ["dense", f"{dense['psnr']:.2f}", "-", f"{dense['ssim']:.3f}"]
        assert row[8:10] == [f"{dense['gaussians']:,.0f}", f"{dense['megabytes']:.2f}"]
    for name, block in found["scenes"].items():
        gain = block["refined"]["psnr"] - block["pruned"]["psnr"]
        assert block["refined"]["gain"] == pytest.approx(gain) and f"{gain:+.2f}" in shown, name


SCENES = pytest.mark.parametrize(("index", "name"), [(0, "wall-a"), (1, "wall-b")])


@SCENES
def test_a_report_has_the_counts_and_sizes_of_each_scene(evaluated, report, index, name):
    block = report[0]["scenes"][name]
    pruned = evaluated.model.pruned_scene(index).pruned
    assert block["dense"]["gaussians"] == len(evaluated.datamanager.scenes[index].read_dense())
    assert block["pruned"]["gaussians"] == block["refined"]["gaussians"] == len(pruned)
    assert block["pruned"]["megabytes"] == pytest.approx(pruned.megabytes)


@SCENES
def test_a_report_says_which_scenes_were_seen_in_training(report, index, name):
    block = report[0]["scenes"][name]
    assert (block["views"], block["seen_in_training"]) == (2, index == 0)


@SCENES
def test_a_report_has_the_quality_and_speed_of_each_scene(report, index, name):
    block = report[0]["scenes"][name]
    assert all(block[variant]["fps"] > 0 for variant in VARIANTS)
    assert all(0 < block[variant]["ssim"] <= 1 for variant in VARIANTS)
    # half the Gaussians of a wall leave holes
    assert block["dense"]["psnr"] > block["pruned"]["psnr"]


@SCENES
def test_a_report_has_lpips_or_why_not(report, index, name):
    values = [report[0]["scenes"][name][variant]["lpips"] for variant in VARIANTS]
    if LPIPS_WEIGHTS.exists():
        assert all(0 < value < 2 for value in values) and "lpips_note" not in report[0]
    else:
        assert values == [None] * 3 and report[0]["lpips_note"] == "no weights here"


def test_means_of_a_report_are_over_all_scenes_and_over_those_seen_and_unseen(report):
    found, _ = report
    seen, unseen = (found["scenes"][name]["refined"]["psnr"] for name in ("wall-a", "wall-b"))
    assert found["average"]["refined"]["psnr"] == pytest.approx((seen + unseen) / 2)
    assert found["average_seen"]["refined"]["psnr"] == seen
    assert found["average_unseen"]["refined"]["psnr"] == found["psnr"] == unseen
    assert found["psnr_std"] > 0


def test_a_report_has_the_settings_of_the_network_and_of_pruning(report):
    assert report[0]["settings"] == {
        "size": "tiny",
        "encoder": "dual",
        "use_appearance": True,
        "use_position": True,
        "norm": "scene",
        "means_reach": 0.05,
        "units": "scene",
        "stem": "conv",
        "raw_inputs": False,
        "keep": 0.5,
        "by": "paper",
        "opacity_weight": None,
    }


def test_a_report_is_json_without_infinities(report):
    assert json.loads(json.dumps(report[0], allow_nan=False)) == report[0]


def test_an_evaluation_leaves_the_model_as_it_was(evaluated, report):
    assert not evaluated.training and not evaluated.model.training


def test_pictures_of_a_report_show_photo_dense_pruned_and_refined_below_labels(report):
    _, folder = report
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"wall-{s}_000{i}.png" for s in "ab" for i in (0, 1)]
    picture = cv2.imread(str(folder / names[0]))
    assert picture.shape == (15 + 48, 4 * 64, 3)
    for column in range(4):
        assert picture[:15, 64 * column : 64 * (column + 1)].max() > 200, "a label over each"


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0])
@pytest.mark.parametrize("name", sorted(PIXEL_LOSSES))
def test_pixel_losses_at_extremes(name, scale):
    """Value and gradient in float32 against float64; nothing differs, next to nothing differs,
    everything differs."""
    signs = scale * torch.tensor([1.0, -1.0, 0.5]).repeat(16).reshape(4, 4, 3)
    found, exact = (
        signs.to(dtype, copy=True).requires_grad_() for dtype in (torch.float32, torch.float64)
    )
    values = [PIXEL_LOSSES[name](found), PIXEL_LOSSES[name](exact)]
    gradients = torch.autograd.grad(values, [found, exact])
    assert values[0].item() == pytest.approx(values[1].item(), rel=1e-5, abs=1e-9)
    assert torch.allclose(gradients[0].double(), gradients[1], rtol=1e-4, atol=1e-7)


def test_the_viewer_gets_what_it_reads_of_a_splatfacto_model(evaluated, trained_walls):
    model = evaluated.model
    assert isinstance(model, SplatfactoModel)
    camera, _ = evaluated.datamanager.scenes[1].frames("test")[0]
    outputs = model.get_outputs_for_camera(camera)
    sizes = {name: tuple(value.shape) for name, value in outputs.items()}
    assert sizes == {
        "rgb": (48, 64, 3),
        "depth": (48, 64, 1),
        "accumulation": (48, 64, 1),
        "background": (48, 64, 3),
    }
    assert all(value.isfinite().all() and not value.requires_grad for value in outputs.values())
    assert outputs["accumulation"].max() > 0.5
    assert set(model.gauss_params) == set(PARAMETERS) and model.num_points == len(
        model.pruned_scene(1).pruned
    )
    assert torch.equal(model.shs_rest, model.gauss_params["features_rest"])
    assert torch.equal(model.shs_0, model.gauss_params["features_dc"])
    assert model.colors.shape == (model.num_points, 3)
    assert (
        len(evaluated.datamanager.train_dataset) == 9
        and len(evaluated.datamanager.eval_dataset) == 2
    )
    half = OrientedBox.from_params((-50.0, 0.0, 0.0), (0.0, 0.0, 0.0), (100.0, 100.0, 100.0))
    inside = model.gaussians[model.gaussians.means[:, 0] < 0]
    expected = model.draw(inside, evaluated.datamanager.scenes[1], camera)
    torch.testing.assert_close(
        model.get_outputs_for_camera(camera, obb_box=half)["rgb"], expected["rgb"]
    )
    far = OrientedBox.from_params((900.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert model.get_outputs_for_camera(camera, obb_box=far)["rgb"].eq(1).all(), (
        "wall-b was trained over white"
    )
    assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], outputs["rgb"]), (
        "the crop box does not stay"
    )


def test_both_exporters_write_the_refined_scene_with_the_photos_gone(
    trained, trained_walls, wall_scene, tmp_path
):
    config, trainer = trained
    expected = trainer.pipeline.eval().model.gaussians
    photos = wall_scene
    hidden = wall_scene.with_name("hidden")
    photos.rename(hidden)
    try:
        ExportGaussianSplat(
            load_config=config.get_base_dir() / "config.yml", output_dir=tmp_path
        ).main()
        export(config.get_base_dir(), tmp_path / "ours.ply")
    finally:
        hidden.rename(photos)
    theirs = read_ply(tmp_path / "splat.ply")
    ours = read_ply(tmp_path / "ours.ply")
    assert same(ours, expected)
    drawn = expected[expected.opacities[:, 0] >= -5.5373]  # ns-export drops opacities below 1/255
    assert len(drawn) > 0 and same(theirs, drawn)
