"""Ctrl-C in ``ns-train``."""

from __future__ import annotations

import pytest
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import launch

from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import SplatfactoCpuTrainer, splatfacto_cpu_config


@pytest.mark.parametrize("when", ["setup", "train"])
def test_an_interrupted_training_ends_as_interrupted_and_not_as_finished(when, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    def main(**_):
        trainer = object.__new__(SplatfactoCpuTrainer)
        trainer.device = "cpu"
        getattr(trainer, when)()

    monkeypatch.setattr(Trainer, when, interrupted)
    with pytest.raises(SystemExit) as end:
        launch(main, num_devices_per_machine=1, config=splatfacto_cpu_config(), device_type="cpu")
    assert end.value.code == 130
    assert capsys.readouterr().err.endswith("interrupted\n")
