"""Two scenes in one picture: each side is the scene's own render."""

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.viewing.film import FilmScenes, Wipe, render_frame, to_uint8, with_labels, with_line


@pytest.fixture(scope="module")
def scenes() -> tuple[ps.Gaussians, ps.Gaussians]:
    first = cloud(300)
    return first, first.replace(features_dc=-first.features_dc)


@pytest.fixture(scope="module")
def view(scenes) -> ps.View:
    return ps.sample_views(scenes[0], 1, 70, 44)[0]


@pytest.mark.parametrize("column", [0, 1, 8, 33, 64, 69, 70])
def test_each_side_of_a_wipe_is_the_render_of_its_scene(scenes, view, column):
    wipe = Wipe(*scenes, view, column)
    picture = torch.cat([wipe.draw(row, row + 1) for row in range(wipe.rows)])
    first, second = (ps.render(scene, view) for scene in scenes)
    expected = torch.cat([first[:, :column], second[:, column:]], dim=1)
    torch.testing.assert_close(picture, expected, rtol=0, atol=1e-5)


def test_side_by_side_is_both_renders_with_a_line_between(scenes, view):
    frame = render_frame(FilmScenes(*scenes), view)
    first, second = (to_uint8(ps.render(scene, view)).astype(int) for scene in scenes)
    assert frame.shape == (44, 140, 3)
    assert np.abs(frame[:, :60] - first[:, :60]).max() <= 1 and np.abs(frame[:, 80:] - second[:, 10:]).max() <= 1
    assert (frame[:, 70] == 255).all()


def test_wipe_moves_to_both_sides(scenes, view):
    film = FilmScenes(*scenes, split="wipe")
    lines = [np.flatnonzero((render_frame(film, view, t) == 255).all((0, 2))).tolist() for t in (0.0, 1.5, 4.5)]
    assert lines == [[35], [63], [7]]


def test_line_is_thin_and_leaves_the_given_picture(view):
    given = np.full((4, 9, 3), 90, np.uint8)
    lined = with_line(given, 4)
    assert lined[0, :, 0].tolist() == [90, 90, 90, 30, 255, 30, 90, 90, 90] and (given == 90).all()
    wide = with_line(np.full((1, 800, 3), 90, np.uint8), 400)
    assert wide[0, 397:404, 0].tolist() == [90, 30, 255, 255, 30, 90, 90]
    assert with_line(given, 0) is given and with_line(given, 9) is given


def test_labels_stand_at_the_top_of_their_sides():
    blank = np.full((200, 400, 3), 128, np.uint8)
    both = with_labels(blank, ["dense", "ein Zehntel, 小"], 200) != 128
    assert both[:40, :200].any() and both[:40, 200:].any() and not both[40:].any()
    assert not (with_labels(blank, ["", "second"], 200)[:, :200] != 128).any()
    narrow = with_labels(blank, ["first", "second"], 30) != 128
    assert not narrow[:, :200].any() and narrow[:, 200:].any(), "no room on the left"
