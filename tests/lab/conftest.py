"""A small scene that is judged."""

import json
from pathlib import Path

import pytest

from lab.judge import camera_paths
from making import box_room
from pointsplat_ns.io import write_ply

PATH = {
    "scene": "small",
    "about": "The walls of a room, from its middle.",
    "up": [0, 0, 1],
    "field_of_view": 60,
    "views": [{"eye": [0.2, 0.1, 0], "at": [2, 0, 0]}, {"eye": [0, 0, 0.3], "at": [0, 1.5, 0]}],
}


@pytest.fixture()
def small(tmp_path, monkeypatch) -> Path:
    """A room of 900 Gaussians with a path of two views."""
    monkeypatch.setattr(camera_paths, "FOLDER", tmp_path)
    (tmp_path / "small.json").write_text(json.dumps(PATH))
    write_ply(box_room(seed=3), tmp_path / "small.ply")
    return tmp_path / "small.ply"
