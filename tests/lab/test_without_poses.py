"""lab/judge/captures.py makes captures ready to train; lab/judge/without_poses.py measures what
poses are worth."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData

import pointsplat_ns as ps
from captures import FRAMES, HEIGHT, OPENCV_TO_OPENGL, WIDTH, Capture, Lens
from lab.judge import captures, without_poses
from lab.judge.scenes import load, losses
from making import box_room, run_of
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.scene.ply import write_ply

pytestmark = pytest.mark.usefixtures("quick")

KNOWN = captures.Capture(
    "owner/name", "0" * 40, "images", "transforms.json", FRAMES, (WIDTH, HEIGHT), "room", "walls"
)
BENT = Lens(distortion=(0.12, -0.03, 0.002, -0.001))


def ready(clone: Path, target: Path, known: captures.Capture, side: int) -> list[dict]:
    assert captures.prepare(known, clone, target, side) == FRAMES
    frames = json.loads((target / "transforms.json").read_text())["frames"]
    assert len(frames) == FRAMES
    for frame in frames:
        assert cv2.imread(str(target / frame["file_path"])).shape == (frame["h"], frame["w"], 3)
    return frames


@pytest.mark.parametrize("opencv", [False, True])
def test_poses_of_a_json_have_opengl_axes_and_scaled_intrinsics(opencv, tmp_path):
    made = Capture()
    clone = made.write_nerfstudio(tmp_path / "clone")
    content = json.loads((clone / "transforms.json").read_text())
    for frame, pose in zip(content["frames"], made.poses, strict=True):
        frame["file_path"] = "..\\photos\\" + Path(frame["file_path"]).name
        frame["transform_matrix"] = (pose @ (OPENCV_TO_OPENGL if opencv else np.eye(4))).tolist()
    (clone / "transforms.json").write_text(json.dumps(content))
    known = dataclasses.replace(KNOWN, opencv=opencv)
    frames = ready(clone, tmp_path / "ready", known, WIDTH // 2)
    for frame, pose in zip(frames, made.poses, strict=True):
        assert np.allclose(frame["transform_matrix"], pose)
        assert (frame["w"], frame["h"]) == (WIDTH // 2, HEIGHT // 2)
        assert np.allclose(
            [frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]], [22.5, 23.0, 15.5, 12.25]
        )


def test_photos_of_a_colmap_model_become_pinhole_pictures(tmp_path):
    bent = Capture(BENT)
    names = bent.write_photos(tmp_path / "clone/images")
    bent.write_colmap(tmp_path / "clone/sparse", names, suffix=".bin")
    known = dataclasses.replace(KNOWN, poses="sparse")
    frames = ready(tmp_path / "clone", tmp_path / "ready", known, WIDTH)
    for frame, photo in zip(frames, bent.photos, strict=True):
        # The same wall, seen by a pinhole camera of the intrinsics that were written.
        lens = Lens(focal=(frame["fl_x"], frame["fl_y"]), center=(frame["cx"], frame["cy"]))
        expected = Capture(lens).photos[int(Path(frame["file_path"]).stem)].astype(float)
        picture = cv2.imread(str(tmp_path / "ready" / frame["file_path"]))[..., ::-1]
        error = np.abs(picture - expected).mean()
        assert error < 1.5  # levels of 255: two interpolations
        assert np.abs(photo - expected).mean() > 1.5 * error
    points = PlyData.read(str(tmp_path / "ready/sparse_pc.ply"))["vertex"]
    assert len(points) == len(bent.seeds)


def test_a_clone_of_another_repository_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"owner/name"):
        captures.prepare(KNOWN, tmp_path, tmp_path / "ready", 960)
    assert not (tmp_path / "ready").exists()


def test_every_way_and_set_of_views_has_a_row(trained_walls, tmp_path):
    run = run_of(trained_walls, "wall-a")
    without_poses.main((run,), keep=(0.5,), views=2, json_path=tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    ways = [(row["method"], row["views"]) for row in rows]
    assert ways == [(way, name) for way in ("prune", "compact") for name in without_poses.SETS]
    scene = load(run, (), 2)
    poses = dataset_views(run, "train")
    for row in rows[:3]:
        given = {"sampled": None, "all": poses, "third": poses[::3]}[row["views"]]
        [(_, _, expected)] = losses(scene, [ps.prune(scene.dense, row["count"], views=given)], None)
        assert row["psnr"] == pytest.approx(expected["covered_psnr"], abs=1e-9)


def test_a_ply_is_refused_as_it_has_no_held_out_poses(tmp_path):
    write_ply(box_room(seed=3), tmp_path / "room.ply")
    with pytest.raises(SceneError, match="expected a run"):
        without_poses.main((tmp_path / "room.ply",))
