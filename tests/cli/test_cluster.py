"""Folders and large scenes on a cluster of machines, here two processes of one."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusing import fails, refusal, run

import pointsplat_ns as ps
from dask_cluster import at_work, scheduler_in, wait_until, workers_in
from killing import where
from making import ball, normal_scene
from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline import prune_file
from pointsplat_ns.system import cluster as clusters
from pointsplat_ns.system.cluster import Cluster, LostWorkError, connected
from pointsplat_ns.system.workers import Workers
from pointsplat_ns.tools import folders

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[str]:
    """The scheduler file of a cluster of two workers."""
    folder = tmp_path_factory.mktemp("cluster")
    with scheduler_in(folder) as (file, _), workers_in(folder):
        with distributed.Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=1800)
        yield str(file)


@contextmanager
def meanwhile(act: Callable[[], None]) -> Iterator[None]:
    """Something else that happens beside the work. Its errors are raised after it."""
    with ThreadPoolExecutor(1) as thread:
        done = thread.submit(act)
        yield
        done.result()


@contextmanager
def a_worker_killed(cluster: str, when: Callable[[], object]) -> Iterator[None]:
    """Kill a worker that is at work beside the work of the context."""
    with distributed.Client(scheduler_file=cluster, set_as_default=False) as client:
        pids = client.run(os.getpid)

        def kill() -> None:
            busy: list[str] = []
            wait_until(
                lambda: (
                    when() and busy.extend(w for w, t in client.processing().items() if t) or busy
                )
            )
            os.kill(pids[busy[0]], signal.SIGKILL)

        with meanwhile(kill):
            yield


OPTIONS = ("--keep", "50%", "--effort", "instant")


@pytest.fixture()
def rooms(tmp_path, monkeypatch) -> Path:
    """The current folder, with a folder of scenes, named without a path as people do."""
    add_rooms(tmp_path, range(4))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def add_rooms(folder: Path, numbers: range) -> None:
    """Small scenes, named by their numbers, in the folder's `rooms`."""
    for seed in numbers:
        scene = ball(100 + seed, seed=seed, log_size=-1.0, opacity=1.0, bright=1.0)
        ps.save(scene, folder / "rooms" / f"room{seed}.ply")


def test_scenes_are_those_of_processes_although_a_worker_is_killed(rooms, cluster, capsys):
    run("compact", "rooms", *OPTIONS, "-o", "shared", "--jobs", 2)
    with a_worker_killed(cluster, when=lambda: True):
        run("compact", "rooms", *OPTIONS, "-o", "spread", "--cluster", cluster)
    said = capsys.readouterr()
    assert "is lost; others repeat its work" in said.err
    assert said.out.count("4 of 4 scenes, and the table scenes.csv") == 2
    names = {path.name for path in (rooms / "shared").iterdir()}
    assert {path.name for path in (rooms / "spread").iterdir()} == names and len(names) == 10
    for name in names:
        shared, spread = (rooms / folder / name for folder in ("shared", "spread"))
        if name != "scenes.csv" and not name.endswith(".ply.json"):
            assert shared.read_bytes() == spread.read_bytes(), name
        else:
            assert untimed(shared) == untimed(spread), name
    run("compact", "rooms", *OPTIONS, "-o", "spread", "--cluster", cluster)
    assert capsys.readouterr().out.count("done before") == 4


def untimed(path: Path) -> list[dict[str, object]]:
    """The rows of a record or table without durations and the folder of results."""
    text = path.read_text("utf-8")
    rows = [json.loads(text)] if path.suffix == ".json" else [*csv.DictReader(text.splitlines())]
    for row in rows:
        assert float(row.pop("seconds")) > 0
        assert row.pop("output").startswith(f"{path.parent.name}{os.sep}")
    return rows


def test_ctrl_c_cancels_what_is_queued(rooms, cluster, capsys):
    def interrupt() -> None:
        wait_until(lambda: [*(rooms / "small").glob("*.ply")])
        os.kill(os.getpid(), signal.SIGINT)

    count = 10  # many more than are done before the cancelling arrives, however slow the machine is
    add_rooms(rooms, range(4, count))
    with meanwhile(interrupt), pytest.raises(SystemExit) as end:
        run("compact", "rooms", *OPTIONS, "-o", "small", "--cluster", cluster)
    assert end.value.code == 130 and capsys.readouterr().err.endswith("interrupted\n")
    with distributed.Client(scheduler_file=cluster, set_as_default=False) as client:
        wait_until(lambda: not any(client.run(at_work).values()))
    begun = len([*(rooms / "small").glob("*.ply")])
    assert 1 <= begun < count, "the queue went on"
    run("compact", "rooms", *OPTIONS, "-o", "small", "--cluster", cluster)
    said = capsys.readouterr().out
    assert said.count("done before") == begun and f"{count} of {count} scenes" in said


def test_a_large_scene_is_that_of_processes_although_a_worker_is_killed(
    tmp_path, cluster, capsys, monkeypatch
):
    monkeypatch.setattr(prune_file, "MEMORY", prune_file.MemorySettings(base=0, least=100))
    monkeypatch.chdir(tmp_path)
    ps.save(normal_scene(600, degree=1, seed=3), "scene.ply")
    words = ("prune", "scene.ply", "--keep", "10%", "--memory", "50kB", "-o")
    run(*words, "shared.ply", "--jobs", 2)
    with a_worker_killed(cluster, when=lambda: [*Path(".spread.ply.cells").glob("round_1_*")]):
        run(*words, "spread.ply", "--cluster", cluster)
    said = capsys.readouterr()
    assert "is lost; others repeat its work" in said.err
    assert said.out.count("merged to 60 of 600 Gaussians") == 2
    assert Path("shared.ply").read_bytes() == Path("spread.ply").read_bytes()
    assert not [*tmp_path.glob(".*")]


