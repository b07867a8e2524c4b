"""pointsplat tradeoff: that it does what measure_tradeoff does, and what it prints and refuses."""

import json
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import box_room
from pointsplat_ns.cli import main
from pointsplat_ns.compression import repair
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.tradeoff import measuring

FEW = ("--views", "2", "--repairs", "none")


@pytest.fixture(scope="module")
def views():
    return sample_views(box_room(0, 400), 3, 48, 36)


@pytest.fixture()
def ply(tmp_path, views, plain_page, no_lpips, monkeypatch) -> Path:
    """A room of 400 Gaussians, looked at from three views; repairs take two steps, and times are as counts are."""
    monkeypatch.setattr(view_source.Sampler, "views", lambda sampler, count, *_, **options: views[:count])
    monkeypatch.setattr(measuring, "_timed", lambda scene, view: 1e-5 * len(scene))
    monkeypatch.setitem(repair.STEPS, "quick", 2)
    ps.save(box_room(0, 400), tmp_path / "room.ply")
    return tmp_path / "room.ply"


def run(*args) -> None:
    main([str(a) for a in args])


@pytest.mark.parametrize("error", [KeyboardInterrupt, ps.SceneError])
def test_a_sweep_that_ends_before_its_first_point_leaves_nothing_of_its_own(error, ply, tmp_path, monkeypatch):
    def failing(*_):
        raise error("now")

    monkeypatch.setattr(measuring, "_timed", failing)
    for folder in (tmp_path / "new", tmp_path / "old"):
        (tmp_path / "old" / "pictures").mkdir(parents=True, exist_ok=True)
        (tmp_path / "old" / "pictures" / "mine.png").touch()
        with pytest.raises(error):
            ps.measure_tradeoff(ply, folder, keep=("10%",), views=2, repairs=("none",))
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "old").rglob("*")] == ["pictures", "mine.png"]


def test_a_quality_is_reached_and_what_is_cheaper_is_said(ply, tmp_path, capsys):
    run("tradeoff", ply, "-o", tmp_path / "found", "--target-db", "25", *FEW)
    said = " ".join(capsys.readouterr().out.split())
    content = json.loads((tmp_path / "found" / "tradeoff.json").read_text())
    [found] = [point for point in content["points"] if point["key"] == content["recommended"]]
    assert found["against_dense"]["psnr"] >= 25
    assert "scenes tried; the next cheaper," in said and "dB, less than 25 dB" in said
