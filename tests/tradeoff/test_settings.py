"""What settings are called, and that their commands are ones that make them."""

import shlex
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import same_bits
from pointsplat_ns.cli import main
from pointsplat_ns.compression import repair
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking import view_source
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff.measuring import make
from pointsplat_ns.tradeoff.settings import REPAIRS, Naming, Setting, check_repairs, setting_of
from trades import point

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


def test_a_command_names_the_resolution_that_was_asked_for():
    naming = Naming(Path("room.ply"), "room", 400, 1, resolution=(96, 54))
    assert "--resolution 96x54" in naming.command(Setting(40, 1)) and "96" not in naming.key(Setting(40, 1))


def test_keys_differ_and_fit_into_names_of_files():
    naming = Naming(Path("room.ply"), "room", 100_000, 3)
    repairs = [Setting(10_000, 3, repair) for repair in REPAIRS]
    settings = [*repairs, Setting(10_000, 2), Setting(10_020, 3), Setting(10_000, 3, by="log-volume")]
    keys = [naming.key(setting) for setting in settings]
    assert len(set(keys)) == len(keys)
    assert all(character.isalnum() or character in "._-" for key in keys for character in key)


def test_a_point_knows_its_setting():
    assert [setting_of(point(setting, 30.0)) for setting in SETTINGS] == SETTINGS


def test_repairs_are_put_in_order_and_unknown_ones_refused():
    assert check_repairs(("quick", "none", "quick")) == ("none", "quick")
    with pytest.raises(PointSplatError, match="repairs are magic; expected some of none, refiner, quick, thorough"):
        check_repairs(("magic",))
    with pytest.raises(PointSplatError, match="repairs are empty"):
        check_repairs(())
