"""A view that is drawn in parts is the view that is drawn at once."""

import dataclasses

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.rasterizer.drawing import Drawing
from pointsplat_ns.rasterizer.tiles import Region


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return cloud(400)


@pytest.fixture(scope="module", params=["classic", "antialiased"])
def view(request, scene) -> ps.View:
    """Neither side is a multiple of a tile's."""
    sampled = ps.sample_views(scene, 1, 75, 53)[0]
    return dataclasses.replace(sampled, background=torch.tensor([0.2, 0.4, 0.9]), rasterize_mode=request.param)


@pytest.mark.parametrize("high", [1, 3, 7])
def test_bands_are_the_rows_of_the_render(scene, view, high):
    drawing = Drawing(scene, view)
    bands = [
        drawing.draw(Region(top, min(top + high, drawing.rows), 0, drawing.columns))
        for top in range(0, drawing.rows, high)
    ]
    # The blocks of tiles differ, and with them the order of sums in float32.
    torch.testing.assert_close(torch.cat(bands), ps.render(scene, view), rtol=0, atol=1e-5)


def test_nothing_in_view_is_the_background(view):
    nothing = Drawing(ps.Gaussians.empty(), view).draw(Region(0, 1, 0, 2))
    assert torch.equal(nothing, view.background.expand(8, 16, 3))


def test_colours_without_meaning_are_left_out(scene, view):
    broken = scene.replace(features_dc=scene.features_dc.index_fill(0, torch.tensor([0]), torch.nan))
    drawing = Drawing(broken, view)
    picture = drawing.draw(Region(0, drawing.rows, 0, drawing.columns))
    torch.testing.assert_close(picture, ps.render(scene[1:], view), rtol=0, atol=1e-5)
