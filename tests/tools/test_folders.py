"""Folders of scenes: what is finished is skipped, what failed or was changed is not, and nothing
half-made stays."""

import csv
import json
from pathlib import Path
from unittest import mock

import pytest

import pointsplat_ns as ps
from making import ball
from pointsplat_ns.errors import SceneError
from pointsplat_ns.tools import folders

pytestmark = pytest.mark.usefixtures("quick")


@pytest.fixture()
def folder(tmp_path) -> Path:
    for seed, name in enumerate(("a", "b", "deep/c")):
        ps.save(ball(60, 0, seed), tmp_path / "scenes" / f"{name}.ply")
    return tmp_path / "scenes"


@pytest.fixture(autouse=True)
def made(monkeypatch) -> mock.Mock:
    """What makes scenes small, in this process."""
    counted = mock.Mock(wraps=folders.compact_scene)
    monkeypatch.setattr(folders, "compact_scene", counted)
    return counted


def settle(folder: Path, keep: str = "50%", **options) -> dict[str, ps.SceneResult]:
    small = folder.parent / "small"
    results = ps.compact_folder(
        folder, small, keep, by="opacity", effort="instant", resolution="32x24", **options
    )
    return {result.name: result for result in results}


def files(folder: Path) -> set[str]:
    small = folder.parent / "small"
    return {path.relative_to(small).as_posix() for path in small.rglob("*") if path.is_file()}


RESULTS = {f"{name}.ply{end}" for name in ("a", "b", "deep/c") for end in ("", ".json")}
ABOUT = {"pointsplat-scenes.json", "scenes.csv"}


def test_what_is_finished_is_not_made_again_and_what_is_not_is(folder, made):
    first = settle(folder)
    (
        folder.parent / "small" / "b.ply"
    ).unlink()  # as by a process killed before it renamed the result
    ps.save(ball(80, 0, 9), folder / "deep" / "c.ply", overwrite=True)
    second = settle(folder)
    statuses = {name: result.status for name, result in second.items()}
    assert statuses == {"a": "done before", "b": "done", "deep/c": "done"}
    assert [len(call.args[0]) for call in made.mock_calls] == [60, 60, 60, 60, 80]
    assert files(folder) == RESULTS | ABOUT
    assert second["a"].seconds == first["a"].seconds and second["a"].after == 30
    assert len(ps.load(second["deep/c"].output)) == 40


def test_other_options_need_another_folder_or_force(folder):
    settle(folder)
    with pytest.raises(
        SceneError, match=r"contains results of other options, see pointsplat-scenes.json.*--force"
    ):
        settle(folder, "10%")
    assert {result.status for result in settle(folder, "10%", force=True).values()} == {"done"}
    assert {result.status for result in settle(folder, "10%").values()} == {"done before"}


def test_a_damaged_record_or_description_is_never_believed(folder):
    settle(folder)
    record = folder.parent / "small" / "a.ply.json"
    wrong = json.dumps({**json.loads(record.read_text()), "before": "6"})
    for content in ("", "[]", '{"status": "done"}', "[" * 100_000, wrong):
        record.write_text(content)
        assert settle(folder)["a"].status == "failed", (
            "the result was taken for its own, or for nobody's"
        )
    (folder.parent / "small" / "pointsplat-scenes.json").write_bytes(b"{\xff}")
    with pytest.raises(SceneError, match=r"pointsplat-scenes.json: cannot be read"):
        settle(folder)


def test_an_interruption_ends_it_all_and_leaves_whole_files(folder, monkeypatch):
    interrupted = mock.Mock(side_effect=[mock.DEFAULT, KeyboardInterrupt], wraps=folders.read_back)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(folders, "read_back", interrupted)
        settle(folder)
    assert files(folder) == {"a.ply", "a.ply.json"} | ABOUT
    with (folder.parent / "small" / "scenes.csv").open(newline="") as stream:
        assert [row["status"] for row in csv.DictReader(stream)] == ["done", "open", "open"]
    assert [result.status for result in settle(folder).values()] == ["done before", "done", "done"]
    assert files(folder) == RESULTS | ABOUT


def test_a_scene_that_fails_stops_no_other_in_several_processes(folder):
    with (folder / "huge.splat").open("wb") as stream:
        stream.truncate(1 << 43)
    shares: list[float] = []
    results = settle(folder, jobs=2, progress=lambda _, share: shares.append(share))
    assert results["huge"].status == "failed" and "8796.1 GB of memory" in results["huge"].error
    assert {name for name, result in results.items() if result.status == "done"} == {
        "a",
        "b",
        "deep/c",
    }
    assert shares[0] == 0 and shares[-1] == 1 and shares == sorted(shares)


def test_what_the_folder_cannot_take_is_one_line(folder):
    (folder.parent / "small").write_text("a file")
    with pytest.raises(SceneError, match="small: is a file; expected the name of a folder"):
        settle(folder)


def test_links_among_the_tables_of_a_folder_are_not_written_through(folder):
    small = folder.parent / "small"
    diary = folder.parent / "diary.txt"
    diary.write_text("precious")
    small.mkdir()
    for name in ("scenes.csv", "a.ply.json"):
        (small / name).symlink_to(diary)
    assert settle(folder)["a"].status == "done" and diary.read_text() == "precious"
    assert not any(path.is_symlink() for path in small.iterdir())
