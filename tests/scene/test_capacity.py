"""What formats hold: their constants are true, what does not fit is brought in or named, and what
fits is not."""

import dataclasses
import functools
import math

import pytest
import torch

import pointsplat_ns as ps
from making import cloud
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.rendering.spherical_harmonics import sh_basis
from pointsplat_ns.scene.formats import FORMATS
from pointsplat_ns.scene.formats.capacity import FLOAT, seen_colours, within_colours
from pointsplat_ns.scene.formats.coding import morton_order
from pointsplat_ns.scene.formats.splat import drawing_order
from pointsplat_ns.scene.formats.spz import CAPACITY, FARTHEST, fraction_bits

pytestmark = pytest.mark.usefixtures("quick")


@functools.cache
def room():
    return ps.example_room()[::6]


@functools.cache
def views():
    return ps.sample_views(room(), 2, seed=0, width=160, height=120)


def psnr_of_file(scene, path, unit=1.0):
    """PSNR in dB of what is read back of a scene whose unit is that of the room times ``unit``."""
    viewmats = views().viewmats.clone()
    viewmats[:, :3, 3] *= unit
    cameras = dataclasses.replace(views(), viewmats=viewmats, near_plane=views().near_plane * unit)
    ps.save(scene, path)
    with torch.no_grad():
        return float(ps.psnr(ps.render(ps.load(path), cameras), ps.render(scene, cameras)).mean())


def loss_text(caplog):
    found = [record.getMessage() for record in caplog.records if "lost in" in record.getMessage()]
    assert len(found) <= 1
    return found[0] if found else ""


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog"])
def test_a_usual_room_is_written_without_a_warning(tmp_path, caplog, suffix):
    assert psnr_of_file(room(), tmp_path / f"a{suffix}") > 44
    assert not caplog.records


def test_spz_has_more_bits_after_the_point_where_gaussians_are_small(tmp_path, caplog):
    assert (
        psnr_of_file(ps.place(room(), scale=0.02), tmp_path / "a.spz", 0.02) > 42
    )  # 34 dB with 12 bits
    assert not loss_text(caplog)
    assert fraction_bits(room()) == 12 and fraction_bits(ps.place(room(), scale=1 / 256)) > 15
    assert fraction_bits(ps.place(room(), scale=1e-6)) == 23


def test_spz_that_is_written_again_loses_no_position():
    for number in range(200):  # of some, rounded sizes would need one bit less
        scene = ps.place(cloud(40, number), scale=2.0 ** (-7 - number / 100))
        bits = fraction_bits(scene)
        read = scene.replace(
            means=(scene.means * 2**bits).round() / 2**bits,
            scales=(16 * (scene.scales + 10)).round() / 16 - 10,
        )
        again = fraction_bits(read)
        assert torch.equal((read.means * 2**again).round() / 2**again, read.means)


@pytest.mark.parametrize("unit", [1e-3, 1e-5])
def test_spz_names_sizes_that_it_cuts_and_the_format_that_keeps_them(tmp_path, caplog, unit):
    small = ps.place(room(), scale=unit)
    psnr_of_file(small, tmp_path / "a.spz", unit)
    text = loss_text(caplog)
    assert (
        "of the Gaussians are smaller than 4.5e-05 units and become larger" in text
        and ".sog keeps it" in text
    )
    assert ("positions are rounded" in text) == (unit == 1e-5)
    caplog.clear()
    assert psnr_of_file(small, tmp_path / "a.sog", unit) > 50
    assert not caplog.records


def test_spz_brings_a_handful_of_far_gaussians_in_and_counts_them(tmp_path, caplog):
    far = torch.tensor([[5e4, 0.0, 0.0], [0.0, -5e4, 0.0], [3e4, 3e4, 5e4]])
    floaters = room()[:3].replace(means=far, scales=torch.full((3, 3), math.log(300.0)))
    scene = ps.Gaussians.cat([room(), floaters])
    assert psnr_of_file(scene, tmp_path / "a.spz") > 44  # 38 dB where they stay
    assert (
        "Gaussians farther than 2048 units (3) are moved to that distance and shrunk"
        in loss_text(caplog)
    )
    back = ps.load(tmp_path / "a.spz")
    assert torch.equal(back[:-3].means, (room().means * 4096).round() / 4096)
    centre = room().means.median(dim=0).values
    for moved, at in zip(back[-3:].means, scene[-3:].means, strict=True):
        one, other = (torch.nn.functional.normalize(place - centre, dim=0) for place in (moved, at))
        assert float((one - other).abs().max()) < 1e-4  # in the same direction
        assert math.isclose(float(moved.abs().max()), FARTHEST / 4096, rel_tol=1e-5)
    angle = lambda of: of.stds[-3:, 0] / (of.means[-3:] - centre).norm(dim=1)  # noqa: E731
    assert torch.allclose(angle(back), angle(scene), rtol=1 / 30)  # half a step of log-scales


def with_dark(scene):
    """A scene of which a tenth has constant coefficients down to -20, and SH that give it its
    colour from one view."""
    generator = torch.Generator().manual_seed(0)
    dark = torch.rand(len(scene), generator=generator) < 0.1
    dc = torch.where(
        dark[:, None], -4 - 16 * torch.rand(len(scene), 3, generator=generator), scene.features_dc
    )
    eye = views().viewmats[0].double().inverse()[:3, 3].to(scene.means)
    basis = sh_basis(torch.nn.functional.normalize(scene.means - eye, dim=1), 3)[:, 1:, None]
    rest = torch.cat([scene.features_rest, torch.zeros(len(scene), 12, 3)], dim=1)
    rest += (
        basis
        / basis.square().sum(dim=1, keepdim=True)
        * (SH_C0 * (scene.features_dc - dc))[:, None]
    )
    return scene.replace(features_dc=dc, features_rest=rest)


