import pytest
import torch

from making import normal_scene
from pointsplat_ns.refiner.config import preset
from pointsplat_ns.refiner.encoder import ConcatEncoder, DualBranchEncoder
from pointsplat_ns.refiner.normalize import gaussian_features, unit_cube


def features(n: int = 30):
    scene = normal_scene(n)
    return gaussian_features(scene, unit_cube(scene.means), 15, torch.float32)


@pytest.mark.parametrize("unit_gate", [False, True])
def test_the_encoder_is_equations_4_to_6_written_out(unit_gate):
    torch.manual_seed(0)
    encoder = DualBranchEncoder(preset("full", unit_gate=unit_gate)).eval()
    f = features()
    f_p = torch.cat([f.positions, f.quats, f.scales], dim=1)
    f_a = torch.cat([f.opacities, f.features_dc, encoder.color(f.features_rest)], dim=1)
    assert (f_p.shape[1], f_a.shape[1]) == (10, 12)
    delta = encoder.position(f.positions)
    weight = (encoder.appearance(f_a) + delta).exp()
    weight = weight / weight.sum(dim=1, keepdim=True) * (32 if unit_gate else 1)
    expected = weight * (encoder.geometry(f_p) + delta)
    assert torch.allclose(encoder(f), expected, atol=1e-6)  # float32 softmax, values of order 1


def test_without_appearance_and_position_only_geometry_is_left():
    torch.manual_seed(0)
    f = features()
    f_p = torch.cat([f.positions, f.quats, f.scales], dim=1)
    plain = DualBranchEncoder(preset("tiny", use_appearance=False, use_position=False))
    assert torch.equal(plain(f), plain.geometry(f_p))
    placed = DualBranchEncoder(preset("tiny", use_appearance=False))
    assert torch.equal(placed(f), placed.geometry(f_p) + placed.position(f.positions))


def test_the_concatenating_baseline_holds_every_number_once():
    f = features()
    out = ConcatEncoder()(f)
    assert out.shape == (30, 59)
    parts = [f.positions, f.scales, f.quats, f.opacities, f.features_dc, f.features_rest]
    assert torch.equal(out, torch.cat(parts, dim=1))
