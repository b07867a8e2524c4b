"""Photos with poses print as one line, not as their pixels."""

from types import SimpleNamespace

import pytest

from making import ball
from pointsplat_ns.pipeline.photos.examples import render_of
from room_views import room_views


def test_a_view_and_a_photo_print_their_size_in_one_line():
    view = room_views()[0]
    photo = render_of(ball(5), view)
    assert repr(view) == "View(64 x 48 pixels, classic)"
    assert repr(photo) == "Example(64 x 48 pixels)"
    assert repr(photo._replace(mask=photo.target[..., :1] > 0)) == "Example(64 x 48 pixels, masked)"


def test_the_photos_of_a_run_print_their_number_and_scene():
    pytest.importorskip("nerfstudio")
    from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import RunPhotos

    photos = RunPhotos(SimpleNamespace(name="kitchen"), [None] * 7)
    assert repr(photos) == "RunPhotos(7 photos of kitchen)"
