"""Pictures are drawn band by band, and one that nobody waits for any more is given up."""

import math
import queue
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.viewing.film import to_uint8
from pointsplat_ns.viewing.painter import Painter, PictureRequest, ViewerCamera, paint
from pointsplat_ns.viewing.schedule import DrawingStep
from pointsplat_ns.viewing.selection import ReducedScene


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(500)


@pytest.fixture(scope="module")
def camera(scene) -> ViewerCamera:
    view = ps.sample_views(scene, 1)[0]
    fov = 2 * math.atan(0.5 * view.height / float(view.K[1, 1]))
    return ViewerCamera(view.viewmat, fov, 4 / 3, view.background, view.near_plane)


def request(
    camera: ViewerCamera, scene: ps.Gaussians, second: ps.Gaussians | None = None, line: float = 1.0
) -> PictureRequest:
    other = None if second is None else ReducedScene(second, "all")
    return PictureRequest(camera, ReducedScene(scene, "all"), other, line)


def step(of: PictureRequest, side: int = 400, moving: bool = False) -> DrawingStep[PictureRequest]:
    return DrawingStep(of, 1, side, 1.0, moving, whole=not moving)


def test_picture_is_the_render_of_its_view(scene, camera):
    *bands, pixels = paint(step(request(camera, scene)))
    assert len(bands) > 3 and all(band is None for band in bands)
    view = ps.sample_views(scene, 1, 400, 300)[0]
    assert np.abs(pixels - to_uint8(ps.render(scene, view)).astype(int)).max() <= 1


def test_two_scenes_meet_at_the_line(scene, camera):
    second = scene.replace(features_dc=-scene.features_dc)
    *_, pixels = paint(step(request(camera, scene, second, 0.25)))
    *_, first = paint(step(request(camera, scene)))
    *_, other = paint(step(request(camera, second)))
    assert np.abs(pixels[:, :97] - first[:, :97].astype(int)).max() <= 1
    assert np.abs(pixels[:, 103:] - other[:, 103:].astype(int)).max() <= 1
    assert (pixels[:, 100] == 255).all()


@pytest.mark.parametrize(("aspect", "size"), [(2.0, (200, 100)), (0.5, (100, 200)), (1e9, (200, 10)), (0.0, (10, 200))])
def test_picture_has_the_shape_of_the_window(aspect, size, camera):
    view = ViewerCamera(camera.viewmat, camera.fov, aspect, camera.background, camera.near_plane).view(200)
    assert (view.width, view.height) == size
    assert 2 * math.atan(0.5 * view.height / float(view.K[1, 1])) == pytest.approx(camera.fov)


def test_newer_request_ends_a_whole_picture_between_two_bands(scene, camera):
    shown: queue.Queue[DrawingStep[PictureRequest]] = queue.Queue()
    in_band, moved = threading.Event(), threading.Event()
    given_up = []

    def slow(of: DrawingStep[PictureRequest]) -> Iterator[np.ndarray | None]:
        if not of.moving and of.number == 1:
            try:
                while True:
                    in_band.set()
                    moved.wait(30)
                    yield None
            finally:
                given_up.append(of.number)
        yield np.zeros((2, 2, 3), np.uint8)

    painter = Painter(lambda pixels, of, seconds: shown.put(of), slow)
    try:
        painter.schedule.submit(request(camera, scene))
        assert in_band.wait(30) and shown.get(timeout=30).moving
        painter.schedule.submit(request(camera, scene))
        moved.set()
        steps = [shown.get(timeout=30)]
        while steps[-1].moving:
            steps.append(shown.get(timeout=30))
    finally:
        painter.close()
    assert given_up == [1] and {of.number for of in steps} == {2} and steps[-1].side == 960


def test_camera_without_a_place_does_not_end_the_drawing(scene, camera, caplog):
    shown: queue.Queue[np.ndarray] = queue.Queue()
    painter = Painter(lambda pixels, of, seconds: shown.put(pixels))
    nowhere = ViewerCamera(torch.full((4, 4), torch.nan, dtype=torch.float64), 1.0, 1.0, torch.zeros(3), 0.01)
    try:
        painter.schedule.submit(request(nowhere, scene))
        assert shown.get(timeout=30).shape == (1, 1, 3)
        painter.schedule.submit(request(camera, scene), 64)
        while (pixels := shown.get(timeout=30)).shape != (48, 64, 3):
            pass
        assert pixels.std() > 10
    finally:
        painter.close()
    assert "cannot draw" in caplog.text and not painter._thread.is_alive()
