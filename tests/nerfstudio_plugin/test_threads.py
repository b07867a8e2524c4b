"""The number of threads of trainings."""

import pytest
import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system import threads


@pytest.fixture
def three_threads(monkeypatch):
    """Three threads and cores, which stall."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(threads, "cores", lambda: 3)
    monkeypatch.setattr(threads.machine, "stalls", lambda count: True)
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(("count", "used"), [(None, 1), (2, 2)])
def test_steps_use_the_threads_chosen_or_set(
    three_threads, monkeypatch, wall_scene, wall_config, tmp_path, count, used
):
    seen = set()

    def one_step(trainer, step):
        seen.add(torch.get_num_threads())
        return torch.zeros(()), {}, {}

    monkeypatch.setattr("pointsplat_ns.nerfstudio_plugin.stopping.StoppableTrainer.one_step", one_step)
    monkeypatch.setattr("nerfstudio.engine.trainer.Trainer.save_checkpoint", lambda *args: None)
    config = wall_config(wall_scene, tmp_path, 3)
    config.threads, config.early_look = count, False
    config.steps_per_eval_image = 0
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.callbacks = []  # they need what a real step leaves
    trainer.train()
    assert seen == {used}
    assert torch.get_num_threads() == 3
    trainer.config.threads = 0
    with pytest.raises(PointSplatError, match="0 threads"):
        trainer.train()
