"""``convert`` of a folder of scenes: each is written in the format, with a table; and what is
refused."""

import csv
import json
from pathlib import Path

import pytest
from refusing import refusal, run

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.scene.formats import format_to_read

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture
def rooms(tmp_path, monkeypatch) -> Path:
    for seed, name in enumerate(("a.ply", "b.splat", "deep/c.ply")):
        ps.save(ball(60 + seed, seed=seed), tmp_path / "rooms" / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "rooms"


def test_every_scene_is_what_convert_makes_of_it(rooms, tmp_path, capsys):
    run("convert", rooms, "--to", ".spz", "--sh", "0", "--scale", "2")
    said = capsys.readouterr().out
    done = f"{tmp_path / 'rooms_spz'}: 3 of 3 scenes, and the table scenes.csv\n"
    assert said.endswith(f"older viewers need --spz-version 3\n{done}")
    for name in ("a.ply", "b.splat", "deep/c.ply"):
        made = tmp_path / "rooms_spz" / Path(name).with_suffix(".spz")
        run("convert", rooms / name, tmp_path / "one.spz", "--sh", "0", "--scale", "2", "--force")
        assert format_to_read(made).suffix == ".spz"
        assert made.read_bytes() == (tmp_path / "one.spz").read_bytes()
        assert json.loads(made.with_name(f"{made.name}.json").read_text())["after"] >= 60
    with (tmp_path / "rooms_spz" / "scenes.csv").open() as stream:
        rows = [*csv.DictReader(stream)]
    assert [(row["name"], row["before"], row["status"]) for row in rows] == [
        ("a", "60", "done"),
        ("b", "61", "done"),
        ("deep/c", "62", "done"),
    ]


def test_the_same_command_makes_what_is_missing_and_skips_the_rest(rooms, capsys):
    run("convert", rooms, "--to", "sog", "--json")
    capsys.readouterr()
    ps.save(ball(70), rooms / "d.ply")
    run("convert", rooms, "--to", "sog", "--json")
    found = json.loads(capsys.readouterr().out)["scenes"]
    assert [scene["status"] for scene in found] == [
        "done before",
        "done before",
        "done",
        "done before",
    ]
    assert "contains results of other options" in refusal(
        capsys, rooms, "convert", str(rooms), "--to", "sog", "--sh", "0"
    )


def test_a_scene_that_fails_does_not_end_the_rest_and_is_named(rooms, capsys):
    damaged = (rooms / "a.ply").read_bytes()
    (rooms / "a.ply").write_bytes(damaged[: len(damaged) // 2])
    with pytest.raises(SystemExit) as end:
        run("convert", rooms, "out", "--to", ".splat")
    said = capsys.readouterr()
    assert end.value.code == 1
    assert "1 of 3 scenes failed; run the same command to retry them" in said.err
    row = next(line for line in said.out.splitlines() if "a.ply" in line and "failed" in line)
    assert "truncated" in row
    assert sorted(path.name for path in Path("out").rglob("*.splat")) == ["b.splat", "c.splat"]
    (rooms / "a.ply").write_bytes(damaged)
    run("convert", rooms, "out", "--to", ".splat")
    assert Path("out/a.splat").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("convert rooms", "rooms: a folder of scenes; expected the format of the results, such as"),
        ("convert rooms --to .obj", "--to .obj: not a format to write; expected"),
        ("convert rooms rooms --to .spz", "contains the scenes themselves"),
        ("convert rooms/a.ply", "rooms/a.ply: expected the file to write behind it"),
        (
            "convert rooms/a.ply a.spz --to .spz",
            "a single scene; --to is for a folder",
        ),
        ("convert rooms/a.ply a.spz --jobs 2", "a single scene; --jobs is for a folder of scenes"),
        ("prune rooms", "pointsplat compact rooms --effort instant merges them all"),
        ("clean rooms", "for a folder of scenes: compact, convert and info accept one"),
        ("lod rooms", "for a folder of scenes: compact, convert and info accept one"),
    ],
)
def test_the_error_says_what_takes_a_folder(words, said, rooms, capsys):
    assert said in refusal(capsys, rooms, *words.split())
