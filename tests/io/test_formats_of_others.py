"""Files that splat-transform writes and reads, both ways.

It is a Node package; ``POINTSPLAT_SPLAT_TRANSFORM`` names the program where it is not on the path.
"""

from __future__ import annotations

import os
import shutil
import subprocess

import numpy as np
import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.spz import write_spz

PROGRAM = os.environ.get("POINTSPLAT_SPLAT_TRANSFORM") or shutil.which("splat-transform")

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="splat-transform is not on the path")

SEED = 3


def splat_transform(source, target):
    command = [PROGRAM, "-w", "-g", "cpu", str(source), str(target)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def assert_equal(ours, theirs):
    """Whether two readers of one file agree. Opacities differ where a byte is 0 or 255, by a quarter of a step; the
    other tolerance is float32 in another order."""
    assert len(ours) == len(theirs)
    for name, value in ours.items():
        other = getattr(theirs, name)
        if name == "opacities":
            assert float((ours.alphas - theirs.alphas).abs().max()) < 0.3 / 255
        elif name == "quats":
            unit = [torch.nn.functional.normalize(scene.quats.double(), dim=1) for scene in (ours, theirs)]
            assert float((unit[0] * unit[1]).sum(1).abs().min()) > 1 - 1e-4, name  # it reads .splat by steps of 1/255
        elif value.numel():
            assert float((value - other).abs().max()) < 2e-5, name


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.spz", "v4.spz", "a.sog", "folder/meta.json", "a.splat"])
def test_it_reads_what_we_write_as_we_do(tmp_path, name):
    path, back = tmp_path / name, tmp_path / "back.ply"
    scene = cloud(700, SEED, 3)
    if name == "v4.spz":
        write_spz(scene, path, version=4)
    else:
        ps.save(scene, path)
    splat_transform(path, back)
    assert_equal(ps.load(path), ps.load(back))


@pytest.mark.parametrize("name", ["a.compressed.ply", "a.spz", "a.sog"])
def test_we_read_what_it_writes_as_it_does_and_what_we_write_is_no_farther_off(tmp_path, name):
    scene, source, path, back = cloud(700, SEED, 3), tmp_path / "a.ply", tmp_path / name, tmp_path / "back.ply"
    ps.save(scene, source)
    splat_transform(source, path)
    splat_transform(path, back)
    theirs = ps.load(path)
    assert_equal(theirs, ps.load(back))
    ps.save(scene, tmp_path / f"our_{name}")
    ours = ps.load(tmp_path / f"our_{name}")
    order = format_to_write(path).order
    ordered = scene if order is None else scene[order(scene)]
    nearest = torch.cdist(scene.means, theirs.means).argmin(dim=1)
    for field in ("means", "scales", "opacities", "features_dc", "features_rest"):
        error = (getattr(ordered, field) - getattr(ours, field)).abs().double().mean()
        peer = (getattr(scene, field) - getattr(theirs[nearest], field)).abs().double().mean()
        # Codebooks are made in other ways: a tenth is what they differ by.
        assert float(error) <= 1.1 * float(peer) + 1e-7, field


def test_a_glb_of_it_holds_the_same_scene_half_a_turn_about_z(tmp_path):
    scene = cloud(50, SEED, 1)
    ps.save(scene, tmp_path / "a.ply")
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.glb")
    # It takes a PLY to have y down, and turns it so that y is up.
    turned = scene.replace(means=scene.means * torch.tensor([-1.0, -1.0, 1.0]))
    ps.save(turned, tmp_path / "ours.glb")
    found = []
    for name in ("ours", "theirs"):
        data = (tmp_path / f"{name}.glb").read_bytes()
        length = int.from_bytes(data[12:16], "little")
        found.append(np.frombuffer(data, "<f4", 150, 20 + length + 8))  # positions come first in both
    assert np.allclose(found[0], found[1], atol=1e-6)
