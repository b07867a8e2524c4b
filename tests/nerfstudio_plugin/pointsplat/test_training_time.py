"""Trainings for a time instead of a number of steps. The clock is the test's: it goes on by some
seconds a step."""

import math
from itertools import count

import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
from making import dense_config, equal
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import REFINER_RATES
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer, rate_factor_at

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(autouse=True)
def steps_of_ten_seconds(monkeypatch):
    monkeypatch.setattr(PointSplatTrainer, "clock", count(1000.0, 10.0).__next__)


def timed(three_rooms, folder, seconds, **changes):
    config = dense_config(three_rooms, folder, 2)  # steps, which do not count
    config.seconds = seconds
    config.steps_per_eval_image = 0
    config.save_only_latest_checkpoint = False
    for name, value in changes.items():
        setattr(config, name, value)
    return config


# half of the way from 1 to 0.02 is 0.51
COSINE = {
    0.0: 0.0,
    1e-300: 2e-299,
    0.025: 0.5,
    0.05: 1.0,
    0.525: 0.51,
    1.0: 0.02,
    1.5: 0.02,
    1e300: 0.02,
}
DROPPED = {0.0: 1.0, math.nextafter(0.6, 0): 1.0, 0.6: 0.1, 1e300: 0.1}


@pytest.mark.parametrize(("schedule", "factors"), [("cosine", COSINE), ("step", DROPPED)])
def test_rates_follow_the_share_of_the_training_also_at_extremes(schedule, factors):
    found = {share: rate_factor_at(share, schedule) for share in factors}
    assert found == pytest.approx(factors, rel=1e-12, abs=0)


def test_training_ends_when_the_time_is_over_with_rates_that_fit_it(
    three_rooms, run_training, tmp_path
):
    config = timed(three_rooms, tmp_path, 45.0, rate_factor=3.0)
    trainer, losses = run_training(config)
    assert len(losses) == 5, "the step in which the time ends is a whole one"
    (saved,) = trainer.checkpoint_dir.iterdir()
    assert torch.load(saved, weights_only=True)["pipeline"]["_extra_state"]["seconds"] == 50.0
    rates = {
        name: optimizer.param_groups[0]["lr"]
        for name, optimizer in trainer.optimizers.optimizers.items()
    }
    assert rates == pytest.approx(
        {name: 3 * 0.02 * peak for name, peak in REFINER_RATES.items()}, rel=1e-12
    )
    assert config.optimizers["encoder"]["optimizer"].lr == REFINER_RATES["encoder"], (
        "the config given is left as it is"
    )
    assert (trainer.base_dir / "refiner.safetensors").is_file()


def test_resumed_training_ends_as_an_unbroken_one(three_rooms, run_training, tmp_path):
    whole, losses = run_training(timed(three_rooms, tmp_path / "whole", 80.0, steps_per_save=3))
    rest = timed(three_rooms, tmp_path / "rest", 80.0, load_dir=whole.checkpoint_dir, load_step=3)
    resumed, last_losses = run_training(rest)
    assert len(losses) == 8 and last_losses == losses[4:]
    assert equal(
        whole.pipeline.model.refiner.state_dict(), resumed.pipeline.model.refiner.state_dict()
    )
    rates = [
        [o.param_groups[0]["lr"] for o in t.optimizers.optimizers.values()]
        for t in (whole, resumed)
    ]
    assert rates[0] == rates[1]
    # one that has taken its time has none left
    with pytest.raises(
        PointSplatError, match=r"--seconds 80: the training has taken 80 s .* expected more"
    ):
        timed(three_rooms, tmp_path, 80.0, load_dir=resumed.checkpoint_dir).setup(
            local_rank=0, world_size=1
        ).setup()
