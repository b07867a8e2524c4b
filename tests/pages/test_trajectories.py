"""Camera paths, made and saved."""

import json
import math
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.geometry.transforms import invert_rigid, viewmats_to_opengl
from pointsplat_ns.looking.opening import Opening
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pages import camera_path
from pointsplat_ns.pages.camera_path import FilmSettings, read_path
from pointsplat_ns.pages.trajectories import along, fitted, toured


def views_at(eyes: torch.Tensor, targets: torch.Tensor, up: torch.Tensor | None = None) -> ps.Views:
    K = torch.tensor([[50.0, 0.0, 33.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return ps.Views(look_at(eyes, targets, up), K.repeat(len(eyes), 1, 1), 64, 48, torch.zeros(3))


def ring(angles: torch.Tensor, radius: float = 3.0, height: float = 1.0) -> ps.Views:
    """Cameras about (1, 2, 0) that look at it."""
    middle = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    angles = angles.double()
    eyes = middle + torch.stack([radius * angles.cos(), radius * angles.sin(), height + 0 * angles], dim=1)
    return views_at(eyes, middle.expand(len(eyes), 3))


def captured(count: int = 9, seed: int = 0) -> ps.Views:
    """Poses by hand: uneven steps, tilted, some turned far."""
    generator = torch.Generator().manual_seed(seed)
    eyes = torch.rand(count, 3, generator=generator, dtype=torch.float64).cumsum(0)
    targets = eyes + torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return views_at(eyes, targets, torch.tensor([0.2, -0.9, 0.1]))


def places(views: ps.Views) -> torch.Tensor:
    return invert_rigid(views.viewmats.double())[:, :3, 3]


def axes(views: ps.Views, column: int) -> torch.Tensor:
    return invert_rigid(views.viewmats.double())[:, :3, column]


def assert_rigid(views: ps.Views) -> None:
    turns = views.viewmats[:, :3, :3]
    eye = torch.eye(3, dtype=torch.float64).expand_as(turns)
    torch.testing.assert_close(turns @ turns.transpose(1, 2), eye, rtol=0, atol=1e-9)
    assert bool((torch.linalg.det(turns) > 0).all())


@pytest.mark.parametrize("frames", [9, 10, 57, 200])
def test_path_goes_exactly_through_every_pose(frames):
    views = captured()
    path = along(views, frames)
    assert len(path) == frames
    found = [(path.viewmats == viewmat).all((1, 2)).nonzero() for viewmat in views.viewmats]
    assert all(len(frame) for frame in found), "each pose is a frame, to the bit"
    at = torch.cat(found).flatten()
    assert at[0] == 0 and at[-1] == frames - 1 and bool((at.diff() > 0).all())
    assert torch.equal(path.Ks[at], views.Ks)
    assert_rigid(path)


def test_walk_never_leans_and_passes_the_views():
    views = ring(torch.tensor([0.0, 2.0, 0.7, 1.4, 2.6]))
    path = along(toured(views), 101, torch.tensor([0.0, 0.0, 1.0]).double())
    assert float(axes(path, 0)[:, 2].abs().max()) < 1e-9, "what is right in the picture is level"
    for viewmat in views.viewmats:
        assert float((path.viewmats - viewmat).abs().amax((1, 2)).min()) < 1e-9
    length = float(places(path).diff(dim=0).norm(dim=1).sum())
    assert length < 1.1 * 3 * 2.6, "along the ring and not to and fro"
    assert_rigid(path)


def test_film_of_an_object_goes_once_around_it(monkeypatch):
    up, turn = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 2 * math.pi / 12
    opening = Opening(ring(turn * torch.arange(12)), Up(up), whole=True)
    monkeypatch.setattr(camera_path, "opening_views", lambda *_: opening)
    scene = ball(20)
    path = camera_path.camera_path(scene, ViewSource(scene), None, FilmSettings(64, 48, fps=10, seconds=3.7)).views
    torch.testing.assert_close(path.viewmats[0], path.viewmats[-1], rtol=0, atol=1e-9)
    apart = places(path)[:-1] - torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    assert bool(((apart[:, :2].norm(dim=1) - 3).abs() < 0.15).all())
    assert float(torch.atan2(apart[:, 1], apart[:, 0]).sort().values.diff().max()) < 1.6 * 2 * math.pi / 36
    assert float(axes(path, 0)[:, 2].abs().max()) < 1e-9 and bool(((axes(path, 2)[:-1] * apart).sum(1) < 0).all())


def test_another_size_shows_as_much_from_top_to_bottom():
    views = captured()
    wide = fitted(views, 192, 96)
    assert (wide.width, wide.height) == (192, 96)
    assert wide.Ks[0].tolist() == [[100, 0, 98], [0, 104, 48], [0, 0, 1]]
    assert torch.equal(fitted(views, 64, 48).Ks, views.Ks)


def test_no_views_or_frames_are_refused():
    with pytest.raises(ps.DataError, match="expected at least one"):
        along(captured()[:0], 5)
    with pytest.raises(ps.DataError, match="0 frames; expected at least 1"):
        along(captured(), 0)


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
        (saved(camera_path=[]), "no camera path"),
        (saved(camera_type="equirectangular"), "cameras are 'equirectangular'; expected perspective"),
        (saved(render_width=0), "a picture of 0 x 40 pixels"),
        (saved(render_height=10**9), "a picture of 60 x 1000000000 pixels"),
        (saved(render_height="40"), "a picture of 60 x '40' pixels"),
        (saved(camera_path=[3]), "camera 0 has no pose"),
        (one(camera_to_world=[1.0] * 12), "camera 0 has no pose"),
        (moved(0, 3, math.nan), "camera 0 has no pose"),
        (moved(1, 3, 1e300), "farther than 1e.09 units"),
        (moved(0, 0, 1.0), "no rigid motion"),
        (moved(2, 2, -1.0), "no rigid motion"),
        (one(fov=0), "camera 0 has a fov of 0"),
        (one(fov=180), "camera 0 has a fov of 180"),
    ],
)
def test_anything_else_is_refused_in_one_line(content, message, tmp_path):
    path = written(content, tmp_path)
    with pytest.raises(ps.DataError, match=message) as raised:
        read_path(path)
    assert str(raised.value).startswith(str(path)) and "\n" not in str(raised.value)


def test_missing_and_huge_files_are_refused(tmp_path, caplog):
    with pytest.raises(ps.SceneError, match="no such file; expected a camera path"):
        read_path(tmp_path / "nothing.json")
    path = written(saved(crop={"crop_scale": [1, 1, 1]}, fps=None), tmp_path)
    assert read_path(path).fps == 24 and "its crop is not applied" in caplog.text
    with path.open("r+b") as stream:
        stream.truncate(64_000_001)  # sparse
    with pytest.raises(ps.DataError, match="64 MB; expected a camera path of at most"):
        read_path(path)
