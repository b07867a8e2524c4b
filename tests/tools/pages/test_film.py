"""Cameras of films, and labels of pictures side by side."""

import math

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.tools.pages import film
from pointsplat_ns.tools.pages.film import FilmSettings, along, fitted, toured
from pointsplat_ns.tools.pages.image_encoding import with_labels
from pointsplat_ns.view_sampling.opening_views import Opening
from pointsplat_ns.view_sampling.poses import look_at
from pointsplat_ns.view_sampling.upright import Up

pytestmark = pytest.mark.usefixtures("quick")


def views_at(eyes: torch.Tensor, targets: torch.Tensor, up: torch.Tensor | None = None) -> ps.Views:
    K = torch.tensor([[50.0, 0.0, 33.0], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return ps.Views(look_at(eyes, targets, up), K.repeat(len(eyes), 1, 1), 64, 48, torch.zeros(3))


def ring(angles: torch.Tensor, radius: float = 3.0, height: float = 1.0) -> ps.Views:
    """Cameras about (1, 2, 0) that look at it."""
    middle = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    angles = angles.double()
    eyes = middle + torch.stack(
        [radius * angles.cos(), radius * angles.sin(), height + 0 * angles], dim=1
    )
    return views_at(eyes, middle.expand(len(eyes), 3))


def captured(count: int = 9, seed: int = 0) -> ps.Views:
    """Poses by hand: uneven steps, tilted, some turned far."""
    generator = torch.Generator().manual_seed(seed)
    eyes = torch.rand(count, 3, generator=generator, dtype=torch.float64).cumsum(0)
    targets = eyes + torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return views_at(eyes, targets, torch.tensor([0.2, -0.9, 0.1]))


def axes(views: ps.Views, column: int) -> torch.Tensor:
    """One axis of each camera, or its position, in the world."""
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
    length = float(axes(path, 3).diff(dim=0).norm(dim=1).sum())
    assert length < 1.1 * 3 * 2.6, "along the ring and not to and fro"
    assert_rigid(path)


def test_film_of_an_object_goes_once_around_it(monkeypatch):
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    turn = 2 * math.pi / 12
    opening = Opening(ring(turn * torch.arange(12)), Up(up), whole=True)
    monkeypatch.setattr(film, "opening_views", lambda *_: opening)
    scene = ball(20)
    path, _ = film.camera_path(
        scene, ViewProvider(scene), FilmSettings(64, 48, fps=10, seconds=3.7)
    )
    torch.testing.assert_close(path.viewmats[0], path.viewmats[-1], rtol=0, atol=1e-9)
    apart = axes(path, 3)[:-1] - torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    assert bool(((apart[:, :2].norm(dim=1) - 3).abs() < 0.15).all())
    assert (
        float(torch.atan2(apart[:, 1], apart[:, 0]).sort().values.diff().max())
        < 1.6 * 2 * math.pi / 36
    )
    assert float(axes(path, 0)[:, 2].abs().max()) < 1e-9 and bool(
        ((axes(path, 2)[:-1] * apart).sum(1) < 0).all()
    )


def test_another_size_shows_as_much_from_top_to_bottom():
    views = captured()
    wide = fitted(views, 192, 96)
    assert (wide.width, wide.height) == (192, 96)
    assert wide.Ks[0].tolist() == [[100, 0, 98], [0, 104, 48], [0, 0, 1]]
    assert torch.equal(fitted(views, 64, 48).Ks, views.Ks)


def test_labels_stand_at_the_top_of_their_halves_and_are_shortened():
    blank = np.full((200, 400, 3), 128, np.uint8)
    both = with_labels(blank, ["dense", "ein Zehntel, 小"]) != 128
    assert both[:40, :200].any() and both[:40, 200:].any() and not both[40:].any()
    assert not (with_labels(blank, ["", "second" * 20]) != 128)[:, :200].any()
