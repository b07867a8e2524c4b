"""The command that makes levels."""

from pathlib import Path

import pytest
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball


@pytest.fixture()
def ply(tmp_path) -> Path:
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), {}),
        (("--levels", "10%", "0.5", "20", "--sh", "0"), {"levels": [0.5, "10%", 20], "sh": "0"}),
        (("--levels", "0.01MB"), {"levels": ["0.01MB"]}),
    ],
)
def test_pointsplat_lod_writes_what_lod_gives_bit_for_bit(arguments, options, ply, tmp_path):
    run("lod", ply, *arguments, "-o", tmp_path / "by_command")
    ps.lod(ply, **options).save(tmp_path / "by_api")
    assert contents(tmp_path / "by_command") == contents(tmp_path / "by_api")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--levels", "50%", "200"), "levels 50% and 200 both mean 200 of 400 Gaussians"),
        (("--levels", "auto:35"), "level auto:35: expected a ratio"),
        (("-o", "levels.ply"), "levels.ply: levels are several files; expected the name of a folder"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line_and_writes_nothing(arguments, message, ply, tmp_path, capsys):
    assert message in refusal(capsys, tmp_path, "lod", ply, *arguments)
