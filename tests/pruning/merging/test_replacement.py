"""What pairs become: the same by the kernel and in torch."""

import dataclasses
import math

import pytest
import torch

from making import assert_same_on_any_threads, cloud
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.merging import MERGING
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.replacement import KERNELS, replace_pairs
from pointsplat_ns.pruning.merging.state import State, initial_state

needs_compiler = pytest.mark.skipif(bool(KERNELS.why_missing), reason=KERNELS.why_missing)


def state_of(scene: Gaussians) -> State:
    """The state before the first round, each Gaussian with another visibility weight."""
    n = len(scene)
    participants = Participants(scene, torch.arange(n), torch.zeros(3, dtype=torch.float64), 1.0)
    return initial_state(participants, torch.linspace(0.1, 1, n), MERGING)


def extremes(n: int, unit: float) -> Gaussians:
    """Needles, disks and balls, near each other and far apart, from nearly transparent to opaque."""
    g = torch.Generator().manual_seed(3)
    return Gaussians(
        means=unit * torch.randn(n, 3, generator=g) * 10 ** torch.empty(n, 1).uniform_(-3, 1, generator=g),
        scales=math.log(unit) + torch.empty(n, 3).uniform_(-4, 4, generator=g),
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.empty(n, 1).uniform_(-30, 30, generator=g),
        features_dc=torch.randn(n, 3, generator=g),
        features_rest=torch.zeros(n, 0, 3),
    )


@needs_compiler
@pytest.mark.parametrize("scene", [cloud(2000), *(extremes(2000, unit) for unit in (1e-14, 1.0, 1e14))])
def test_the_kernel_gives_what_torch_gives(scene):
    state = state_of(scene)
    first, second = torch.randperm(2000, generator=torch.Generator().manual_seed(1))[:1400].view(2, 700)
    (ours, our_shares), (torchs, shares) = (replace_pairs(state, first, second, MERGING, on) for on in (True, False))
    assert torch.equal(ours.counts, torchs.counts) and int(ours.counts.sum()) == 2000
    torch.testing.assert_close(ours.means, torchs.means, rtol=1e-9, atol=1e-9 * float(torchs.means.abs().max()))
    for got, wanted in ((ours.colours, torchs.colours), (ours.weights, torchs.weights), (our_shares, shares)):
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-6)  # float32
    # Opacities, and by them sizes, are quotients of areas along the thinnest axis, of a needle two nearly equal ones.
    largest = torchs.cov.abs().amax(1, keepdim=True)
    apart = torch.cat([(ours.cov - torchs.cov) / largest, (ours.alphas - torchs.alphas)[:, None]], dim=1).abs()
    assert float((apart.amax(1) < 1e-6).double().mean()) > 0.99
    assert bool(ours.alphas.isfinite().all()) and bool(ours.cov.isfinite().all())


@needs_compiler
def test_any_number_of_threads_gives_the_same_and_others_stay_as_they_are():
    state, pairs = state_of(cloud(9000)), torch.arange(6000).view(2, 3000)

    def replaced() -> list[torch.Tensor]:
        after, shares = replace_pairs(state, *pairs, MERGING)
        return [*(value for value in dataclasses.astuple(after) if isinstance(value, torch.Tensor)), shares]

    assert_same_on_any_threads(replaced)
    after, _ = replace_pairs(state, *pairs, MERGING)
    assert torch.equal(after.cov[3000:], state.cov[6000:]) and torch.equal(after.colours[3000:], state.colours[6000:])
