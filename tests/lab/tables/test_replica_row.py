"""The row of Replica's frames: its commands are read by the programs, its page by people."""

import shlex
from pathlib import Path

import pytest

from documented import check_arguments
from lab.tables.replica_row import row, section, steps_of

FIGURES = {"gaussians": 1000, "megabytes": 0.25, "psnr": 30.0, "ssim": 0.9, "lpips": None}


@pytest.fixture()
def evaluation():
    variants = {name: dict(FIGURES, fps=3.0, gain=0.0) for name in ("dense", "pruned", "refined")}
    scene = {"seen_in_training": True, "views": 2, **variants, "reference": "photos"}
    return {"results": {"scenes": {"room0": scene}}}


def test_every_command_of_the_way_is_one_that_works(monkeypatch):
    steps = steps_of(Path("replica/room0"), Path("outputs/room0"), 700, 0.5, 120.0, "10%")
    assert [what for what, _ in steps] == [
        "train the scene",
        "train the refiner",
        "evaluate",
        "export",
    ]
    for _, command in steps:
        check_arguments(tuple(shlex.split(command)), monkeypatch)


def test_the_section_has_all_variants_and_says_that_it_is_of_one_room(evaluation):
    found = row(evaluation, "room0")
    assert [*found] == ["dense", "pruned", "refined"] and found["dense"] == FIGURES
    text = section(
        {
            "scene": "room0",
            "frames": 20,
            "trained": 18,
            "held_out": 2,
            "width": 1200,
            "height": 680,
            "scale": 0.5,
            "machine": "a machine",
            "refiner_steps": 20,
            "commands": ["ns-train splatfacto-cpu"],
            "cpu_seconds": {"export": 1.0},
            "row": found,
        }
    )
    assert text.startswith("## 20 frames of one room: Replica's room0")
    assert "| refined | 1,000 | 0.25 | 30.00 | 0.900 | - |" in text
    assert "takes 20 steps on the photos" in " ".join(text.split())
    assert (
        "18 frames train, 2 are held out" in " ".join(text.split())
        and "CPU time on a machine: export 1 s." in text
    )
