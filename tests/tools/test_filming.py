"""Films of scenes, as users make them."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball, run_of
from pointsplat_ns.cli import main
from pointsplat_ns.tools.pages.image_encoding import to_uint8

pytestmark = pytest.mark.usefixtures("quick")

SMALL = {"width": 64, "height": 48, "fps": 10}


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(700)


@pytest.fixture(scope="module")
def files(scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    ps.save(scene, folder / "ball.ply")
    ps.save(scene[::2], folder / "half.splat")
    return folder


def frames_in(folder: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)) for path in sorted(folder.iterdir())]


def test_film_of_a_scene_moves(tmp_path):
    scene = ball(700, log_size=math.log(0.06))
    assert ps.render_path(scene, tmp_path / "frames", seconds=0.6, **SMALL) == 6
    frames = frames_in(tmp_path / "frames")
    assert len(frames) == 6 and all(
        frame.shape == (48, 64, 3) and frame.std() > 10 for frame in frames
    )
    assert all((a != b).mean() > 0.1 for a, b in zip(frames, frames[1:], strict=False))


def test_film_of_a_run_goes_exactly_through_its_photos(trained_walls, tmp_path, caplog):
    run = run_of(trained_walls, "wall-b")
    with caplog.at_level("INFO", "pointsplat_ns"):
        count = ps.render_path(run, tmp_path / "frames", fps=2)
    views = ps.dataset_views(run)
    frames = frames_in(tmp_path / "frames")
    assert count == len(frames) == 20 and "along the poses of the dataset" in caplog.text
    for view in views:  # antialiased, over white
        shown = to_uint8(ps.render(ps.load(run), view)).astype(int)
        assert min(np.abs(frame - shown).max() for frame in frames) <= 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 1}, "width is 1; expected 2 to 16384"),
        ({"height": 10**6}, "height is 1000000"),
        ({"fps": 0}, "fps is 0"),
        ({"fps": float("nan")}, "fps is nan"),
        ({"seconds": -1}, "seconds are -1"),
        ({"seconds": 1e9}, "seconds are 1e.09"),
    ],
)
def test_what_means_nothing_is_refused(options, message, scene, tmp_path):
    with pytest.raises(ps.PointSplatError, match=message):
        ps.render_path(scene, tmp_path / "frames", **options)
    assert not [*tmp_path.iterdir()]


def test_command_writes_what_the_function_writes(files, tmp_path, capsys):
    options = ["--width", "64", "--height", "48", "--fps", "10", "--seconds", "0.3"]
    scenes = [str(files / "ball.ply"), str(files / "half.splat")]
    main(["render", *scenes, "-o", str(tmp_path / "by_command"), *options])
    assert re.search(r"by_command: 3 frames, [\d.]+ kB, in ", capsys.readouterr().out)
    ps.render_path(scenes[0], tmp_path / "by_function", scenes[1], seconds=0.3, **SMALL)
    pairs = zip(
        frames_in(tmp_path / "by_command"), frames_in(tmp_path / "by_function"), strict=True
    )
    assert all((one == other).all() and one.shape == (48, 128, 3) for one, other in pairs), (
        "side by side"
    )


def test_given_views_keep_their_size_and_photos_are_reduced(scene, tmp_path):
    ps.render_path(scene, tmp_path / "given.png", views=ps.sample_views(scene, 1, 1001, 50))
    assert Image.open(tmp_path / "given.png").size == (1000, 50)
    ps.render_path(
        scene, tmp_path / "narrow.png", views=ps.sample_views(scene, 1, 1001, 50), width=80
    )
    assert Image.open(tmp_path / "narrow.png").size == (80, 4)


def test_command_writes_a_video_beside_the_scene_and_overwrites_nothing(files, tmp_path, capsys):
    (tmp_path / "ball.ply").write_bytes((files / "ball.ply").read_bytes())
    words = ("render", tmp_path / "ball.ply", *"--width 33 --height 25 --fps 2 --seconds 1".split())
    run(*words)
    assert (tmp_path / "ball.mp4").stat().st_size > 500
    assert "ball.mp4: exists already" in refusal(capsys, tmp_path, *words)
