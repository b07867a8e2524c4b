"""What is drawn for a moving camera, by the schedule alone: the clock is turned by hand, and nothing is drawn."""

import threading

import pytest

from pointsplat_ns.viewing import schedule as module
from pointsplat_ns.viewing.schedule import SCHEDULE, DrawingStep, Schedule, ScheduleSettings


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


def test_nothing_is_drawn_before_anything_is_asked_for(schedule):
    assert schedule.next(timeout=0) is None


def test_moving_camera_gets_small_pictures_and_a_still_one_the_whole(schedule, clock):
    for number in range(4):
        schedule.submit(f"camera {number}")
        step = drawn(schedule, clock)
        assert step.request == f"camera {number}" and step.moving and step.side < 960
        assert schedule.next(timeout=0) is None, "not before the camera has been still for a while"
    sides = [step.side for step in rest(schedule, clock)]
    assert sides[-1] == 960 and sides == sorted(set(sides))
    assert schedule.next(timeout=0) is None, "nothing changes any more"


def test_requests_that_came_while_drawing_are_skipped_but_for_the_newest(schedule, clock):
    schedule.submit("first")
    step = schedule.next(timeout=0)
    for request in ("second", "third"):
        schedule.submit(request)
    assert not schedule.outdated(step), "else nothing would be seen while the camera moves"
    schedule.done(step, 0.1)
    assert schedule.next(timeout=0).request == "third"


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


@pytest.mark.parametrize("whole", [0.3, 3.0, 30.0])
@pytest.mark.parametrize("fixed", [0.0, 0.7])
def test_time_of_moving_pictures_settles(schedule, clock, whole, fixed):
    """A picture takes some time for its pixels and some for its Gaussians, however small it is."""

    def seconds(step: DrawingStep[str]) -> float:
        return whole * (fixed * step.share + (1 - fixed) * (step.side / 960) ** 2 * step.share)

    taken = []
    for number in range(60):
        schedule.submit(str(number))
        step = schedule.next(timeout=0)
        taken.append(seconds(step))
        schedule.done(step, taken[-1])
    least = whole * (fixed + (1 - fixed) * (SCHEDULE.moving_side / 960) ** 2) * SCHEDULE.least_share
    aim = max(SCHEDULE.moving_seconds, least)
    assert all(0.6 * aim < some < 1.6 * aim for some in taken[-10:]), taken[-10:]
    assert SCHEDULE.moving_side <= step.side <= 960 and SCHEDULE.least_share <= step.share <= 1


def test_gaussians_are_left_out_only_of_the_smallest_pictures(schedule, clock):
    seen = set()
    for number in range(40):
        schedule.submit(str(number))
        step = drawn(schedule, clock, 5.0)
        seen.add((step.side > SCHEDULE.moving_side, step.share < 1))
    assert seen == {(True, False), (False, False), (False, True)} or seen == {(True, False), (False, True)}
    assert step.share == pytest.approx(SCHEDULE.least_share)
    steps = rest(schedule, clock)
    assert all(step.share == 1 and not step.moving for step in steps)
    assert [step.side for step in steps] == [960]


def test_close_wakes_who_waits_and_outdates_what_is_drawn(schedule):
    schedule.submit("any")
    step = schedule.next(timeout=0)
    schedule.done(step, 0.1)
    found = []
    waiting = threading.Thread(target=lambda: found.append(schedule.next()))
    waiting.start()
    schedule.close()
    waiting.join(10)
    assert found == [None] and schedule.outdated(step) and schedule.next(timeout=0) is None


def test_who_waits_is_woken_by_a_request_and_by_rest(monkeypatch):
    monkeypatch.setattr(module, "SCHEDULE", ScheduleSettings(rest_seconds=0.05))
    schedule: Schedule[str] = Schedule(960)
    found: list[DrawingStep[str]] = []

    def draw() -> None:
        while (step := schedule.next()) is not None:
            found.append(step)
            schedule.done(step, 0.1)
            if step.side == 960:
                return

    drawing = threading.Thread(target=draw)
    drawing.start()
    schedule.submit("now")
    drawing.join(10)
    assert not drawing.is_alive() and found[0].moving and found[-1].side == 960
