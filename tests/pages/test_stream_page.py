"""The page beside a stream opens upright, from the view that shows most, whatever is up in the scene."""

import json
from pathlib import Path

import pytest
import torch

import pointsplat_ns as ps
from making import ball, normal_scene, same
from pointsplat_ns.cli import main
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.levels.stream import write_stream
from pointsplat_ns.looking.opening import opening_views
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.pages.stream_page import StreamPage, stream_page
from web_viewers import read_page, small_viewer, tarball

WORLD = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
"""The viewer turns what it loads by half a turn about z."""


@pytest.fixture(autouse=True)
def package(tmp_path_factory, monkeypatch) -> Path:
    """A package that is found without a network."""
    file = tmp_path_factory.mktemp("package") / "viewer.tgz"
    file.write_bytes(tarball())
    monkeypatch.setenv("POINTSPLAT_WEB_VIEWER", str(file))
    return file


def room() -> ps.Gaussians:
    return ps.example_room()[::40]


@pytest.mark.parametrize(
    ("up", "scale", "centre"), [("z", 1.0, 0.0), ("-y", 1e-4, 0.0), ("y", 1e4, 1e5), ("-x", 1.0, -1e3)]
)
def test_it_opens_upright_from_the_view_that_shows_most(up, scale, centre):
    offset = torch.full((3,), centre, dtype=torch.float64)
    scene = Similarity(torch.eye(3, dtype=torch.float64), scale, offset).apply(ps.place(room(), f"z:{up}"))
    page = stream_page(small_viewer(), scene, None, up_named(up), "a room")
    _, title, values = read_page(page.files["index.html"])
    settings = values["settings"]
    camera = settings["cameras"][0]["initial"]
    to_world = WORLD.diag() @ (torch.eye(3, dtype=torch.float64) if page.turn is None else page.turn.matrix)
    above = to_world @ up_named(up).direction
    assert torch.allclose(above, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-9), "viewers have y up"
    assert (page.turn is None) == (up == "-y")
    view = opening_views(scene, 1, up=up_named(up)).views[0]
    viewmat = view.viewmat.double()
    eye, ahead = -(viewmat[:3, :3].T @ viewmat[:3, 3]), viewmat[2, :3]
    position, target = (torch.tensor(camera[name], dtype=torch.float64) for name in ("position", "target"))
    size = float((scene.means.amax(0) - scene.means.amin(0)).norm())
    assert torch.allclose(position, to_world @ eye, atol=1e-4 * size)
    direction = (target - position) / (target - position).norm()
    assert torch.allclose(direction, to_world @ ahead, atol=1e-6)
    assert 0.01 * size < float((target - position).norm()) < 10 * size
    assert camera["fov"] == pytest.approx(2 * torch.tensor(960 / 2 / float(view.K[0, 0])).atan().rad2deg().item())
    assert title == "a room" and values["contentUrl"] == "./lod-meta.json"
    still = settings["animTracks"][0]["keyframes"]["values"]
    assert still == {"position": 2 * camera["position"], "target": 2 * camera["target"], "fov": 2 * [camera["fov"]]}


def test_up_that_is_a_guess_is_called_one():
    page = stream_page(small_viewer(), ball(200), None, None, "a")
    assert "(a guess; --up names another axis)" in page.note
    assert page.note.endswith("as viewers show it") == (page.turn is not None)


def levels() -> tuple[list[ps.Gaussians], list[torch.Tensor]]:
    return [normal_scene(60, seed=1), normal_scene(20, seed=2)], [torch.arange(60) % 20]


def quarter_turn() -> StreamPage:
    """A page of which z is up."""
    matrix = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    files = stream_page(small_viewer(), room(), None, up_named("z"), "a").files
    return StreamPage(Similarity(matrix, 1.0, torch.zeros(3, dtype=torch.float64)), files, "")


def test_the_stream_is_turned_with_its_page(tmp_path):
    page = quarter_turn()
    write_stream(tmp_path / "turned", *levels(), page=page)
    assert page.turn is not None
    scenes, parents = levels()
    write_stream(tmp_path / "plain", [page.turn.apply(level) for level in scenes], parents)
    assert same(ps.load(tmp_path / "turned"), ps.load(tmp_path / "plain"))
    names = ["LICENSE.supersplat-viewer.txt", "index.css", "index.html", "index.js", "lod-meta.json"]
    assert sorted(path.name for path in (tmp_path / "turned").iterdir() if path.is_file()) == names
    assert {name: (tmp_path / "turned" / name).read_bytes() for name in page.files} == page.files


def test_a_stream_that_fails_leaves_no_page(tmp_path, monkeypatch):
    monkeypatch.setattr("pointsplat_ns.io.formats.sog_stream.sog_parts", lambda *a, **b: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_stream(tmp_path, *levels(), page=quarter_turn())
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("options", "viewer", "words"),
    [
        (["--html"], None, "expected --stream with --html"),
        (["--stream", "--html"], b"no package", "POINTSPLAT_WEB_VIEWER names"),
        (["--stream", "--html"], tarball({"package/LICENSE": b""}), "has no file package/public/index.html"),
    ],
)
def test_it_fails_before_the_scene_is_read(options, viewer, words, package, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("pointsplat_ns.api.read_source", lambda *_: pytest.fail("it is read"))
    if viewer is not None:
        package.write_bytes(viewer)
    ps.save(ball(400), tmp_path / "room.ply")
    with pytest.raises(SystemExit):
        main(["lod", str(tmp_path / "room.ply"), *options])
    assert words in capsys.readouterr().err and not (tmp_path / "room_stream").exists()


def test_the_command_writes_the_page_and_says_how_to_look_at_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ps.save(ball(400, opacity=1.0, bright=1.0), tmp_path / "my room.ply")
    main(["lod", "my room.ply", "--stream", "--html", "--levels", "25%", "--up", "z"])
    said = capsys.readouterr().out
    assert "python -m http.server -d 'my room_stream'" in said and "the page: up is z, turned to -y" in said
    folder = Path("my room_stream")
    assert json.loads((folder / "lod-meta.json").read_text())["counts"] == [400, 100]
    assert read_page((folder / "index.html").read_bytes())[1] == "my room_stream"
    assert (folder / "index.js").read_bytes() == small_viewer()["index.js"]
    with pytest.raises(SystemExit):
        main(["lod", "my room.ply", "--stream", "--html"])
    assert "exists already" in capsys.readouterr().err
