"""How long a training says that it will take, and when it draws pictures."""

from types import SimpleNamespace

import pytest
import torch

from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu import early_look
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.early_look import EarlyLook, picture_steps


class Clock:
    """Time that passes by the step."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        self.now, self.lines = 1000.0, []
        monkeypatch.setattr(early_look.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(early_look.CONSOLE, "log", self.lines.append)


def pipeline():
    """What EarlyLook looks at of a pipeline without held-out photos."""
    config = SimpleNamespace(num_downscales=2, resolution_schedule=100)
    model = SimpleNamespace(config=config)
    return SimpleNamespace(model=model, datamanager=SimpleNamespace(eval_dataset=[]))


def test_the_time_left_is_said_after_some_steps_and_whenever_the_resolution_has_risen(monkeypatch, tmp_path):
    clock = Clock(monkeypatch)
    look = EarlyLook(pipeline(), tmp_path, first=0, count=1000)
    monkeypatch.setattr(look, "_seconds_to_render", lambda factor: 0.1 / factor**2)
    said = {}
    for step in range(1000):
        look.before_step(step)
        for line in clock.lines:
            said[step] = line
        clock.lines.clear()
        # Steps whose time is that of their pixels; the first ones are slow, and are not counted.
        clock.now += 30.0 if step < 2 else (0.25, 1.0, 4.0)[min(step // 100, 2)]
    assert list(said) == [14, 107, 207]
    # 86 steps at 0.25 s, 100 at 1 s and 800 at 4 s are 55 minutes.
    assert said[14] == "0.25 s a step, about 4 s at full resolution: the 986 steps left take about 55 min"
    assert said[107] == "1 s a step, about 4 s at full resolution: the 893 steps left take about 55 min"
    assert said[207] == "4 s a step: the 793 steps left take about 53 min"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("cost, most", [(0.001, 7), (3.0, 5), (1000.0, 2)])
def test_pictures_are_sparse_and_take_no_more_than_their_share_of_the_time(cost, most, monkeypatch, tmp_path):
    clock = Clock(monkeypatch)
    with_photos = pipeline()
    with_photos.datamanager.eval_dataset = [0]
    look = EarlyLook(with_photos, tmp_path, first=5000, count=7000)
    spent = []

    def drawn():
        clock.now += cost
        spent.append(clock.now)
        return torch.zeros(4, 5, 3), torch.ones(4, 5, 3)

    monkeypatch.setattr(look, "_look", drawn)
    for step in range(5000, 12_000):
        look.before_step(step)
        clock.now += 0.1
    look.after_training(11_999)
    assert len(list(tmp_path.iterdir())) == len(spent) <= most
    assert cost * (len(spent) - 2) <= 0.02 * (clock.now - 1000)  # but for first and last
    assert (tmp_path / "step-000012000.jpg").is_file()
    assert picture_steps(7000) == [110, 220, 440, 880, 1760, 3520, 7000]
