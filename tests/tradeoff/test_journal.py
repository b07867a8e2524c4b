"""The journal of a sweep, its machine and settings."""

import json
import math
import shlex
import threading
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import same_bits
from pointsplat_ns.cli import main
from pointsplat_ns.compression import repair
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff import machine
from pointsplat_ns.tradeoff.journal import Journal
from pointsplat_ns.tradeoff.machine import is_busy, one_at_a_time
from pointsplat_ns.tradeoff.measuring import make
from pointsplat_ns.tradeoff.settings import DENSE, REPAIRS, Naming, Setting, check_repairs
from trades import point

OF = {"scene": "abc", "views": 10}

POINT = point(Setting(10_000, 3, "quick"), 31.25, photos=27.5)


@pytest.fixture()
def written(tmp_path):
    """A folder with the points of a dense scene and a smaller one."""
    journal = Journal(tmp_path, OF)
    journal.add(point(Setting(100_000, 3, by=DENSE), math.inf))
    journal.add(POINT)
    return tmp_path


def test_points_are_read_back_as_they_were(written):
    again = Journal(written, OF)
    assert again.points == {Setting(10_000, 3, "quick"): POINT}
    assert again.dense == point(Setting(100_000, 3, by=DENSE), math.inf)


def test_a_point_is_on_disk_as_soon_as_it_is_added(written):
    journal = Journal(written, OF)
    journal.add(point(Setting(5000, 3), 28.0))
    assert len(Journal(written, OF).points) == 2


def test_a_point_that_cannot_be_written_leaves_those_that_were(written, monkeypatch):
    before = (written / FOLDER_FILES.sweep_points).read_bytes()

    def no_room(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", no_room)
    with pytest.raises(SceneError, match="No space left"):
        Journal(written, OF).add(point(Setting(5000, 3), 28.0))
    assert (written / FOLDER_FILES.sweep_points).read_bytes() == before
    assert [path.name for path in written.iterdir()] == [FOLDER_FILES.sweep_points]


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.pop("points"),
        lambda content: content.update(format="another"),
        lambda content: content.update(points=3),
        lambda content: content["points"].append(None),
        lambda content: content["points"][1].update(gaussians="many"),
        lambda content: content["points"][1].update(gaussians=True),
        lambda content: content["points"][1].update(gaussians=-1),
        lambda content: content["points"][1].update(frame_ms=None),
        lambda content: content["points"][1].update(frame_ms=math.nan),
        lambda content: content["points"][1].update(repair="magic"),
        lambda content: content["points"][1].update(by="magic"),
        lambda content: content["points"][1].update(against_dense=None),
        lambda content: content["points"][1]["against_photos"].update(ssim="good"),
        lambda content: content["points"][1].update(unknown=1),
        lambda content: content["points"][1].pop("key"),
    ],
)
def test_points_that_are_none_are_refused(written, change):
    content = json.loads((written / FOLDER_FILES.sweep_points).read_text())
    change(content)
    (written / FOLDER_FILES.sweep_points).write_text(json.dumps(content))
    with pytest.raises(SceneError, match=f"{FOLDER_FILES.sweep_points}: not the points of a sweep .*--force"):
        Journal(written, OF)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "[" * 100_000, "\x00\xff"])
def test_a_file_that_holds_something_else_is_refused(tmp_path, text):
    (tmp_path / FOLDER_FILES.sweep_points).write_text(text)
    with pytest.raises(SceneError, match="not the points of a sweep"):
        Journal(tmp_path, OF)


@pytest.mark.parametrize("version", [1, 2, "two", None, "x" * 1000])
def test_points_of_another_version_are_refused_in_one_line(written, version):
    """Those of version 1 were timed otherwise, and had other fields."""
    content = json.loads((written / FOLDER_FILES.sweep_points).read_text())
    content["version"] = version
    content["points"][1].pop("frame_ms")
    (written / FOLDER_FILES.sweep_points).write_text(json.dumps(content))
    with pytest.raises(
        SceneError,
        match="points.json: not the points of a sweep .of version .*, this program's are of 3.*--force",
    ) as e:
        Journal(written, OF)
    assert len(str(e.value).splitlines()) == 1 and len(str(e.value)) < 400


def test_a_second_measurement_waits_for_the_first_and_says_so():
    said, entered = [], threading.Event()

    def second() -> None:
        with one_at_a_time(lambda what, share: said.append(what)) as alone:
            assert alone
            entered.set()

    with one_at_a_time(lambda what, share: None):
        other = threading.Thread(target=second)
        other.start()
        assert not entered.wait(0.3)
        assert said == ["waiting for another measurement on this machine"]
    assert entered.wait(10)
    other.join()


def test_a_machine_is_busy_when_too_few_cores_are_left(monkeypatch):
    monkeypatch.setattr(machine, "cores", lambda: 4)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert [is_busy(others) for others in (0.0, 2.0, 2.3, 4.0)] == [False, False, True, True]


SETTINGS = [
    Setting(40, 1),
    Setting(41, 0),
    Setting(40, 1, "refiner"),
    Setting(40, 0, "quick", "paper"),
    Setting(40, 1, by="coverage"),
]


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: f"{setting.count} {setting.repair} {setting.by}")
def test_a_command_makes_the_scene_that_was_measured(setting, room, room_views, tmp_path, monkeypatch):
    """With a scene whose path has a space, and few and small views."""
    monkeypatch.setitem(repair.STEPS, "quick", 2)
    monkeypatch.setattr(view_source.Sampler, "views", lambda *args, **options: room_views)
    monkeypatch.chdir(tmp_path)
    path = Path("the room.ply")
    dense = ps.load(room)
    path.write_bytes(room.read_bytes())
    naming = Naming(path, "room", len(dense), dense.sh_degree)
    made = make(dense, setting, lambda: ViewSource(dense), lambda what, share: None)
    assert (len(made.scene), made.scene.sh_degree) == (setting.count, setting.sh_degree)
    program, *words = shlex.split(naming.command(setting))
    assert program == "pointsplat"
    main(words)
    assert same_bits(ps.load(f"room_{naming.key(setting)}.ply"), made.scene)
    assert Path(f"room_{naming.key(setting)}.ply").stat().st_size == setting.bytes


def test_keys_differ_and_fit_into_names_of_files():
    naming = Naming(Path("room.ply"), "room", 100_000, 3)
    repairs = [Setting(10_000, 3, repair) for repair in REPAIRS]
    settings = [*repairs, Setting(10_000, 2), Setting(10_020, 3), Setting(10_000, 3, by="log-volume")]
    keys = [naming.key(setting) for setting in settings]
    assert len(set(keys)) == len(keys)
    assert all(character.isalnum() or character in "._-" for key in keys for character in key)


def test_repairs_are_put_in_order_and_unknown_ones_refused():
    assert check_repairs(("quick", "none", "quick")) == ("none", "quick")
    with pytest.raises(PointSplatError, match="repairs are magic; expected some of none, refiner, quick, thorough"):
        check_repairs(("magic",))
    with pytest.raises(PointSplatError, match="repairs are empty"):
        check_repairs(())
