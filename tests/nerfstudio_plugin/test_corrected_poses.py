"""Poses that a training corrected are those of its photos, everywhere; colours that it fitted to photos are refused."""

import shutil
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
import pointsplat_ns as ps
from making import run_of
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig

NUM_TRAIN, SEED = 9, 5


def with_state(trained_walls: Path, folder: Path, mode: str | None = None, **state: torch.Tensor) -> Path:
    """A copy of a trained run with more in its checkpoint, and another mode of the camera optimizer."""
    run = folder / "wall-b" / "splatfacto-cpu" / "copied"
    shutil.copytree(run_of(trained_walls, "wall-b"), run)
    (checkpoint,) = (run / "nerfstudio_models").glob("*.ckpt")
    content = torch.load(checkpoint, weights_only=True)
    torch.save({**content, "pipeline": content["pipeline"] | state}, checkpoint)
    if mode is not None:
        config = run / "config.yml"
        text = config.read_text()
        assert text.count("mode: 'off'") == 1
        config.write_text(text.replace("mode: 'off'", f"mode: {mode}"))
    return run


def adjustments(count: int = NUM_TRAIN) -> torch.Tensor:
    """Motions of up to about a unit and a radian; one so small that exponentials are near their limit, and none."""
    values = 0.5 * torch.randn(count, 6, generator=torch.Generator().manual_seed(SEED))
    values[0], values[1] = 0.0, 1e-6 * values[1]
    return values


@pytest.mark.parametrize(("mode", "key"), [("SO3xR3", "_model"), ("SE3", "_model.module")])
def test_training_poses_are_corrected_as_by_nerfstudios_model(mode, key, trained_walls, tmp_path):
    run = with_state(trained_walls, tmp_path, mode, **{f"{key}.camera_optimizer.pose_adjustment": adjustments()})
    plain = ScenesDataManagerConfig(data=run_of(trained_walls, "wall-b")).setup(test_mode="val").training_frames(0)
    optimizer = CameraOptimizerConfig(mode=mode).setup(num_cameras=NUM_TRAIN, device="cpu")
    optimizer.pose_adjustment.data = adjustments()
    expected = []
    for index in range(NUM_TRAIN):
        camera, _ = plain[index]
        camera.metadata = {"cam_idx": index}
        expected.append(optimizer.apply_to_camera(camera).detach())
    expected = torch.cat(expected)
    before = torch.cat([plain[index][0].camera_to_worlds for index in range(NUM_TRAIN)])
    assert float((expected - before).abs().max()) > 0.3 and torch.equal(expected[0], before[0])

    held_out = (ps.dataset_views(path, "test").viewmats for path in (run_of(trained_walls, "wall-b"), run))
    assert torch.equal(*held_out), "these have no correction"
    views = viewmats_from_opengl(expected)
    photos = run_photos(run)
    assert torch.allclose(ps.dataset_views(run).viewmats, views, atol=1e-6)
    assert torch.allclose(torch.stack([photo.view.viewmat for photo in photos]), views, atol=1e-6)
    for supervision in ("photos", "dense"):
        frames = ScenesDataManagerConfig(data=run, supervision=supervision).setup(test_mode="val").training_frames(0)
        assert torch.allclose(torch.cat([frames[i][0].camera_to_worlds for i in range(NUM_TRAIN)]), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("values", "mode", "error", "text"),
    [
        (adjustments(8), "SE3", DataError, "9 training photos, but .* corrects the poses of 8; put back the data"),
        (adjustments(), None, SceneError, "config.yml: .*mode 'off'.*expected SO3xR3 or SE3"),
        (adjustments() / 0, "SE3", SceneError, "expected six finite numbers"),
        (adjustments()[:, :5], "SE3", SceneError, r"shape \(9, 5\); expected six"),
        (adjustments().long(), "SE3", SceneError, "expected a dense floating-point tensor"),
    ],
)
def test_corrections_that_do_not_fit_are_refused(values, mode, error, text, trained_walls, tmp_path):
    run = with_state(trained_walls, tmp_path, mode, **{"_model.camera_optimizer.pose_adjustment": values})
    with pytest.raises(error, match=text) as caught:
        ps.dataset_views(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["_model.bil_grids.grids", "_model.appearance_embeds.weight"])
def test_photos_that_colours_were_fitted_to_are_refused(key, trained_walls, tmp_path):
    run = with_state(trained_walls, tmp_path, **{key: torch.zeros(NUM_TRAIN, 12)})
    with pytest.raises(DataError, match=f"holds {key}, which fits colours.*leave the photos out"):
        ps.compact(run, "50%", effort="instant", photos=True)
    with pytest.raises(DataError, match=f"holds {key}.*--pipeline.datamanager.supervision dense"):
        ScenesDataManagerConfig(data=run).setup(test_mode="val")
    dense = ScenesDataManagerConfig(data=run, supervision="dense").setup(test_mode="val")
    assert len(dense.training_frames(0)) == NUM_TRAIN
    assert len(ps.dataset_views(run)) == NUM_TRAIN, "poses are right"
