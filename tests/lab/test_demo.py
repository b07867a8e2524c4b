"""The demo: the scene that ships made small, then every command of the method once."""

import json
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from documented import start
from lab import demo as module
from making import ball, write_run
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.scene.ply import read_ply, write_ply

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture()
def small_example(tmp_path, monkeypatch):
    """A scene of a few hundred Gaussians in the place of the one that ships, and steps that take
    seconds."""
    write_ply(ball(400), tmp_path / "example.ply")
    monkeypatch.setattr("pointsplat_ns.api.EXAMPLE", tmp_path / "example.ply")
    few = module.DemoSettings(
        photos=12, size=(64, 48), walk=3.0, every=1, scene_steps=12, refiner_steps=3
    )
    monkeypatch.setattr(module, "DEMO", few)


@pytest.fixture()
def programs(monkeypatch) -> list[str]:
    """Programs that the demo ran. They run in this process: five others would import nerfstudio, 20
    seconds each."""
    ran: list[str] = []

    def run(about: str, words: list, log: Path) -> None:
        words = tuple(map(str, words))
        ran.append(" ".join(words[: 1 + (words[0] == "ns-train")]))
        with log.open("w") as stream, redirect_stdout(stream):
            start(words, monkeypatch)

    monkeypatch.setattr(module, "run", run)
    return ran


def test_the_demo_runs_every_command_once_and_starts_anew(
    small_example, programs, tmp_path, capfd, monkeypatch
):
    monkeypatch.setenv(
        "POINTSPLAT_LPIPS_WEIGHTS", str(tmp_path / "none")
    )  # no weights there, and no download
    output = tmp_path / "a demo"
    earlier = output / "scenes" / "room" / "splatfacto-cpu" / "demo"
    write_run(earlier, 5, 900)  # interrupted
    (output / "capture" / "demo" / "images").mkdir(parents=True)
    (output / "capture" / "mine.jpg").write_text("of the user")
    module.demo(output)
    assert programs == [
        "pointsplat",
        "ns-train splatfacto-cpu",
        "ns-train pointsplat",
        "ns-eval",
        "ns-export",
    ]
    assert [path.name for path in earlier.rglob("*.ckpt")] == ["step-000000011.ckpt"]
    assert (output / "capture" / "mine.jpg").read_text() == "of the user"
    assert len(read_ply(output / "example_compact.ply")) == 40
    assert (output / "example.png").stat().st_size > 10_000 and (output / "example.html").is_file()
    printed = (output / "logs" / "evaluate.txt").read_text()
    assert "compared with photos" in " ".join(printed.split()), "the table of ns-eval"
    results = json.loads((output / "evaluation.json").read_text())["results"]["scenes"]["room"]
    assert len(read_ply(output / "exported" / "splat.ply")) == results["refined"]["gaussians"]
    shown = [
        line.replace("│", " ").split()
        for line in capfd.readouterr().out.splitlines()
        if "│" in line
    ]
    assert [row[:-1] for row in shown if row[-1] == "photos"] == [
        [
            *first,
            variant,
            f"{row['gaussians']:,}",
            f"{row['megabytes']:.2f}",
            f"{row['psnr']:.1f}",
            "held-out",
        ]
        for variant, first in (("dense", ["trained", "scene"]), ("pruned", []), ("refined", []))
        for row in [results[variant]]
    ]


def test_a_command_that_fails_is_named_with_where_to_read_why(tmp_path, capfd):
    with pytest.raises(PointSplatError) as error:
        module.run(
            "Tell what is in a scene.",
            ["pointsplat", "info", tmp_path / "a b.ply"],
            tmp_path / "log.txt",
        )
    command = f"pointsplat info '{tmp_path / 'a b.ply'}'"
    where = f"what it said is above and in {tmp_path / 'log.txt'}"
    assert str(error.value) == f"{command}: ended with exit status 1; {where}"
    said = capfd.readouterr()
    assert said.out == f"\nTell what is in a scene.\n$ {command}\n" and "no such file" in said.err
