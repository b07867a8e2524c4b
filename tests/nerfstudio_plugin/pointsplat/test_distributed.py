"""Two processes that torchrun starts do what one does with twice the scenes an update. Run as a
program: the two."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import pytest
import torch
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

import method_configs.methods  # noqa: F401  (as nerfstudio does: completes its imports in the order that it can)
from broken_steps import broken
from making import (
    QUICK_START,
    REPOSITORY,
    box_room,
    dense_config,
    equal,
    losses_of,
    views_sampled_once,
)
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.metrics.lpips import LpipsUnavailable
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline
from pointsplat_ns.scene.ply import write_ply
from quick import quick_settings

pytestmark = pytest.mark.xdist_group("distributed")  # one worker trains for all tests of this file

UPDATES = 2
BROKEN = {3}, {6}
"""Places of a broken photo, which the second process meets, and of a broken gradient, which the
first does."""


def config_of(data: Path, output_dir: Path, steps: int):
    """The method at a size for tests, at constant rates, for a schedule counts steps, not
    scenes."""
    config = dense_config(data, output_dir, steps)
    config.timestamp = "now"
    config.steps_per_eval_image = 0
    config.pipeline.datamanager.sampled_poses = 5
    config.pipeline.datamanager.sampled_size = (32, 24)
    for group in config.optimizers.values():
        # to the same rate
        group["scheduler"] = ExponentialDecaySchedulerConfig()
        group["optimizer"].lr = 1e-3
    return config


def train(config, judged: bool = False) -> dict:
    """Losses, gradients of the last update, weights and, if asked for, the evaluation of a
    training, which is set up as by ``ns-train``."""
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    losses = losses_of(trainer)
    trainer.train()
    refiner = trainer.pipeline.model.refiner
    with mock.patch(
        "pointsplat_ns.metrics.lpips.cached_lpips", side_effect=LpipsUnavailable("not in this test")
    ):
        report = trainer.pipeline.get_average_eval_image_metrics() if judged else {"scenes": {}}
    return {
        "losses": losses,
        "gradients": {
            name: p.grad.clone() for name, p in refiner.named_parameters() if p.grad is not None
        },
        "weights": {name: p.detach().clone() for name, p in refiner.named_parameters()},
        "report": {name: block["refined"]["psnr"] for name, block in report["scenes"].items()},
        "skipped": dict(trainer.skipped),
        "files": sorted(
            p.name
            for p in config.get_base_dir().rglob("*")
            if p.is_file() and "events" not in p.name
        ),
    }


def saving(data: Path, output_dir: Path, steps: int):
    config = config_of(data, output_dir, steps)
    config.steps_per_save = 2
    config.save_only_latest_checkpoint = False
    return config


@contextmanager
def two_scenes_a_step() -> Iterator[None]:
    """Within, a step of one process takes the scenes of the two processes, and the mean of their
    losses."""
    one = PointSplatPipeline.get_train_loss_dict

    def both(self, step):
        parts = [one(self, place) for place in (2 * step, 2 * step + 1)]
        _, losses, metrics = zip(*parts, strict=True)
        means = {name: (losses[0][name] + losses[1][name]) / 2 for name in losses[0]}
        return {}, means, metrics[0]

    with mock.patch.object(PointSplatPipeline, "get_train_loss_dict", both):
        yield


def work(rank: int, folder: Path, port: str) -> None:
    place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2", "RANK": str(rank)}
    os.environ.update(place, LOCAL_RANK=str(rank), TORCHELASTIC_RUN_ID="as torchrun does")
    found = train(config_of(folder / "rooms", folder / f"out{rank}", UPDATES), judged=True)
    with broken("nan", BROKEN[0]), broken("gradient", BROKEN[1]):
        whole = train(saving(folder / "rooms", folder / f"skipping{rank}", 4))
        rest = saving(folder / "rooms", folder / f"rest{rank}", 1)
        rest.load_dir = folder / "skipping0/refiner/pointsplat/now/nerfstudio_models"
        rest.load_step = 2
        found["skipping"] = [whole, train(rest)]
    torch.save(found, folder / f"found{rank}.pt")


@pytest.fixture(scope="module")
def together(tmp_path_factory, quick):
    """What the two processes found, and what one process finds with two scenes an update."""
    folder = tmp_path_factory.mktemp("parallel")
    (folder / "rooms").mkdir()
    for seed, name in enumerate("abc"):
        write_ply(box_room(seed, 600, smooth=True), folder / "rooms" / f"{name}.ply")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
    pair = subprocess.Popen(
        [sys.executable, __file__, folder, port],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, (QUICK_START, REPOSITORY, QUICK_START.parent))),
        },
    )
    try:
        with two_scenes_a_step():
            alone = train(config_of(folder / "rooms", folder / "alone", UPDATES), judged=True)
        with broken("nan", BROKEN[0]), broken("gradient", BROKEN[1]), two_scenes_a_step():
            alone["skipping"] = train(saving(folder / "rooms", folder / "skipping", 4))
        text = pair.communicate(timeout=600)[0].decode()
    finally:
        pair.kill()
    assert pair.returncode == 0, text
    found = [torch.load(folder / f"found{rank}.pt") for rank in (0, 1)]
    assert text.count("rasterizer: ") == 3, "the first process alone says it, once a training"
    return found, alone


def differ(found: dict, wanted: dict) -> float:
    """The largest difference of tensors, as shares of the largest value of each: Adam's first steps
    have the size of the rate, whatever that of the gradient, so that rounding shows where a
    gradient is nearly nothing."""
    return max(
        float((found[name] - value).abs().max() / value.abs().max().clamp_min(1e-6))
        for name, value in wanted.items()
    )


def test_two_processes_train_as_one_with_twice_the_batch(together):
    found, alone = together
    means = [
        (ours + theirs) / 2
        for ours, theirs in zip(found[0]["losses"], found[1]["losses"], strict=True)
    ]
    assert means == pytest.approx(
        alone["losses"], rel=1e-5
    )  # float32 sums in another order, through two updates
    assert len(set(alone["losses"])) == UPDATES and len(alone["gradients"]) == len(alone["weights"])
    for key in ("gradients", "weights"):
        assert equal(found[0][key], found[1][key]) and differ(found[0][key], alone[key]) < 1e-3


def test_each_process_evaluates_its_share_and_the_first_alone_writes(together):
    found, alone = together
    assert found[0]["report"] == found[1]["report"] and list(found[0]["report"]) == ["a", "b", "c"]
    assert found[0]["report"] == pytest.approx(
        alone["report"], abs=1e-2
    )  # dB, of weights that differ by rounding
    assert found[0]["files"] == [
        "config.yml",
        "refiner.safetensors",
        f"step-{UPDATES - 1:09d}.ckpt",
        "training.csv",
        "training.png",
        "views.png",
    ]
    assert found[1]["files"] == []


def test_an_interrupted_training_ends_as_an_unbroken_one(together):
    for part in together[0]:
        whole, rest = part["skipping"]
        assert str(rest["losses"]) == str(whole["losses"][3:])
        assert equal(rest["weights"], whole["weights"])
    ours, theirs = (part["skipping"][0] for part in together[0])
    assert equal(ours["weights"], theirs["weights"])


def test_what_one_process_cannot_use_all_leave_out(together):
    found, alone = together
    for rank, part in enumerate(found):
        whole = part["skipping"][0]
        assert [value != value for value in whole["losses"]] == [False, rank == 1, False, False]
        assert sum(whole["skipped"].values()) == 2, "the one broken scene of each such step"
        assert differ(whole["weights"], alone["skipping"]["weights"]) < 1e-3
    assert found[0]["skipping"][0]["skipped"] == found[1]["skipping"][0]["skipped"]
    assert sum(alone["skipping"]["skipped"].values()) == 2


def test_several_processes_on_a_cpu_are_started_by_torchrun(tmp_path):
    config = config_of(tmp_path, tmp_path, 1)
    config.machine.num_devices = 2
    with pytest.raises(
        PointSplatError, match="torchrun --nproc-per-node 2 --no-python ns-train pointsplat"
    ):
        config.set_timestamp()
    with pytest.raises(SceneError, match="2 processes are asked for and 1 are connected"):
        config.pipeline.setup(device="cpu", test_mode="val", world_size=2)
    config.pipeline.model.norm = "batch"
    with (
        mock.patch("pointsplat_ns.system.processes.world_size", return_value=2),
        pytest.raises(SceneError, match="--pipeline.model.norm batch: .*expected scene where"),
    ):
        config.pipeline.setup(device="cpu", test_mode="val", world_size=2)


if __name__ == "__main__":
    child = os.fork()  # nothing has been computed, so there are no threads yet
    with quick_settings(), views_sampled_once():
        work(0 if child else 1, Path(sys.argv[1]), sys.argv[2])
    if child:
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
