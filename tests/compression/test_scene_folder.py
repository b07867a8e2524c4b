"""Every scene of a folder: made once, also where processes are killed, and never over what is somebody else's."""

import csv
import functools
import json
import threading
from collections import Counter
from pathlib import Path

import pytest

from making import cloud, same
from pointsplat_ns.compression import scene_folder
from pointsplat_ns.compression.scene_folder import Command, Shard, run_on_folder
from pointsplat_ns.compression.scene_task import SceneTask
from pointsplat_ns.errors import SceneError
from pointsplat_ns.io import read_ply, write_ply
from pointsplat_ns.system import workers
from pointsplat_ns.system.claims import claim
from scene_work import halve


@pytest.fixture()
def folder(tmp_path) -> Path:
    """A folder of three scenes, one in a folder of its own."""
    for seed, name in enumerate(("a", "b", "deep/c")):
        write_ply(cloud(6, seed), tmp_path / "scenes" / f"{name}.ply")
    return tmp_path / "scenes"


@pytest.fixture(autouse=True)
def soon(monkeypatch) -> None:
    """What is put off waits for a moment only."""
    monkeypatch.setattr(workers, "RETRIES", workers.RetrySettings(later_seconds=0.05))


def command_in(place: Path, keep: str = "50%") -> Command:
    return Command("halve", functools.partial(halve, journal=place / "journal.txt"), {"keep": keep})


def settle(folder: Path, **options):
    """What becomes of the scenes, by name."""
    command = options.pop("command", command_in(folder.parent))
    results = run_on_folder(folder, folder.parent / "small", command, **options)
    return {result.name: result for result in results}


def made(folder: Path) -> Counter:
    """How often each scene was made."""
    return Counter((folder.parent / "journal.txt").read_text().split())


def files(folder: Path) -> set[str]:
    """Visible and hidden files among the results, but for the lock that stays."""
    small = folder.parent / "small"
    return {path.relative_to(small).as_posix() for path in small.rglob("*") if path.is_file()} - {".scenes.lock"}


