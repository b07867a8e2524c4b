"""points.json: what is put in comes out, and what is not ours is refused."""

import dataclasses
import json
import math

import pytest

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.tradeoff import journal as journal_module
from pointsplat_ns.tradeoff.journal import Journal
from pointsplat_ns.tradeoff.settings import DENSE, Setting
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


def test_the_file_is_json_that_any_reader_takes(written):
    content = json.loads(
        (written / FOLDER_FILES.sweep_points).read_text(), parse_constant=lambda name: pytest.fail(name)
    )
    assert [values["key"] for values in content["points"]] == ["dense", "10pct_sh3_quick"]


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


@pytest.mark.parametrize("name, value", [("scene", "abd"), ("views", 11), ("machine", "another")])
def test_points_of_another_sweep_are_refused(written, name, value):
    with pytest.raises(
        SceneError, match=rf"{FOLDER_FILES.sweep_points}: its points are of another sweep \({name}: .*--force"
    ):
        Journal(written, {**OF, name: value})


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


def test_a_file_too_large_is_refused_before_it_is_read(written, monkeypatch):
    form = dataclasses.replace(journal_module.POINTS_FORM, most_bytes=100)
    monkeypatch.setattr(journal_module, "POINTS_FORM", form)
    with pytest.raises(SceneError, match="larger than 100 bytes"):
        Journal(written, OF)


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
