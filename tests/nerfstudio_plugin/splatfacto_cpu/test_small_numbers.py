"""Numbers below the smallest normal float are 0 where that is asked for, and nowhere else."""

import threading

import pytest
import torch

from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModel
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.trainer import takes_tiny_as_zero, tiny_as_zero

supported = torch.set_flush_denormal(True)
torch.set_flush_denormal(False)
pytestmark = pytest.mark.skipif(not supported, reason="this processor has no such mode")


def test_only_while_the_context_is_open_also_after_an_error():
    assert not takes_tiny_as_zero()
    with pytest.raises(ZeroDivisionError), tiny_as_zero():
        with tiny_as_zero():
            assert takes_tiny_as_zero()
        assert takes_tiny_as_zero()
        raise ZeroDivisionError
    assert not takes_tiny_as_zero()


def test_threads_that_are_started_do_so_too():
    found = []
    with tiny_as_zero():
        thread = threading.Thread(target=lambda: found.append(takes_tiny_as_zero()))
        thread.start()
        thread.join()
    assert found == [True]


def test_a_training_takes_them_as_zero(wall_scene, wall_config, tmp_path, monkeypatch):
    found, losses_of = [], SplatfactoCpuModel.get_loss_dict

    def losses(self, *args, **kwargs):
        found.append(takes_tiny_as_zero())
        return losses_of(self, *args, **kwargs)

    monkeypatch.setattr(SplatfactoCpuModel, "get_loss_dict", losses)
    config = wall_config(wall_scene, tmp_path, 2)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    assert found == [True, True] and not takes_tiny_as_zero()
