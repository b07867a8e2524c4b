"""The scene that every program opens, the camera that they draw it from, and what tells whether
they draw it as it is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.judge.scenes import covered_psnr
from pointsplat_ns.geometry.transforms import axis_along
from pointsplat_ns.rendering import render_with_alpha
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.view_sampling.poses import look_at

SIZE = 256
"""Width and height of a picture, pixels. Square, because some viewers count the field of view
across and some along the height."""

GAUSSIANS = 2000
"""Few, because browsers draw without a GPU here."""

SH_DEVIATION = 0.15
"""Standard deviation of the SH coefficients of degree 2 and 3. Without degree 3 the picture has
24 dB, with the signs of every second coefficient changed 19 dB: below :data:`SAME`."""

SAME = 26.0
"""PSNR, dB, from which on a picture shows the same. A lost band of SH stays below. three.js, which
cuts Gaussians at two standard deviations, stays above by 1 dB."""

FIELD_OF_VIEW = 50.0
"""Degrees, across and along the height."""

NEAR = 0.2
"""Near plane, metres."""


def subject() -> ps.Gaussians:
    """The room that ships, without its ceiling and the upper half of its walls, with SH of degree
    3. It declares z as up."""
    room = ps.example_room()
    room = ps.prune(room[room.means[:, 2] < 1.5], keep=str(GAUSSIANS))
    generator = torch.Generator().manual_seed(5)
    rest = torch.zeros(len(room), 15, 3, **FLOATS)
    rest[:, :3] = room.features_rest[:, :3]
    rest[:, 3:] = SH_DEVIATION * torch.randn(len(room), 12, 3, generator=generator)
    middle = torch.tensor([0.0, 0.0, 0.5], **FLOATS)
    return room.replace(means=room.means - middle, features_rest=rest, up="z")


@dataclass(frozen=True)
class Camera:
    """Where a viewer's camera stands, in the viewer's world."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]

    def as_json(self) -> dict[str, Any]:
        """What pages are told; the field of view in degrees, lengths in metres."""
        return {**vars(self), "fov": FIELD_OF_VIEW, "near": NEAR, "far": 100.0}


CAMERAS = {
    "y": Camera((3.2, 5.2, 4.4), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "z": Camera((3.2, -4.4, 5.2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""The same camera for worlds in which y is up, and in which z is."""


def view_of(camera: Camera, turn: Tensor) -> ps.View:
    """The view of a camera on a scene that a program turns by a rotation (3, 3)."""
    position, target, up = (
        torch.tensor(values, **FLOATS) for values in (camera.position, camera.target, camera.up)
    )
    viewmat = look_at(position[None], target[None], up)[0]
    turned = torch.eye(4, **FLOATS)
    turned[:3, :3] = turn
    focal = 0.5 * SIZE / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]], **FLOATS)
    black = torch.zeros(3, **FLOATS)
    return ps.View(viewmat @ turned, K, SIZE, SIZE, black, near_plane=NEAR)


def render_from(scene: ps.Gaussians, camera: Camera) -> Tensor:
    """The picture (H, W, 3) of a scene that nothing turns."""
    return ps.render(scene, view_of(camera, torch.eye(3, **FLOATS)))


def turns() -> Iterator[Tensor]:
    """The 24 rotations (3, 3) that take axes to axes; first the one that turns nothing."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = torch.diag(torch.tensor(signs, **FLOATS))[:, list(order)]
            if float(torch.linalg.det(turn)) > 0:
                yield turn


@dataclass(frozen=True)
class Verdict:
    """How a picture compares with ours."""

    psnr: float
    """Over the pixels that the scene covers, dB, at the turn that fits best."""
    axes: tuple[str, str, str]
    """The axes of the scene that lie along x, y and z of the program's world."""
    next_psnr: float
    """At the turn that fits second best, dB."""


def compare(picture: Tensor, scene: ps.Gaussians, camera: Camera) -> Verdict:
    """Find the turn by which a program drew a scene.

    Args:
        picture: (H, W, 3) in [0, 1], of the program.
        scene: the file as this package reads it.
        camera: what the program was told.
    """
    found = []
    for turn in turns():
        image, alpha = render_with_alpha(scene, view_of(camera, turn))
        covered = float((alpha > 0.01).double().mean())
        if covered > 0:
            axes = tuple(str(axis_along(row)) for row in turn)
            found.append((covered_psnr(picture, image, covered), axes))
    (psnr, axes), (next_psnr, _), *_ = sorted(found, reverse=True)
    return Verdict(psnr, axes, next_psnr)