def test_a_few_gaussians_smaller_than_the_step_of_positions_are_named(tmp_path, caplog):
    scene = room()
    few = torch.arange(len(scene)) < len(scene) // 100
    scene = scene.replace(
        scales=torch.where(few[:, None], torch.full_like(scene.scales, -9.5), scene.scales)
    )
    ps.save(scene, tmp_path / "a.spz")
    assert "of the Gaussians are rounded by more than their size" in loss_text(caplog)


def test_spz_lowers_base_and_sh_together_and_names_what_is_lost(tmp_path, caplog):
    scene = with_dark(room())
    after = psnr_of_file(scene, tmp_path / "a.spz")
    assert "of the Gaussians have colours out of range" in loss_text(caplog)
    cut = scene.replace(
        features_dc=scene.features_dc.clamp(CAPACITY.colours.low, CAPACITY.colours.high),
        features_rest=scene.features_rest.clamp(-1, 1),
    )
    with torch.no_grad():
        cut_apart = float(ps.psnr(ps.render(cut, views()), ps.render(scene, views())).mean())
    assert after > cut_apart + 6  # 12 dB in a whole room


def test_a_splat_names_sh_and_antialiasing_that_it_does_not_hold(tmp_path, caplog):
    ps.save(room().replace(antialiased=True), tmp_path / "a.splat")
    text = loss_text(caplog)
    assert "SH of degree 1 are dropped" in text and "the flag for antialiased training" in text
    assert text.endswith(".sog keeps it") and str(tmp_path / "a.splat") in text


def test_black_from_everywhere_rises_and_its_sh_stay():
    scene = cloud(50, 0, 3).replace(features_dc=torch.full((50, 3), -20.0))
    fitted = within_colours(scene, FLOAT, FLOAT)
    assert torch.equal(fitted.features_rest, scene.features_rest)
    assert float(fitted.features_dc.min()) > -8
    assert (
        float(seen_colours(fitted.features_dc, fitted.features_rest.transpose(1, 2)).max()) == 0.0
    )


# of sizes, constant and other SH coefficients, opacities and rotations; None: 256 numbers of their
# own
STEPS = {
    ".ply": (0.0, 0.0, 0.0, 0.0, 0.0),
    ".spz": (
        1 / 16,
        1 / (255 * 0.15),
        8 / 128,
        1 / 255,
        0.5**0.5 / 511,
    ),  # written with 5 bits of SH
    ".sog": (None, None, None, 1 / 255, 2**0.5 / 255),
    ".splat": (0.0, 1 / (255 * SH_C0), 0.0, 1 / 255, 1 / 128),
    ".glb": (0.0, 0.0, 0.0, 0.0, 0.0),
    ".gltf": (0.0, 0.0, 0.0, 0.0, 0.0),
}
STEPS[".spz.glb"] = STEPS[".spz"]


@pytest.mark.parametrize(("degree", "n"), [(0, 2), (1, 257), (2, 600), (3, 1)])
@pytest.mark.parametrize(
    "kind", [kind for kind in FORMATS if kind.write], ids=lambda kind: kind.suffix
)
def test_numbers_in_range_come_back_within_half_a_step(tmp_path, kind, degree, n):
    holds = kind.capacity
    k = (degree + 1) ** 2 - 1
    generator = torch.Generator().manual_seed(1)

    def numbers(span, low, high, *shape):
        low = max(span.low, low)
        high = min(span.high, high)
        values = low + (high - low) * torch.rand(*shape, generator=generator)
        values.view(-1)[0] = low
        values.view(-1)[-1] = high
        return values

    scene = ps.Gaussians(
        means=2 * torch.rand(n, 3, generator=generator),
        scales=numbers(holds.sizes, -12.0, 4.0, n, 3),
        quats=torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1),
        opacities=numbers(FLOAT, -6.0, 6.0, n, 1),
        features_dc=numbers(holds.colours, -3.0, 10.0, n, 3),
        features_rest=numbers(holds.sh, -6.0, 6.0, n, k, 3)
        if holds.sh and k
        else torch.zeros(n, 0, 3),
    )
    ps.save(scene, tmp_path / f"a{kind.suffix}")
    order = {".sog": morton_order, ".splat": drawing_order}.get(
        kind.suffix, lambda scene: slice(None)
    )
    before = scene[order(scene)]
    after = ps.load(tmp_path / f"a{kind.suffix}")
    assert after.sh_degree == (0 if holds.sh is None else degree)
    turns = torch.nn.functional.normalize(after.quats, dim=1)
    turns = turns * (turns * before.quats).sum(dim=1, keepdim=True).sign()
    pairs = [
        (before.scales, after.scales),
        (before.features_dc, after.features_dc),
        (before.features_rest, after.features_rest),
        (before.alphas, after.alphas),
        (before.quats, turns),
    ]
    for index, ((one, other), step) in enumerate(zip(pairs, STEPS[kind.suffix], strict=True)):
        if not other.numel() or (
            index == 2 and step is None and n > 500
        ):  # a palette has fewer entries than rows
            continue
        wide = float(one.max() - one.min()) / 128 if step is None else step
        # The largest component of a rotation follows from the others, each off by half a step.
        most = 0.5 * wide * (4 if index == 4 else 1) + 3e-6 * max(1.0, float(one.abs().max()))
        assert float((one - other).abs().max()) <= most, index
    steps = 0 if holds.position_steps is None else holds.position_steps(before)[:, None]
    assert bool(((before.means - after.means).abs() <= 0.51 * steps + 1e-6).all())
