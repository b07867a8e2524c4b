"""The first moments of the program."""

import resource
import signal
import subprocess
import sys

import pytest

import pointsplat_ns as ps
from pointsplat_ns.cli import main

INTERRUPTED = """
import sys
class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == sys.argv[1]:
            raise KeyboardInterrupt  # as Ctrl-C does between any two instructions
sys.meta_path.insert(0, Interrupt())
for name in [name for name in sys.modules if name == sys.argv[1]]:
    del sys.modules[name]
from pointsplat_ns.start import program
sys.argv[1:] = ["info", "room.ply"]
program()
"""


@pytest.mark.parametrize("name", ["pointsplat_ns.cli", "tyro", "torch"])
def test_ctrl_c_while_the_program_is_imported_is_one_word(name, tmp_path):
    (tmp_path / "room.ply").touch()
    words = INTERRUPTED.replace("sys.argv[1]:", f"{name!r}:").replace("sys.argv[1]]", f"{name!r}]")
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, cwd=tmp_path
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_next_to_nothing_is_imported_before_ctrl_c_is_caught():
    code = (
        "import sys; before = {*sys.modules}; import pointsplat_ns.start; "
        "print(*sorted({*sys.modules} - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    light = {
        "signal",
        "enum",
        "types",
        "functools",
        "operator",
        "reprlib",
        "collections",
        "keyword",
    }
    light |= {"itertools", "__future__", "importlib", "warnings", "abc", "re", "typing"}
    named = {
        name for name in done.stdout.split() if name.partition(".")[0].lstrip("_") not in light
    }
    assert named - {"__future__"} == {"pointsplat_ns", "pointsplat_ns.start"}


def test_files_that_are_missing_are_all_named_before_torch_is_imported(tmp_path):
    alone = [
        *(f"{name} a.ply" for name in ("prune", "compact", "clean", "lod", "tradeoff")),
        "convert a.ply b.spz",
    ]
    alone += ["export a.ply -o b.ply"]
    both = ["info a.ply b.ply", "render a.ply b.ply", "view a.ply b.ply"]
    script = (
        "import sys\nclass NoTorch:\n    def find_spec(self, name, *_): assert name != 'torch'\n"
        "sys.meta_path.insert(0, NoTorch())\nfrom pointsplat_ns.cli import main\n"
        f"for words in {[*alone, *both]}:\n    try: main(words.split())\n    except SystemExit: "
        "pass"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path
    )
    expected = (
        "; expected a scene: a file of any format, a checkpoint, or a run (its folder or "
        "config.yml)"
    )
    said = [f"error: a.ply: no such file{expected}"] * len(alone)
    assert done.stderr.splitlines() == said + [
        f"error: a.ply, b.ply: no such files{expected}"
    ] * len(both)
    assert (done.returncode, done.stdout, [*tmp_path.iterdir()]) == (0, "", [])


def test_too_little_address_space_for_torch_is_one_line(tmp_path):
    """With a little more of it, the import of torch aborts the program."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (10**9, 10**9))

    words = [
        sys.executable,
        "-c",
        "from pointsplat_ns.start import program; program()",
        "info",
        "room.ply",
    ]
    (tmp_path / "room.ply").touch()
    done = subprocess.run(words, capture_output=True, text=True, preexec_fn=limit, cwd=tmp_path)
    assert (
        done.returncode == 1 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    )
    assert "; torch takes 4 GB of address space (ulimit -v)" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["prune", ""],
        ["compact", "", "--keep", "10%"],
        ["convert", "a.ply", ""],
        ["view", ""],
        ["lod", "a.ply", "-o", ""],
        ["prune", "a.ply", "--poses", ""],
    ],
)
def test_an_empty_path_is_not_the_current_folder(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2 and "parsing" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


SIGNALLED = """
import os, signal, sys, threading, time
from pointsplat_ns.start import program
number, seconds = int(sys.argv[1]), float(sys.argv[2])
sys.argv[1:] = ["info", "room.ply"]
threading.Thread(
    target=lambda: (time.sleep(seconds), os.kill(os.getpid(), number)), daemon=True
).start()
program()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_libraries_are_imported_ends_the_program_as_later(number, tmp_path):
    """Files of a thousand Gaussians and more, so that it is not over before the last signal."""
    ps.save(ps.example_room(), tmp_path / "room.ply")
    for seconds in (0.1, 0.3, 0.6):
        done = subprocess.run(
            [sys.executable, "-c", SIGNALLED, str(int(number)), str(seconds)],
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )
        said = "interrupted\n" if number == signal.SIGINT else ""
        assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", said), seconds


DURING_IMPORT = """
import os, signal, sys
class Signal:
    def find_spec(self, name, path, target=None):
        if name == "numpy.linalg":
            os.kill(os.getpid(), int(number))
sys.meta_path.insert(0, Signal())
number = sys.argv[1]
from pointsplat_ns.start import program
sys.argv[1:] = ["info", "room.ply"]
program()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_the_middle_of_an_import_waits_for_its_end(number, tmp_path):
    ps.save(ps.example_room()[::50], tmp_path / "room.ply")
    done = subprocess.run(
        [sys.executable, "-c", DURING_IMPORT, str(int(number))],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    said = "interrupted\n" if number == signal.SIGINT else ""
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", said)
