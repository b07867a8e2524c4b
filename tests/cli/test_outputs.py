"""What commands are going to write: held from before the work, never lost to another process, never half there."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns import compacting
from pointsplat_ns.cli import main
from pointsplat_ns.io.outputs import claimed, claimed_folder

FILES = (
    "prune gone.ply -o OUT.ply",
    "prune gone.ply -o a.ply --plot OUT.png",
    "compact gone.ply -o OUT.spz",
    "compact gone.ply -o a.ply --picture OUT.png",
    "compact gone.ply --dry-run --html OUT.html",
    "convert gone.ply OUT.sog",
    "export gone -o OUT.splat",
    "info gone.ply --views OUT.png",
    "report gone.json --html OUT.html",
    "render gone.ply -o OUT.mp4",
    "make-feedback gone.ply -o OUT.safetensors",
)
FOLDERS = (
    "lod gone.ply -o OUT",
    "tradeoff gone.ply -o OUT",
    "tables gone.ply -o OUT",
    "render gone.ply -o OUT",
    "make-refiner -o OUT --rooms 0",
    "make-refiner -o a --weights OUT --rooms 0",
    "demo --output OUT --keep 7",
)
"""Commands that fail at their work, because there is no such scene, unless they find before that they cannot write."""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(capsys, words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(words.split())
    said = capsys.readouterr()
    assert end.value.code == 1, said
    return said.err


@pytest.mark.parametrize("words", (*FILES, *FOLDERS))
def test_two_processes_do_not_write_one_output(words, here, capsys):
    output = Path(next(word for word in words.split() if word.startswith("OUT")))
    with claimed(output) if words in FILES else claimed_folder(output):
        before = set(here.rglob("*"))
        said = refusal(capsys, words)
    assert said == f"error: {output}: another process is writing it; wait for it, or name another output\n"
    assert set(here.rglob("*")) <= before, "something was left"


@pytest.mark.parametrize("words", (*FILES, *FOLDERS))
def test_an_output_that_cannot_be_written_is_noticed_before_the_work(words, here, capsys):
    (here / "file").touch()
    said = refusal(capsys, words.replace("OUT", "file/OUT"))
    assert said.startswith("error: file/OUT") and "cannot be written (Not a directory)" in said
    assert [path.name for path in here.iterdir()] == ["file"]


@pytest.mark.parametrize("words", FILES)
def test_a_pipe_is_no_output_and_is_not_waited_for(words, capsys):
    [output] = [word for word in words.split() if word.startswith("OUT")]
    os.mkfifo(output)
    assert refusal(capsys, words) == f"error: {output}: not a regular file; expected the name of a file to write\n"
    assert Path(output).is_fifo()


def test_a_claim_ends_with_its_process_however_that_ends(here):
    script = "import sys, time; from pathlib import Path; from pointsplat_ns.io.outputs import claimed\n"
    script += "with claimed(Path('a/b.ply')):\n    print(flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline()
        with pytest.raises(ps.SceneError, match="a/b.ply: another process"), claimed(Path("a/b.ply")):
            pass
        process.send_signal(signal.SIGKILL)
    assert [path.name for path in (here / "a").iterdir()] == [".b.ply.lock"]
    with claimed(Path("a/b.ply")):
        Path("a/b.ply").touch()
    assert [path.name for path in (here / "a").iterdir()] == ["b.ply"]


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appears_during_the_work_is_replaced_by_force_alone(links, monkeypatch, capsys):
    ps.save(ball(40), "room.ply")
    prune = compacting.prune_source

    def meanwhile(*args, **options):
        Path("small.ply").write_text("of another program")
        return prune(*args, **options)

    def no_link(*_):
        raise PermissionError("no links here")

    monkeypatch.setattr(compacting, "prune_source", meanwhile)
    if not links:
        monkeypatch.setattr(os, "link", no_link)
    words = "prune room.ply --keep 50% --by opacity -o small.ply"
    assert "small.ply: cannot be written (another file of this name has appeared meanwhile)" in refusal(capsys, words)
    assert Path("small.ply").read_text() == "of another program"
    main([*words.split(), "--force"])
    assert len(ps.load("small.ply")) == 20
    Path("small.ply").unlink()
    monkeypatch.setattr(compacting, "prune_source", prune)
    main(words.split())
    assert len(ps.load("small.ply")) == 20
    assert sorted(path.name for path in Path.cwd().iterdir()) == ["room.ply", "small.ply"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("compact room.ply --effort instant --html page.html --html-limit 0.001", "page.html: the page would have"),
        ("compact room.ply --effort instant --picture shown.png", "shown.png: cannot be written (no reason)"),
        ("prune room.ply --by opacity --plot shown.png", "shown.png: cannot be written (no reason)"),
    ],
)
@pytest.mark.parametrize("dry", [False, True])
def test_an_error_after_the_scene_was_written_says_where_the_scene_is(dry, words, reason, monkeypatch, capsys):
    def failing(*_, **__):
        raise ps.SceneError("shown.png: cannot be written (no reason)")

    monkeypatch.setattr(ps, "plot_comparison", failing)
    monkeypatch.setattr(ps, "plot_distributions", failing)
    ps.save(ball(40, opacity=1.0, bright=1.0), "room.ply")
    said = refusal(capsys, words + " -o small.ply --keep 50%" + " --dry-run" * dry).splitlines()[-1]
    assert said.startswith(f"error: {reason}") and Path("small.ply").exists() != dry
    assert said.endswith("; the scene was written before, to small.ply") != dry
