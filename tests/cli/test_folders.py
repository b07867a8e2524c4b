"""Commands on a folder of scenes: what they write and say, and what they refuse."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import psutil
import pytest
from compressed_plys import encode_compressed_ply
from PIL import Image
from refusing import refusal, run

import pointsplat_ns as ps
from html_parts import parts_of
from making import ball, same
from pointsplat_ns.scene.formats import format_like, format_to_read
from pointsplat_ns.tools import folders

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("folder") / "rooms"
    for seed in (1, 2):
        ps.save(
            ball(120 + seed, seed=seed, log_size=-1.0, opacity=1.0, bright=1.0),
            folder / f"room{seed}.ply",
        )
    return folder


OPTIONS = ("--keep", "50%", "--effort", "instant")


def test_every_scene_is_what_compact_makes_of_it_and_a_table_says_so(folder, capsys):
    run("compact", folder, *OPTIONS)
    said = capsys.readouterr().out
    small = folder.with_name("rooms_compact")
    for seed in (1, 2):
        result = ps.compact(folder / f"room{seed}.ply", "50%", effort="instant")
        assert same(ps.load(small / f"room{seed}.ply"), result.scene)
        row = next(line for line in said.splitlines() if f"room{seed}" in line)
        assert all(
            text in row
            for text in (f"{120 + seed}", f"{len(result.scene)}", f"{result.psnr:.1f}", "done")
        )
    assert said.endswith(f"{small}: 2 of 2 scenes, and the table scenes.csv\n")
    run("compact", folder, *OPTIONS, "--keep", "0.5")
    assert capsys.readouterr().out.count("done before") == 2


def test_results_have_the_formats_of_their_scenes(folder, tmp_path, capsys):
    scenes = tmp_path / "scenes"
    small = tmp_path / "small"
    scene = ps.load(folder / "room1.ply")
    for name in ("a.ply", "d.splat", "f.spz", "f.ply"):
        ps.save(scene, scenes / name)
    (scenes / "g.ply").write_bytes(encode_compressed_ply(scene))
    run("compact", scenes, "-o", small, *OPTIONS, "--json")
    results = json.loads(capsys.readouterr().out)["scenes"]
    written = {Path(result["source"]).name: Path(result["output"]).name for result in results}
    renamed = {"f.ply": "f_ply.ply", "f.spz": "f_spz.spz", "g.ply": "g.sog"}
    assert written == {"a.ply": "a.ply", "d.splat": "d.splat", **renamed}
    for result in results:
        path = Path(result["output"])
        assert (
            len(ps.load(path)) == result["after"] == 61
            and path.stat().st_size == result["megabytes"] * 1e6
        )
        assert format_to_read(path) is format_like(Path(result["source"])) is not None


@pytest.mark.parametrize(
    "words, said",
    [
        (
            ("compact", "rooms", "--poses", "a.json"),
            "--poses is for one scene; rooms is a folder of scenes",
        ),
        (("compact", "rooms", "-o", "rooms"), "rooms: contains the scenes themselves"),
        (("compact", "rooms/room1.ply", "--jobs", "2"), "a single scene; --jobs is for a folder"),
        (("compact", "empty"), "empty: no scene below it"),
        (("convert", "rooms", "out"), "expected the format of the results, such as --to .spz"),
        (("prune", "rooms"), "pointsplat compact rooms --effort instant merges them all"),
        (("info", "empty"), "empty: no scene below it"),
        (("lod", "rooms"), "for a folder of scenes: compact, convert and info accept one"),
        (("clean", "rooms"), "for a folder of scenes: compact, convert and info accept one"),
    ],
)
def test_what_does_not_fit_a_folder_is_refused_in_one_line(
    words, said, folder, tmp_path, monkeypatch, capsys
):
    (tmp_path / "rooms").symlink_to(folder)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert said in refusal(capsys, tmp_path, *words)


def test_a_gallery_shows_each_scene_before_and_after_or_why_not(
    folder, tmp_path, monkeypatch, capsys
):
    """Also after an interruption, from what is finished; the same command completes it."""
    scenes = tmp_path / "my scenes"
    page = tmp_path / "shown" / "all.html"
    sheet = tmp_path / "all.png"
    for name in ("a <b>.ply", "deep/c.spz", "later.ply"):
        ps.save(ps.load(folder / "room1.ply"), scenes / name)
    (scenes / "bad.ply").write_bytes((scenes / "later.ply").read_bytes()[:-9])
    words = (
        "compact",
        scenes,
        "-o",
        tmp_path / "small",
        *OPTIONS,
        "--html",
        page,
        "--picture",
        sheet,
    )
    compact_scene = folders.compact_scene

    def interrupted(dense, *given, **named):
        if (tmp_path / "small" / "deep" / "c.spz").exists():
            raise KeyboardInterrupt
        return compact_scene(dense, *given, **named)

    monkeypatch.setattr(folders, "compact_scene", interrupted)
    with pytest.raises(SystemExit) as end:
        run(*words)
    assert end.value.code == 130
    first = page.read_text("utf-8")
    assert (
        "2 of 4 scenes" in first
        and "not finished" in first
        and "later.ply" not in first.replace("later</h2>", "")
    )
    monkeypatch.setattr(folders, "compact_scene", compact_scene)
    with pytest.raises(SystemExit):
        run(*words)
    said = capsys.readouterr().out
    assert said.endswith(
        f"scenes.csv\n{page}: all scenes before and after\n{sheet}: all scenes before and after\n"
    )
    text = page.read_text("utf-8")
    parts = parts_of(page)
    assert "3 of 4 scenes" in text and "not finished" not in text and "bad.ply: truncated" in text
    links = [a["href"] for tag, a in parts.elements if tag == "a"]
    assert links == ["../small/a%20%3Cb%3E.ply", "../small/deep/c.spz", "../small/later.ply"]
    assert (
        all((page.parent / unquote(link)).is_file() for link in links)
        and "<h2>a &lt;b&gt;</h2>" in text
    )
    pictures = [a["src"] for tag, a in parts.elements if tag == "img"]
    assert len(pictures) == 3 and all(
        picture.startswith("data:image/webp;base64,") for picture in pictures
    )
    assert text.count("Before: 121 Gaussians, ") == 3 and text.count("After: 61 Gaussians, ") == 3
    with Image.open(sheet) as picture:
        assert picture.size == (1280, 1200)
        before, after = (
            np.asarray(picture.crop((x, 400, x + 640, 800)).resize((64, 40)), float)
            for x in (0, 640)
        )
    assert before.std() > 20 and 0 < abs(before - after).mean() < 60, (
        "the same view of another scene"
    )
    page.unlink()
    (tmp_path / "small" / "pointsplat-scenes.json").unlink()
    assert "all.png: exists already" in refusal(capsys, tmp_path, *words), (
        "it may be a picture of the user's"
    )


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background of a shell
from pointsplat_ns.cli import main
main(["compact", sys.argv[1], "-o", sys.argv[2], "--keep", "50%", "--seconds", "600", "--jobs", "2"])
"""


def test_ctrl_c_stops_all_processes_at_once_and_leaves_nothing_unfinished(folder, tmp_path):
    small = tmp_path / "small"
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(folder), str(small)],
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 300
    while (
        len(psutil.Process(process.pid).children()) < 3
    ):  # two, and multiprocessing's tracker of resources
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.05)
    small.mkdir(exist_ok=True)
    (small / ".room1.ply.1-a.part").touch()  # as if it were written just now
    children = psutil.Process(process.pid).children()
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130 and errors.endswith("interrupted\n"), errors
    psutil.wait_procs(children, 30)
    assert not any(child.is_running() for child in children), "a process is still at work"
    assert not list(small.rglob("*.part")) and not list(small.rglob("*.ply"))
