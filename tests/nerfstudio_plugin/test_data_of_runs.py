"""Runs whose photos are elsewhere now, or whose training corrected poses or fitted colours."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
import pointsplat_ns as ps
from making import run_of, without_data
from pointsplat_ns.cli import main
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.nerfstudio_plugin.pointsplat.datamanager import ScenesDataManagerConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def runs(trained_walls, tmp_path) -> Path:
    """Two runs whose data is gone from where they say."""
    return without_data(trained_walls, tmp_path / "runs")


@pytest.fixture
def moved(wall_scene, tmp_path) -> Path:
    shutil.copytree(wall_scene.parent, tmp_path / "moved")
    return tmp_path / "moved"


def keep_data_of_a(runs: Path, trained_walls: Path) -> None:
    shutil.copy(
        run_of(trained_walls, "wall-a") / "config.yml", run_of(runs, "wall-a") / "config.yml"
    )


def test_the_data_is_found_at_or_below_the_folder_that_is_named(runs, moved, trained_walls):
    run = run_of(runs, "wall-a")
    known = ps.dataset_views(run_of(trained_walls, "wall-a"))
    with pytest.raises(SceneError, match="gone_from_here.*pass its folder with --data DIR"):
        ps.dataset_views(run)
    for place in (moved, moved / "wall"):
        assert torch.equal(ps.dataset_views(run, data=place).viewmats, known.viewmats)
    with pytest.raises(
        SceneError, match="nowhere: no such folder; expected the data of .*gone_from_here"
    ):
        ps.dataset_views(run, data=moved / "nowhere")


def test_the_data_is_searched_for_below_the_folder_and_the_run_is_named_if_it_is_not_there(
    runs, moved, trained_walls, tmp_path
):
    run = run_of(runs, "wall-a")
    known = ps.dataset_views(run_of(trained_walls, "wall-a")).viewmats
    (tmp_path / "disk" / "2026" / "captures").mkdir(parents=True)
    place = moved.rename(tmp_path / "disk" / "2026" / "captures" / "replica")
    disk = tmp_path / "disk"
    assert torch.equal(ps.dataset_views(run, data=disk).viewmats, known), "four folders below"
    renamed = (place / "wall").rename(place / "renamed")
    with pytest.raises(SceneError, match="disk: nothing called wall in it; .*config.yml, once at"):
        ps.dataset_views(run, data=disk)
    assert torch.equal(ps.dataset_views(run, data=renamed).viewmats, known), "whatever its name"
    for name in "ab":
        shutil.copytree(renamed, disk / name / "wall")
        shutil.copy(place / "cam_params.json", disk / name)
    with pytest.raises(SceneError, match="may both be the data of .*config.yml"):
        ps.dataset_views(run, data=disk)


COMMANDS = {
    "prune": "RUN --keep 50% --by lightgaussian -o OUT/a.ply --json",
    "compact": "RUN --keep 50% --effort instant -o OUT/a.ply --json",
    "clean": "RUN -o OUT/a.ply",
    "lod": "RUN --levels 50% -o OUT/lod",
    "render": "RUN --seconds 0.1 -o OUT/a.png",
    "tradeoff": "RUN --keep 10% --views 2 --repairs none -o OUT/trade",
    "info": "RUN --views OUT/a.png",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_takes_the_folder_and_refuses_one_without_the_data(
    command, runs, moved, tmp_path, capfd
):
    words = (
        COMMANDS[command]
        .replace("RUN", str(run_of(runs, "wall-b")))
        .replace("OUT", str(tmp_path))
        .split()
    )
    with pytest.raises(SystemExit) as ended:
        main([command, *words, "--data", str(tmp_path / "nowhere")])
    assert ended.value.code == 1 and "nowhere: no such folder" in capfd.readouterr().err
    main([command, *words, "--data", str(moved)])
    said = capfd.readouterr()
    assert (
        "sampled in free space" not in said.out + said.err
        and "gone_from_here" not in said.out + said.err
    )


def test_data_is_not_for_a_scene_without_a_run(moved, tmp_path):
    ps.save(ps.example_room()[::200], tmp_path / "room.ply")
    for scene in (tmp_path / "room.ply", ps.example_room()[::200]):
        with pytest.raises(SceneError, match="no run, so it has no data at"):
            ps.prune(scene, 100, data=moved)


def test_a_run_without_its_data_does_not_stop_a_folder_and_is_named(
    runs, moved, trained_walls, tmp_path
):
    keep_data_of_a(runs, trained_walls)
    results = ps.compact_folder(runs, tmp_path / "out", "50%", effort="instant")
    assert [result.status for result in results] == ["done", "done"]
    assert (
        results[0].note == ""
        and results[1].note.startswith("no dataset: ")
        and "gone_from_here" in results[1].note
    )
    assert json.loads((tmp_path / "out" / "wall-b.ply.json").read_text())["note"] == results[1].note
    with pytest.raises(SceneError, match="contains results of other options"):
        ps.compact_folder(runs, tmp_path / "out", "50%", effort="instant", data=moved)
    results = ps.compact_folder(runs, tmp_path / "new", "50%", effort="instant", data=moved)
    assert [(result.status, result.note) for result in results] == [("done", ""), ("done", "")]


def test_a_training_leaves_out_a_run_without_its_photos_and_names_it(
    runs, moved, trained_walls, capfd
):
    def manager_of(**settings):
        return ScenesDataManagerConfig(data=runs, cache_gigabytes=0.01, **settings).setup(
            test_mode="val"
        )

    with pytest.raises(
        SceneError, match="gone_from_here.*that of 1 more runs; .*scene-data DIR.*supervision dense"
    ):
        manager_of()
    assert [scene.name for scene in manager_of(scene_data=moved).scenes] == ["wall-a", "wall-b"]
    keep_data_of_a(runs, trained_walls)
    capfd.readouterr()
    assert [scene.name for scene in manager_of().scenes] == ["wall-a"]
    assert "wall-b is left out" in capfd.readouterr().out.replace("\n", " ")
    dense = manager_of(supervision="dense").scenes
    assert [scene.has_photos for scene in dense if isinstance(scene, TrainedScene)] == [True, False]


def test_a_refiners_run_finds_the_scenes_that_moved(
    make_refined_run, trained_walls, runs, tmp_path
):
    run = make_refined_run(tmp_path / "out", tmp_path / "gone" / "runs")
    with pytest.raises(SceneError, match="gone"):
        ps.load(run)
    assert len(ps.load(run, data=tmp_path)) > 0


NUM_TRAIN = 9
SEED = 5


def with_state(
    trained_walls: Path, folder: Path, mode: str | None = None, **state: torch.Tensor
) -> Path:
    """A copy of a trained run with more in its checkpoint, and another mode of the camera
    optimizer."""
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


ADJUSTMENTS = 0.5 * torch.randn(NUM_TRAIN, 6, generator=torch.Generator().manual_seed(SEED))
"""Motions of up to about a unit and a radian; none, and one so small that exponentials are near
their limit."""
ADJUSTMENTS[0], ADJUSTMENTS[1] = 0.0, 1e-6 * ADJUSTMENTS[1]


@pytest.mark.parametrize(("mode", "key"), [("SO3xR3", "_model"), ("SE3", "_model.module")])
def test_training_poses_are_corrected_as_by_nerfstudios_model(mode, key, trained_walls, tmp_path):
    run = with_state(
        trained_walls, tmp_path, mode, **{f"{key}.camera_optimizer.pose_adjustment": ADJUSTMENTS}
    )
    plain = (
        ScenesDataManagerConfig(data=run_of(trained_walls, "wall-b"))
        .setup(test_mode="val")
        .training_frames(0)
    )
    optimizer = CameraOptimizerConfig(mode=mode).setup(num_cameras=NUM_TRAIN, device="cpu")
    optimizer.pose_adjustment.data = ADJUSTMENTS
    cameras = [camera for camera, _ in plain]
    for index, camera in enumerate(cameras):
        camera.metadata = {"cam_idx": index}
    expected = torch.cat([optimizer.apply_to_camera(camera).detach() for camera in cameras])
    before = torch.cat([camera.camera_to_worlds for camera in cameras])
    assert float((expected - before).abs().max()) > 0.3 and torch.equal(expected[0], before[0])

    held_out = (
        ps.dataset_views(path, "test").viewmats for path in (run_of(trained_walls, "wall-b"), run)
    )
    assert torch.equal(*held_out), "these have no correction"
    views = viewmats_from_opengl(expected)
    photos = run_photos(run)
    assert torch.allclose(ps.dataset_views(run).viewmats, views, atol=1e-6)
    assert torch.allclose(torch.stack([photo.view.viewmat for photo in photos]), views, atol=1e-6)
    for supervision in ("photos", "dense"):
        frames = (
            ScenesDataManagerConfig(data=run, supervision=supervision)
            .setup(test_mode="val")
            .training_frames(0)
        )
        assert torch.allclose(
            torch.cat([camera.camera_to_worlds for camera, _ in frames]), expected, atol=1e-6
        )


@pytest.mark.parametrize(
    ("values", "mode", "error", "text"),
    [
        (
            ADJUSTMENTS[:8],
            "SE3",
            DataError,
            "9 training photos, but .* corrects the poses of 8; put back the data",
        ),
        (ADJUSTMENTS, None, SceneError, "config.yml: .*mode 'off'.*expected SO3xR3 or SE3"),
        (ADJUSTMENTS / 0, "SE3", SceneError, "expected six finite numbers"),
        (ADJUSTMENTS[:, :5], "SE3", SceneError, r"shape \(9, 5\); expected six"),
    ],
)
def test_corrections_that_do_not_fit_are_refused(
    values, mode, error, text, trained_walls, tmp_path
):
    run = with_state(
        trained_walls, tmp_path, mode, **{"_model.camera_optimizer.pose_adjustment": values}
    )
    with pytest.raises(error, match=text):
        ps.dataset_views(run)


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
