"""Camera paths as nerfstudio's viewer saves them are read as nerfstudio reads them; anything else is refused."""

import json
import math
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from pointsplat_ns.geometry.transforms import viewmats_to_opengl
from pointsplat_ns.viewing import camera_path
from pointsplat_ns.viewing.camera_path import read_path

TURNED = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def saved(**changes) -> dict:
    """What the viewer saves, with parts replaced; None leaves a part out."""
    camera = {"camera_to_world": sum(TURNED, []), "fov": 60.0, "aspect": 1.5}
    content = {
        "default_fov": 75.0, "default_transition_sec": 2.0, "keyframes": [], "camera_type": "perspective",
        "render_height": 40, "render_width": 60, "fps": 24.0, "seconds": 4.0, "is_cycle": False,
        "smoothness_value": 0.0, "camera_path": [camera, {**camera, "fov": 90}],
    }  # fmt: skip
    return {name: value for name, value in {**content, **changes}.items() if value is not None}


def written(content, folder: Path) -> Path:
    path = folder / "path.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_cameras_are_those_that_nerfstudio_reads(tmp_path):
    from nerfstudio.cameras.camera_paths import get_path_from_json

    found, expected = read_path(written(saved(), tmp_path)), get_path_from_json(saved())
    views = found.views
    assert (len(views), views.width, views.height, found.fps) == (2, 60, 40, 24.0)
    torch.testing.assert_close(viewmats_to_opengl(views.viewmats).float(), expected.camera_to_worlds)
    torch.testing.assert_close(views.Ks.float(), expected.get_intrinsics_matrices())


def test_camera_looks_along_its_negative_z_axis(tmp_path):
    view = read_path(written(saved(), tmp_path)).views[0]
    ahead = torch.tensor([1.0, 2.0, 2.0, 1.0], dtype=torch.float64)  # below the camera, which looks down
    torch.testing.assert_close((view.viewmat @ ahead)[:3], torch.tensor([0.0, 0.0, 1.0]).double())


@pytest.mark.parametrize("fps", [None, "fast", 0, -3, 1e9, math.nan, True, 10**400])
def test_frames_a_second_may_be_missing_or_mean_nothing(fps, tmp_path):
    content = json.dumps(saved(fps=0)).replace('"fps": 0', f'"fps": {json.dumps(fps)}')
    assert read_path(written(content, tmp_path)).fps is None


def one(**changes) -> dict:
    """A saved path of one camera, changed."""
    return saved(camera_path=[{**saved()["camera_path"][0], **changes}])


def moved(row: int, column: int, value: float) -> dict:
    values = [list(line) for line in TURNED]
    values[row][column] = value
    return one(camera_to_world=sum(values, []))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read as JSON"),
        ("[" * 100_000, "cannot be read as JSON"),
        ("\ud800".encode("utf-16", "surrogatepass").decode("latin-1"), "cannot be read as JSON"),
        ("[]", "no camera path"),
        ("3", "no camera path"),
        (saved(camera_path=None), "no camera path"),
        (saved(camera_path=[]), "no camera path"),
        (saved(camera_path={"0": 1}), "no camera path"),
        (saved(camera_type="equirectangular"), "cameras are 'equirectangular'; expected perspective"),
        (saved(render_width=None), "render_width is None"),
        (saved(render_width=0), "render_width is 0"),
        (saved(render_height=10**9), "render_height is 1000000000"),
        (saved(render_height=40.5), "render_height is 40.5"),
        (saved(render_height="40"), "render_height is 40"),
        (saved(camera_path=[3]), "camera 0 has no pose"),
        (one(camera_to_world=[1.0] * 12), "camera 0 has no pose"),
        (one(camera_to_world=["1"] * 16), "camera 0 has no pose"),
        (moved(0, 3, math.nan), "camera 0 has no pose"),
        (moved(1, 3, 1e300), "farther than 1e.09 units"),
        (moved(0, 0, 1.0), "no rigid motion"),
        (moved(0, 0, 1e200), "no rigid motion"),
        (moved(2, 2, -1.0), "no rigid motion"),
        (moved(3, 3, 2.0), "no rigid motion"),
        (one(fov=0), "fov of camera 0 is 0"),
        (one(fov=180), "fov of camera 0 is 180"),
        (one(fov=None), "fov of camera 0 is None"),
    ],
)
def test_anything_else_is_refused_in_one_line(content, message, tmp_path):
    path = written(content, tmp_path)
    with pytest.raises(ps.DataError, match=message) as raised:
        read_path(path)
    assert str(raised.value).startswith(str(path)) and "\n" not in str(raised.value)


def test_missing_and_huge_files_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ps.SceneError, match="no such file; expected a camera path"):
        read_path(tmp_path / "nothing.json")
    monkeypatch.setattr(camera_path, "CAMERA_PATH", camera_path.PathSettings(bytes=10))
    with pytest.raises(ps.DataError, match="expected a camera path of at most"):
        read_path(written(saved(), tmp_path))


def test_crop_is_said_to_be_left_out(tmp_path, caplog):
    read_path(written(saved(crop={"crop_scale": [1, 1, 1]}), tmp_path))
    assert "its crop is not applied" in caplog.text
