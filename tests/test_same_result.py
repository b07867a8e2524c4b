"""The same again, on one thread and on two: a seed gives the same selection, the same losses and the same bytes.

Without compiled kernels, two threads add up gradients in another order than one.
"""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch

import method_configs.methods  # noqa: F401  (as nerfstudio does: lets torch load Splatfacto's checkpoints)
import pointsplat_ns as ps
from making import box_room, fast_config, run_of, same_bits
from pointsplat_ns.pruning.methods import METHODS

FORMATS = ("ply", "spz", "sog", "splat")

STEPS = 50
"""Of splatfacto-cpu: densification, opacity reset and SH degrees are in them."""


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Within, torch computes on that many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def seeded() -> None:
    """What ns-train does before it starts."""
    random.seed(42)
    np.random.seed(42)
    torch.manual_seed(42)


@pytest.fixture(scope="module")
def room():
    return box_room(0, count=1500, size=0.1)  # too few for merging to choose its finish by renders


@pytest.fixture(scope="module")
def looks(room):
    return ps.sample_views(room, 3, width=48, height=36)


@pytest.mark.parametrize("by", METHODS)
def test_a_scene_is_made_small_to_the_same_bits_on_one_thread_and_on_two(by, room, looks):
    views = looks if METHODS[by].needs_views else None
    first = ps.prune(room, 0.3, by=by, views=views)
    assert same_bits(first, ps.prune(room, 0.3, by=by, views=views))
    with threads(2):
        assert same_bits(first, ps.prune(room, 0.3, by=by, views=views))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_has_the_same_bytes_again_on_one_thread_and_on_two(suffix, room, tmp_path):
    written = []
    for number, count in enumerate((1, 1, 2)):
        folder = tmp_path / str(number)  # a format may hold the name of its file
        folder.mkdir()
        with threads(count):
            ps.save(room, folder / f"room.{suffix}")
        written.append((folder / f"room.{suffix}").read_bytes())
    assert written[0] == written[1] == written[2] and len(written[0]) > 10_000


@pytest.fixture(scope="module")
def train(wall_scene, wall_config, run_training, tmp_path_factory):
    """A function that trains splatfacto-cpu on some threads, and gives its run and losses."""

    def trained(count: int):
        seeded()
        config = wall_config(wall_scene, tmp_path_factory.mktemp("same"), STEPS)
        config.experiment_name = "wall"
        with threads(count):
            trainer, losses = run_training(config)
        return run_of(config.output_dir, "wall"), losses

    return trained


@pytest.fixture(scope="module")
def first_training(train):
    return train(1)


def test_splatfacto_has_the_same_losses_and_exports_the_same_bytes_again(train, first_training, tmp_path):
    runs = (first_training, train(1))
    assert runs[0][1] == runs[1][1] and len(runs[0][1]) == STEPS, "to the bit"
    for number, (folder, _) in enumerate(runs):
        ps.save(ps.load(folder), tmp_path / f"{number}.ply")
    assert (tmp_path / "0.ply").read_bytes() == (tmp_path / "1.ply").read_bytes()
    assert runs[0][1][-1] < 0.8 * runs[0][1][0], "it learned something"


def test_a_refiner_has_the_same_losses_and_weights_again(trained_walls, run_training, tmp_path):
    runs = []
    for name in ("a", "b"):
        seeded()
        trainer, losses = run_training(fast_config(trained_walls, tmp_path / name, steps=6))
        weights = torch.cat([value.detach().flatten() for value in trainer.pipeline.model.refiner.parameters()])
        runs.append((losses, weights))
    assert runs[0][0] == runs[1][0] and torch.equal(runs[0][1], runs[1][1])
