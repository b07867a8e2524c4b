"""Rooms, and rays through them."""

import errno
import functools
import json
import logging
import os

import numpy as np
import pytest
import torch
from PIL import Image

from lab.rooms import capture_path, default_intrinsics, light, make_room, render_room, write_room
from lab.rooms.raycast import Solids, trace
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth, read_photo

pytestmark = pytest.mark.xdist_group("rooms")  # one worker computes the light of each room for all tests of this file

WIDTH, HEIGHT = 96, 72

room_of = functools.cache(make_room)
"""The room of a seed. Its light, which takes seconds, is computed once for all tests here."""


@pytest.fixture(scope="module", autouse=True)
def coarser_light():
    """Light of a tenth of the numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(light, "LIGHT", light.LightSettings(4 * light.LIGHT.texel, 2 * light.LIGHT.lumel))
        yield


@pytest.fixture(scope="module")
def room():
    return room_of(3)


@pytest.fixture(scope="module")
def poses(room):
    return capture_path(room, 40, 3)


@pytest.fixture(scope="module")
def written(tmp_path_factory, coarser_light):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lab.rooms.write.make_room", room_of)
        return write_room(
            tmp_path_factory.mktemp("rooms") / "room1", seed=1, frames=6, width=64, height=48, progress=False
        )


def picture(room, pose):
    return render_room(room, pose, default_intrinsics(WIDTH, HEIGHT), WIDTH, HEIGHT)


def test_a_seed_gives_the_same_room_path_and_picture_and_another_seed_another(room, poses):
    again = make_room(3)
    assert torch.equal(again.solids.center, room.solids.center)
    assert torch.equal(capture_path(again, 40, 3), poses)
    first, second = picture(room, poses[5]), picture(again, poses[5])
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
    assert make_room(7).size != room.size


def clearance(room, points):
    """Distance in metres from points (M, 3) to the nearest wall or furniture's bounding box: (M,)."""
    solids = room.solids
    walls = (solids.half[0] - (points - solids.center[0]).abs()).amin(dim=-1)
    offset = (points[:, None] - solids.center[1:]).abs() - solids.half[1:]
    return torch.minimum(walls, offset.clamp(min=0).norm(dim=-1).amin(dim=-1))


def test_cameras_keep_clear_of_furniture_move_smoothly_and_look_level():
    for seed in range(8):
        room = make_room(seed)
        poses = capture_path(room, 80, seed)
        assert float(clearance(room, poses[:, :3, 3]).min()) >= 0.3, seed
        rotation = poses[:, :3, :3].double()
        assert torch.allclose(rotation.transpose(1, 2) @ rotation, torch.eye(3).double(), atol=1e-6)
        assert torch.all(torch.linalg.det(rotation) > 0)
        assert torch.all(poses[:, 2, 0].abs() < 1e-6)  # no roll
        steps = (poses[1:, :3, 3] - poses[:-1, :3, 3]).norm(dim=-1)
        assert float(steps.max()) < 0.45
        turns = (rotation[1:, :, 2] * rotation[:-1, :, 2]).sum(-1).clamp(-1, 1).arccos().rad2deg()
        assert float(turns.max()) < 30  # of the 78 degrees of view: neighbours overlap by more than half
        assert float(poses[:, 2, 3].max() - poses[:, 2, 3].min()) > 0.25


def test_a_written_room_reads_back_as_a_replica_scene_without_a_warning(written, caplog):
    with caplog.at_level(logging.WARNING):
        scene = load_replica(written)
    assert not caplog.records
    assert len(scene) == 6 and scene.depths is not None
    assert scene.params.principal_point == (32.0, 24.0)
    assert {p.name for p in written.iterdir()} == {"results", "traj.txt", "cam_params.json"}
    room = room_of(1)
    camera = json.loads((written / "cam_params.json").read_text())["camera"]
    assert (camera["cx"], camera["cy"], camera["scale"]) == (31.5, 23.5, 6553.5)  # Replica's own convention
    expected = capture_path(room, 6, 1)
    assert np.allclose(scene.poses, expected.numpy(), atol=1e-6)  # nine digits, then made orthonormal
    rgb, depth = render_room(room, expected[2], default_intrinsics(64, 48), 64, 48)
    assert np.abs(read_depth(scene.depths[2], scene.params) - depth.numpy()).max() < 1.01 / 6553.5
    assert np.abs(read_photo(scene.photos[2], scene.params) / 255.0 - rgb.numpy()).mean() < 0.012  # JPEG at 97


def test_writing_leaves_nothing_behind_when_it_fails_and_keeps_what_is_there(tmp_path, coarse_rooms, monkeypatch):
    target = tmp_path / "room"
    target.mkdir()
    (target / "mine.txt").write_text("kept")
    with pytest.raises(DataError, match="not an empty folder"):
        write_room(target, 0, 2, 16, 12, progress=False)
    assert (target / "mine.txt").read_text() == "kept"

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(DataError, match="other: cannot be written .No space left on device."):
        write_room(tmp_path / "other", 0, 2, 16, 12, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["room"]


def room_with(*rows):
    """A 6 x 6 x 3 room and the given (center, half, round)."""
    center, half, round = zip(((0, 0, 1.5), (3, 3, 1.5), False), *rows, strict=True)
    return Solids(
        torch.tensor(center), torch.tensor(half), torch.tensor(round), torch.ones(len(half), dtype=torch.bool)
    )


def ray(origin, direction):
    return torch.tensor(origin).float()[:, None], torch.tensor(direction).float()[:, None]


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "expected"),
    [
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (1, 0, 0), 2.5),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (2, 0, 0), 1.25),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), True), (-2, 0.3, 1), (1, 0, 0), 3 - 0.4),
        (((1.0, 0, 1), (0.5, 0.2, 0.8), True), (1, 0, 2.5), (0, 0, -1), 0.7),
        (((1.0, 0, 1), (0.5, 0.5, 0.4), False), (-2, 0, 1.5), (1, 0, 0), 5.0),  # passes above, meets the wall
        (((1.0, 0, 1), (0.5, 0.5, 0.4), True), (-2, 0.49, 1.3), (1, 0, 0), 5.0),  # within the ellipsoid's box only
    ],
)
def test_first_hit_equals_the_analytic_distance(solid, origin, direction, expected):
    t, index = trace(room_with(solid), *ray(origin, direction))
    assert float(t) == pytest.approx(expected, abs=2e-6)  # float32 at distances of metres
    assert int(index) == (0 if expected == 5.0 else 1)