def test_work_of_which_workers_die_is_named_and_the_rest_is_done(tmp_path, cluster):
    found = {}
    with connected(cluster) as machines, pytest.raises(LostWorkError) as error:
        for item, result in Workers(where, 1, machines, Path(__file__)).results([-0.1, 0.2, 0.3]):
            found[item] = result
    assert {*found} == {0.2, 0.3}
    assert [*error.value.reasons] == [-0.1]
    assert str(error.value).startswith("-0.1: 2 workers died of it, the last at tcp://127.0.0.1:")
    with connected(cluster) as machines, pytest.raises(DataError, match="too short"):
        [*Workers(where, 1, machines, Path(__file__)).results([0.0])]


def test_a_scene_of_which_workers_die_has_failed_and_others_are_done():
    tasks = [folders.Task(name, Path(f"{name}.ply"), Path(f"small/{name}.ply")) for name in "ab"]

    def results(items):
        yield items[0], items[0].result("done")
        raise LostWorkError({items[1]: "2 workers died of it"})

    found = [*folders._results(SimpleNamespace(results=results), tasks)]
    assert [(result.name, result.status, result.error) for _, result in found] == [
        ("a", "done", ""),
        ("b", "failed", "2 workers died of it"),
    ]


def test_a_scheduler_without_workers_is_told_and_its_end_is_one_line(tmp_path, caplog):
    """Also that no worker is left, and where there is news of none, nothing."""
    with scheduler_in(tmp_path) as (file, process), connected(str(file)) as machines:
        assert f"{file}: no worker yet; the work begins when one joins" in caplog.text
        with meanwhile(process.kill):
            fails(
                lambda: [*machines.results(abs, [1], tmp_path)],
                f"{file}: the scheduler ended, or the connection broke; run the same command",
            )
    caplog.clear()
    client = SimpleNamespace(nthreads=lambda: {"a": 1}, subscribe_topic=lambda *_: None)
    few = Cluster("there", client)
    few._notice((0.0, {"action": "add-worker", "worker": "b"}))
    few._notice((0.0, {"action": "remove-worker", "worker": "a", "processing-tasks": set()}))
    assert caplog.text == ""
    few._notice((0.0, {"action": "remove-worker", "worker": "b", "processing-tasks": {"x"}}))
    assert "worker b is lost; others repeat its work" in caplog.text
    assert "there: no worker is left; waiting for one" in caplog.text


def test_other_versions_and_folders_that_a_worker_does_not_see_are_refused(tmp_path, monkeypatch):
    call = clusters._Call(b"", clusters._versions(), tmp_path / "missing")
    fails(
        lambda: call(1), tmp_path / "missing", f"missing on {socket.gethostname()}", error=DataError
    )
    monkeypatch.setattr(ps, "__version__", "0.0.9")
    fails(lambda: call(1), "has pointsplat-ns 0.0.9 with torch", "expected", error=DataError)


@pytest.fixture()
def silent() -> Iterator[str]:
    """The address of a program that accepts connections and says nothing."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    "address",
    ["tcp://127.0.0.1:1", "silent", "nowhere", "tls://127.0.0.1:1", "foo://a:1", "a.json"],
)
def test_an_address_where_nobody_answers_is_one_line_before_anything_is_written(
    address, silent, rooms, monkeypatch, capsys
):
    monkeypatch.setattr(clusters, "CONNECT_SECONDS", 0.5)
    address = silent if address == "silent" else address
    said = refusal(capsys, rooms, "compact", "rooms", *OPTIONS, "--cluster", address)
    expected = "not a scheduler file" if address == "a.json" else "no dask scheduler answers within"
    assert said.startswith(f"error: {address}: {expected}")


def test_without_the_extra_one_line_says_how_to_install_it(rooms, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    said = refusal(capsys, rooms, "compact", "rooms", *OPTIONS, "--cluster", "tcp://127.0.0.1:1")
    assert said == (
        "error: --cluster needs distributed, which is not installed; install it with pip install "
        "'pointsplat-ns[cluster]'"
    )


@pytest.mark.parametrize(
    "words, said",
    [
        (("compact", "rooms", "--jobs", "2"), "jobs is 2; expected none with a cluster"),
        (("compact", "rooms/room1.ply"), "a single scene; --cluster is for a folder of scenes"),
        (("prune", "rooms/room1.ply"), "room1.ply: fits into memory; expected no --cluster"),
    ],
)
def test_a_cluster_is_refused_where_there_is_no_work_for_one(words, said, rooms, capsys):
    assert said in refusal(capsys, rooms, *words, "--cluster", "tcp://127.0.0.1:1")


def test_dask_is_imported_only_where_it_is_asked_for():
    code = (
        "import sys, pointsplat_ns.cli.compact, pointsplat_ns.cli.prune, pointsplat_ns.api, "
        "pointsplat_ns.tools.folders; print({'dask', 'distributed'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
