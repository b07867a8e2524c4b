"""What is drawn when, and the painter."""

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
from pointsplat_ns.viewing.schedule import SCHEDULE, DrawingStep, Schedule
from pointsplat_ns.viewing.selection import ReducedScene


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture()
def clock() -> Clock:
    return Clock()


@pytest.fixture()
def schedule(clock) -> Schedule[str]:
    return Schedule(960, clock)


def drawn(schedule: Schedule[str], clock: Clock, seconds: float = SCHEDULE.moving_seconds) -> DrawingStep[str]:
    """Draw the next step in so many seconds."""
    step = schedule.next(timeout=0)
    assert step is not None
    clock.now += seconds
    schedule.done(step, seconds)
    return step


def rest(schedule: Schedule[str], clock: Clock, seconds: float = SCHEDULE.moving_seconds) -> list[DrawingStep[str]]:
    """Draw everything that a camera at rest gets."""
    clock.now += SCHEDULE.rest_seconds
    steps = []
    while (step := schedule.next(timeout=0)) is not None:
        clock.now += seconds
        schedule.done(step, seconds)
        steps.append(step)
    return steps


def test_moving_camera_gets_small_pictures_and_a_still_one_the_whole(schedule, clock):
    for number in range(4):
        schedule.submit(f"camera {number}")
        step = drawn(schedule, clock)
        assert step.request == f"camera {number}" and step.moving and step.side < 960
        assert schedule.next(timeout=0) is None, "not before the camera has been still for a while"
    sides = [step.side for step in rest(schedule, clock)]
    assert sides[-1] == 960 and sides == sorted(set(sides))
    assert schedule.next(timeout=0) is None, "nothing changes any more"


def test_newer_camera_cancels_the_whole_picture(schedule, clock):
    schedule.submit("still")
    drawn(schedule, clock)
    clock.now += SCHEDULE.rest_seconds
    whole = schedule.next(timeout=0)
    assert not whole.moving and not schedule.outdated(whole)
    schedule.submit("moved")
    assert schedule.outdated(whole)
    assert schedule.next(timeout=0).moving
    schedule.done(whole, 9.0)  # it was finished all the same
    assert schedule.next(timeout=0).request == "moved"


def test_whole_picture_has_all_gaussians_and_comes_soon_where_it_is_cheap(schedule, clock):
    for _ in range(30):
        schedule.submit("cheap")
        step = drawn(schedule, clock, 0.001)
    assert (step.side, step.share) == (960, 1.0)
    assert step.whole and rest(schedule, clock) == [], "the small picture is the whole one already"


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
