"""Rooms, and rays through them."""

import errno
import functools
import json
import logging
import os
from unittest import mock

import numpy as np
import pytest
import torch
from PIL import Image

from lab.rooms import capture_path, default_intrinsics, light, make_room, render_room, write_room
from lab.rooms.raycast import Solids, trace
from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica, read_depth, read_photo

pytestmark = pytest.mark.xdist_group(
    "rooms"
)  # one worker computes the light of each room for all tests of this file

room_of = functools.cache(make_room)
"""The room of a seed. Its light, which takes seconds, is computed once for all tests here."""


@pytest.fixture(scope="module", autouse=True)
def coarser_light():
    """Light of a tenth of the numbers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            light, "LIGHT", light.LightSettings(4 * light.LIGHT.texel, 2 * light.LIGHT.lumel)
        )
        yield


def test_a_seed_gives_the_same_room_path_and_picture_and_another_another():
    rooms = room_of(3), make_room(3)
    assert torch.equal(*(room.solids.center for room in rooms))
    assert torch.equal(*(capture_path(room, 40, 3) for room in rooms))
    pose = capture_path(rooms[0], 40, 3)[5]
    pictures = [render_room(room, pose, default_intrinsics(96, 72), 96, 72) for room in rooms]
    assert all(torch.equal(one, other) for one, other in zip(*pictures, strict=True))
    assert room_of(1).size != rooms[0].size


def clearance(room, points):
    """Distance in metres from points (M, 3) to the nearest wall or furniture's bounding box:
    (M,)."""
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
        assert (
            float(turns.max()) < 30
        )  # of the 78 degrees of view: neighbours overlap by more than half
        assert float(poses[:, 2, 3].max() - poses[:, 2, 3].min()) > 0.25


def test_a_written_room_reads_back_as_a_replica_scene_without_a_warning(
    tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr("lab.rooms.write.make_room", room_of)
    written = write_room(tmp_path / "room1", seed=1, frames=6, width=64, height=48, progress=False)
    with caplog.at_level(logging.WARNING):
        scene = load_replica(written)
    assert not caplog.records
    assert len(scene) == 6 and scene.depths is not None
    assert scene.params.principal_point == (32.0, 24.0)
    assert {p.name for p in written.iterdir()} == {"results", "traj.txt", "cam_params.json"}
    room = room_of(1)
    camera = json.loads((written / "cam_params.json").read_text())["camera"]
    assert (camera["cx"], camera["cy"], camera["scale"]) == (
        31.5,
        23.5,
        6553.5,
    )  # Replica's own convention
    expected = capture_path(room, 6, 1)
    assert np.allclose(
        scene.poses, expected.numpy(), atol=1e-6
    )  # nine digits, then made orthonormal
    rgb, depth = render_room(room, expected[2], default_intrinsics(64, 48), 64, 48)
    assert np.abs(read_depth(scene.depths[2], scene.params) - depth.numpy()).max() < 1.01 / 6553.5
    assert (
        np.abs(read_photo(scene.photos[2], scene.params) / 255.0 - rgb.numpy()).mean() < 0.012
    )  # JPEG at 97


def test_writing_that_fails_leaves_nothing_behind_and_keeps_what_is_there(
    tmp_path, coarse_rooms, monkeypatch
):
    target = tmp_path / "room"
    target.mkdir()
    (target / "mine.txt").write_text("kept")
    with pytest.raises(DataError, match="not an empty folder"):
        write_room(target, 0, 2, 16, 12, progress=False)
    assert (target / "mine.txt").read_text() == "kept"

    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(Image.Image, "save", mock.Mock(side_effect=full))
    with pytest.raises(DataError, match="other: cannot be written .No space left on device."):
        write_room(tmp_path / "other", 0, 2, 16, 12, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["room"]


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "expected"),
    [
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (1, 0, 0), 2.5),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), False), (-2, 0, 1), (2, 0, 0), 1.25),
        (((1.0, 0, 1), (0.5, 0.5, 0.5), True), (-2, 0.3, 1), (1, 0, 0), 3 - 0.4),
        (((1.0, 0, 1), (0.5, 0.2, 0.8), True), (1, 0, 2.5), (0, 0, -1), 0.7),
        (
            ((1.0, 0, 1), (0.5, 0.5, 0.4), False),
            (-2, 0, 1.5),
            (1, 0, 0),
            5.0,
        ),  # passes above, meets the wall
        (
            ((1.0, 0, 1), (0.5, 0.5, 0.4), True),
            (-2, 0.49, 1.3),
            (1, 0, 0),
            5.0,
        ),  # within the ellipsoid's box only
    ],
)
def test_first_hit_equals_the_analytic_distance(solid, origin, direction, expected):
    center, half, round = zip(
        ((0, 0, 1.5), (3, 3, 1.5), False), solid, strict=True
    )  # in a room of 6 x 6 x 3
    solids = Solids(*map(torch.tensor, (center, half, round)), torch.ones(2, dtype=torch.bool))
    t, index = trace(
        solids, *(torch.tensor(given).float()[:, None] for given in (origin, direction))
    )
    assert float(t) == pytest.approx(expected, abs=2e-6)  # float32 at distances of metres
    assert int(index) == (0 if expected == 5.0 else 1)
