"""The messages on the page about troubleshooting are those that the package gives."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from documented import BLOCKS
from making import ball
from pointsplat_ns.cli import main

PAGE = "troubleshooting.md"
MESSAGES = [block.text for block in BLOCKS if block.page.name == PAGE and block.language == "text"]


def room() -> ps.Gaussians:
    return ball(4, opacity=1.0, bright=1.0)


def cut() -> None:
    Path("room.ply").write_bytes(Path("room.ply").read_bytes()[:-7])


def flat() -> None:
    data = Path("room.ply").read_bytes().replace(b"property float scale_2\n", b"property float unknown\n")
    Path("flat.ply").write_bytes(data)


def odd() -> None:
    """One position that is no number."""
    data = Path("room.ply").read_bytes()
    at = data.index(b"end_header\n") + len(b"end_header\n")
    Path("room.ply").write_bytes(data[:at] + torch.tensor([torch.nan]).numpy().tobytes() + data[at + 4 :])


TRIGGERS: dict[str, tuple[Callable[[], object], str]] = {
    "no such file; expected a scene": (lambda: Path("room.ply").unlink(), "info room.ply"),
    "truncated": (cut, "info room.ply"),
    "exists already": (lambda: Path("room_pruned.ply").touch(), "prune room.ply"),
    "cannot write a ksplat": (room, "convert room.ply room.ksplat"),
    "a folder without config.yml": (lambda: Path("rooms").mkdir(), "lod rooms"),
    "2D Gaussians": (flat, "info flat.ply"),
    "dropped 1 of 4": (odd, "convert room.ply other.ply"),
    "not a Splatfacto run": (room, "convert room.ply other.ply --original-frame"),
    "keep is 'half'": (room, "prune room.ply --keep half"),
    "did you mean": (lambda: ps.save(ps.example_room(), "room.ply"), "prune room.ply --keep 10"),
    "opacity weight": (room, "prune room.ply --opacity-weight 0.5"),
    "no method": (room, "prune room.ply --by magic"),
    "refiner weights": (room, "compact room.ply --refiner nothing.safetensors"),
}
"""By a part of each message: what is done to the folder of the test, and the command that then gives the message."""


def test_every_message_has_a_command_that_gives_it():
    assert [next(part for part in TRIGGERS if part in message) for message in MESSAGES] == [*TRIGGERS]


@pytest.mark.parametrize("part", TRIGGERS)
def test_a_message_is_given_in_these_words(part, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ps.save(room(), "room.ply")
    prepare, command = TRIGGERS[part]
    prepare()
    try:
        main(command.split())
    except SystemExit as end:
        assert end.code == 1
    [message] = [message for message in MESSAGES if part in message]
    said = re.sub(r"^error: ", "", capsys.readouterr().err, flags=re.MULTILINE)
    assert any(line.startswith(message) for line in said.splitlines()), said