def table(folder: Path) -> list[dict[str, str]]:
    with (folder.parent / "small" / "scenes.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


RESULTS = {f"{name}.ply{end}" for name in ("a", "b", "deep/c") for end in ("", ".json")}
ABOUT = {"pointsplat-scenes.json", "scenes.csv"}


def test_every_scene_has_a_result_a_record_and_a_row(folder):
    results = settle(folder)
    assert list(results) == ["a", "b", "deep/c"]
    assert files(folder) == RESULTS | ABOUT
    for result in results.values():
        assert (result.status, result.before, result.after, result.psnr) == ("done", 6, 3, 30.0)
        assert same(read_ply(result.output), read_ply(result.source)[::2])
        assert result.megabytes == Path(result.output).stat().st_size / 1e6
    rows = table(folder)
    assert [row["name"] for row in rows] == list(results)
    assert {(row["status"], row["before"], row["after"], row["psnr"]) for row in rows} == {("done", "6", "3", "30.0")}


def test_what_is_finished_is_not_made_again_and_what_is_not_is(folder):
    first = settle(folder)
    (folder.parent / "small" / "b.ply").unlink()  # as by a process killed before it renamed the result
    (folder.parent / "small" / ".b.ply.77.part").touch()
    (folder.parent / "small" / "..b.ply.77.part.77.part").touch()
    (folder.parent / "small" / ".b.ply.json.77.part").touch()
    of_another = folder.parent / "small" / ".b.ply.more.ply.77.part"  # being written just now
    of_another.touch()
    second = settle(folder)
    assert {name: result.status for name, result in second.items()} == {
        "a": "done before",
        "b": "done",
        "deep/c": "done before",
    }
    assert made(folder) == {"a": 1, "b": 2, "c": 1}
    assert of_another.exists()
    assert files(folder) == RESULTS | ABOUT | {of_another.name}
    assert second["a"].seconds == first["a"].seconds and second["a"].after == 3


def test_a_scene_that_has_changed_is_made_again(folder):
    settle(folder)
    write_ply(cloud(10, 9), folder / "a.ply")
    results = settle(folder)
    assert [result.status for result in results.values()] == ["done", "done before", "done before"]
    assert len(read_ply(results["a"].output)) == 5


@pytest.mark.parametrize("kind", ["of somebody else", "changed since"])
def test_a_file_that_is_not_its_own_result_is_replaced_by_force_alone(folder, kind):
    output = folder.parent / "small" / "a.ply"
    if kind == "changed since":
        settle(folder)
    write_ply(cloud(2), output)
    before = output.read_bytes()
    refused = settle(folder)["a"]
    assert refused.status == "failed" and "exists already" in refused.error and "--force" in refused.error
    assert output.read_bytes() == before
    assert settle(folder, force=True)["a"].status == "done"
    assert len(read_ply(output)) == 3


def test_other_options_need_another_folder_or_force(folder):
    settle(folder)
    other = command_in(folder.parent, keep="10%")
    with pytest.raises(SceneError, match=r"holds results of other options \(keep: 50%, now 10%\).*--force"):
        settle(folder, command=other)
    with pytest.raises(SceneError, match="holds results of the command halve"):
        settle(folder, command=Command("third", other.make, {}))
    assert {result.status for result in settle(folder, command=other, force=True).values()} == {"done"}
    assert {result.status for result in settle(folder, command=other).values()} == {"done before"}


def test_a_scene_that_fails_does_not_stop_the_others_and_is_tried_again(folder, caplog):
    write_ply(cloud(2), folder / "bad.ply")
    for _ in range(2):
        failed = settle(folder)["bad"]
        assert failed.status == "failed" and failed.error == f"{folder / 'bad.ply'}: is bad"
        assert caplog.messages.pop().startswith("bad failed: ")
    assert made(folder) == {"a": 1, "b": 1, "bad": 2, "c": 1}
    assert [row["error"] for row in table(folder) if row["status"] == "failed"] == [failed.error]


def test_a_scene_that_another_process_works_on_is_waited_for(folder):
    task = SceneTask("b", folder / "b.ply", folder.parent / "small" / "b.ply")
    with claim(task.lock) as claimed:
        assert claimed
        results: dict = {}
        thread = threading.Thread(target=lambda: results.update(settle(folder)))
        thread.start()
        while not (folder.parent / "journal.txt").exists() or sum(made(folder).values()) < 2:
            assert thread.is_alive()
        assert made(folder) == {"a": 1, "c": 1}
    thread.join(30)
    assert results["b"].status == "done" and made(folder) == {"a": 1, "b": 1, "c": 1}


def test_shards_are_disjoint_and_the_last_one_has_the_whole_table(folder):
    for seed in range(4):
        write_ply(cloud(4, seed), folder / f"more{seed}.ply")
    parts = [settle(folder, shard=Shard(index, 3)) for index in (1, 2, 3)]
    names = [name for part in parts for name in part]
    assert len(names) == len(set(names)) == 7 and set(made(folder).values()) == {1}
    assert {row["status"] for row in table(folder)} == {"done", "done before"}
    (folder.parent / "small" / "a.ply.json").unlink()
    settle(folder, shard=Shard(3, 3))
    assert [row["name"] for row in table(folder) if row["status"] == "open"] == ["a"]


def test_a_damaged_record_or_description_is_never_believed(folder):
    settle(folder)
    record = folder.parent / "small" / "a.ply.json"
    wrong = json.dumps({"status": "done", "error": "", "before": "6"})
    for content in ("", "[]", '{"status": "done"}', "[" * 100_000, wrong):
        record.write_text(content)
        assert settle(folder)["a"].status == "failed", "the result was taken for its own, or for nobody's"
    (folder.parent / "small" / "pointsplat-scenes.json").write_bytes(b"{\xff}")
    with pytest.raises(SceneError, match="pointsplat-scenes.json: damaged"):
        settle(folder)


def test_an_interruption_ends_it_all_and_leaves_whole_files(folder):
    def interrupted(path: Path):
        if path.stem == "b":
            raise KeyboardInterrupt
        return halve(path, folder.parent / "journal.txt")

    with pytest.raises(KeyboardInterrupt):
        settle(folder, command=Command("halve", interrupted, {"keep": "50%"}))
    assert made(folder) == {"a": 1}
    assert files(folder) == {"a.ply", "a.ply.json", ".b.ply.lock"} | ABOUT
    assert [row["status"] for row in table(folder)] == ["done", "open", "open"]
    assert [result.status for result in settle(folder).values()] == ["done before", "done", "done"]
    assert files(folder) == RESULTS | ABOUT


def test_processes_that_are_killed_lose_no_scene_and_make_none_twice(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "RETRIES", workers.RetrySettings(later_seconds=0.05, most_deaths=3))
    folder = tmp_path / "scenes"
    names = [f"fine{i}" for i in range(20)] + [f"killed{i}" for i in range(8)] + ["bad", "deadly"]
    for seed, name in enumerate(names):
        write_ply(cloud(4, seed), folder / f"{name}.ply")
    shares: list[float] = []
    results = settle(folder, jobs=3, progress=lambda _, share: shares.append(share))
    failed = {name for name, result in results.items() if result.status == "failed"}
    assert failed == {"bad", "deadly"} and set(results) == set(names)
    assert results["deadly"].error.endswith("the last was killed by signal 9")
    tries = {**{name: 1 for name in names}, **{name: 2 for name in names if "killed" in name}, "deadly": 3}
    assert made(folder) == tries
    done = [name for name in names if name not in failed]
    assert files(folder) - ABOUT == {
        *(f"{name}.ply{end}" for name in done for end in ("", ".json")),
        *("bad.ply.json", ".bad.ply.lock", "deadly.ply.json", ".deadly.ply.lock"),
    }
    assert all(len(read_ply(results[name].output)) == 2 for name in done)
    assert shares[0] == 0 and shares[-1] == 1 and shares == sorted(shares)
    assert len(table(folder)) == 30


def test_what_the_folder_cannot_take_is_one_line(folder, monkeypatch):
    (folder.parent / "small").write_text("a file")
    with pytest.raises(SceneError, match="small: is a file; expected the name of a folder"):
        settle(folder)
    (folder.parent / "small").unlink()

    def no_locks(*_, **__):
        raise OSError("its file system has no locks")

    monkeypatch.setattr(scene_folder, "claim", no_locks)
    with pytest.raises(SceneError, match="small: cannot be used .its file system has no locks"):
        settle(folder)
