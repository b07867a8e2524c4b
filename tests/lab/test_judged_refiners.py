"""lab/judge/refiners.py: what refiners gain."""

import json
import statistics

import torch

import pointsplat_ns as ps
from lab.judge import refiners, scenes
from making import move_zero_layers
from pointsplat_ns.refiner import Refiner, preset, save_refiner


def test_a_refiner_gains_what_it_brings_closer_an_untrained_one_nothing(small, tmp_path):
    torch.manual_seed(0)
    about = {"by": "opacity", "keep": "0.5"}
    save_refiner(Refiner(preset("tiny")), tmp_path / "untrained.safetensors", about)
    save_refiner(move_zero_layers(Refiner(preset("tiny"))), tmp_path / "moved.safetensors", about)
    asked = tuple(f"{name}={tmp_path / name}.safetensors" for name in ("untrained", "moved"))
    options = {"keep": (0.5, 0.25), "by": ("opacity",), "width": 64, "views": 2}
    refiners.main((small,), asked, **options, json_path=tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    wanted = [(name, keep, 900 * keep) for keep in (0.5, 0.25) for name in ("untrained", "moved")]
    assert [(row["method"], row["keep"], row["count"]) for row in rows] == wanted
    assert rows[0]["psnr"] == rows[0]["pruned_psnr"] == rows[1]["pruned_psnr"] != rows[1]["psnr"]
    scene = scenes.load(small, (64,), 2)
    pruned = ps.prune(scene.dense, keep=0.5, by="opacity")
    [(_, _, expected)] = scenes.losses(scene, [pruned], None)
    assert rows[0]["pruned_psnr"] == expected["covered_psnr"]


def test_gains_are_means_over_scenes_and_their_spread_is_over_trainings():
    gains = {("a", 0): 1.0, ("a", 1): 2.0, ("b", 0): 3.0, ("b", 1): 6.0}  # dB, by scene and training
    common = {"method": "dual", "by": "paper", "keep": 0.1, "pruned_psnr": 20.0}
    rows = [common | {"scene": scene, "number": number, "psnr": 20 + g} for (scene, number), g in gains.items()]
    rows.append({**common, "scene": "a", "method": "concat", "number": 2, "psnr": 19.5})
    spread = f"{statistics.stdev([2.0, 4.0]):.2f}"
    assert refiners.lines(rows) == [
        ["dual", "paper", "10 %", "2", "+3.00", spread],
        ["concat", "paper", "10 %", "1", "-0.50", "-"],
    ]
