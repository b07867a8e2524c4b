"""pointsplat clean: what it writes and says."""

import json
from pathlib import Path

import pytest
from refusing import refusal, run

import pointsplat_ns as ps
from making import same_bits

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture()
def room(tmp_path) -> Path:
    scene = ps.example_room()[::50]
    scene.opacities[:5] = -20.0  # cannot be drawn
    ps.save(scene, tmp_path / "room.ply")
    return tmp_path / "room.ply"


def test_clean_writes_what_the_function_returns_and_a_picture(room, capsys):
    picture = room.with_name("gone.png")
    run("clean", room, "--strength", 1, "--picture", picture, "--resolution", "64x48")
    said = capsys.readouterr().out
    written = ps.load(room.with_name("room_clean.ply"))
    assert same_bits(written, ps.clean(room, 1.0, resolution="64x48"))
    removed = 1257 - len(written)
    all_of_them = "1,257"
    assert (
        5 <= removed < 1257
        and f"room_clean.ply: cleaned to {len(written):,} of {all_of_them} Gaussians" in said
    )
    assert (
        "float in front of the surfaces in 40 views" in said
        and "cluster" in said
        and " dB, SSIM " in said
    )
    assert (
        picture.read_bytes()[:4] == b"\x89PNG"
        and f"{picture}: the scene, the removed Gaussians and the result" in said
    )


def test_clean_in_json_and_of_a_clean_scene(room, capsys):
    output = room.with_name("same.spz")
    run("clean", room, "-o", output, "--strength", 0, "--resolution", "64x48", "--json")
    result = json.loads(capsys.readouterr().out)
    assert (
        result["gaussians_before"] == 1257
        and result["output"] == str(output)
        and result["picture"] is None
    )


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--strength", "2"), "strength 2.0: expected a number in [0, 1]"),
        (("--picture", "gone.jpg"), "expected a name that ends in .png"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(words, why, room, capsys):
    assert why in refusal(capsys, room.parent, "clean", room, *words)
