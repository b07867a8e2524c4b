"""Traces that photos leave in the Gaussians of a scene: where photos were taken, and which parts they showed.

Training starts without SH, or with round Gaussians of one colour. Each photo that shows a Gaussian changes its SH
coefficients and flattens it onto the surface. A Gaussian that no photo shows stays as it was. So the energy of the SH
and the flatness of a neighbourhood grow with the number of photos that showed it, occlusion included.

A photo from direction d moves the coefficients f along Y(d), the SH basis there. So the part of the colour that depends
on the direction, f . Y, is large towards photo places and small elsewhere: a photo place is one where it is large for
many Gaussians. Without SH, sizes give weaker evidence: training splits Gaussians that are large in a photo, so that
they are small near photo places and large far from them.

The method was found on trained scenes with known poses, see ``docs/concepts/sampled_views.md``. We know of no
publication.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis
from pointsplat_ns.system.pieces import in_pieces
from pointsplat_ns.system.tensors import DOUBLES, FLOATS

MIN_SH = 1e-4
"""Length of a vector of SH coefficients, root of the sum of squares, up to which it counts as not trained."""

MAX_SH = 1e3
"""Bound of the absolute value of an SH coefficient. A colour of 1 is white."""


class PhotoPlaces(NamedTuple):
    """Places where photos may have been taken."""

    places: Tensor  # [P, 3] float64, in the unit of the scene
    shares: Tensor  # [P] shares of the photos, which sum to 1
    sure: bool = True
    """Whether the best place explains enough for photos to have been taken there."""


def trace_factors(scene: Gaussians, members: Tensor) -> Tensor:
    """Trace factor of each member: large where photos showed its neighbourhood well, 1 for the median member.

    The mean energy of the SH and the exponential of the mean flatness, each to a power. The flatness is the logarithm
    of width over thickness.

    Args:
        scene: N Gaussians.
        members: (n,) indices, n at least 1, in an order in which neighbours are near each other.

    Returns:
        (n,) float32; 1 for all if the Gaussians have no SH and are equally flat.
    """

    def local_means(values: Tensor) -> Tensor:
        return means_around(values, LOOKING.trace_neighbourhood)

    energy = local_means(in_pieces(lambda rows: _energy(scene.features_rest[rows].double()), members))
    flatness = local_means(in_pieces(lambda rows: _flatness(scene.scales[rows].double()), members))
    has_sh = bool((energy > 0).any())
    exponent = LOOKING.flatness_exponent if has_sh else LOOKING.flatness_exponent_without_sh
    logs = LOOKING.energy_exponent * (energy + MIN_SH**2).log() + exponent * flatness
    return (logs - logs.median()).clamp(-LOOKING.max_log_factor, LOOKING.max_log_factor).exp().float()


def _energy(sh: Tensor) -> Tensor:
    """Sums of squares (n,) of SH coefficients (n, K, 3)."""
    return sh.clamp(-MAX_SH, MAX_SH).square().sum((1, 2))


def _flatness(scales: Tensor) -> Tensor:
    """Logarithms (n,) of width over thickness of log-scales (n, 3)."""
    thickness, width, length = scales.sort(dim=1).values.unbind(1)
    return (0.5 * (width + length) - thickness).nan_to_num(0.0).clamp(0.0, 7.0)  # flat ones of any kind are alike


def means_around(values: Tensor, count: int) -> Tensor:
    """Means (n,) of values (n,) over the ``count`` nearest in their order, an odd number; fewer at the ends."""
    means: Tensor = avg_pool1d(values[None, None], count, stride=1, padding=count // 2, count_include_pad=False)
    return means[0, 0]


@dataclass(frozen=True, eq=False)
class PhotoEvidence:
    """Gaussians of a scene whose SH are compared with candidate photo places; if none has SH, their sizes are."""

    means: Tensor  # [n, 3] float64, scene units
    sh: Tensor  # [n, K, 3] float32, SH coefficients of degrees 1 and up, of length 1
    sizes: Tensor  # [n] float64, logarithms of the geometric means of width and length

    @staticmethod
    def of(scene: Gaussians, generator: torch.Generator) -> PhotoEvidence:
        """Gaussians that are drawn from those with SH; if there are none, from all that are opaque enough: four times
        as many, because one size says less than one vector of SH."""
        count = LOOKING.evidence_count
        drawn = torch.randperm(len(scene), generator=generator, device="cpu")[: 8 * count]  # some are faint
        some = scene[drawn.to(scene.device)].to("cpu")
        sh = unit_sh(some.features_rest)
        opaque = some.usable() & (some.alphas > LOOKING.min_opacity)
        with_sh = opaque & (sh != 0).any(2).any(1)
        if bool(with_sh.any()):
            chosen = with_sh.nonzero()[:count, 0]
        else:
            chosen = opaque.nonzero()[: 4 * count, 0]
        return PhotoEvidence(some.means[chosen].double(), sh[chosen], log_widths(some.scales[chosen]))

    @property
    def has_sh(self) -> bool:
        """Whether SH are compared, not sizes."""
        return bool((self.sh != 0).any())

    def candidates(self, count: int, generator: torch.Generator) -> Tensor:
        """Candidate places (count, 3), drawn evenly from a box 1.5 times that of the Gaussians, float64."""
        low, high = torch.quantile(self.means, self.means.new_tensor(LOOKING.outlier_quantiles), dim=0)
        offsets = torch.rand(count, 3, generator=generator, **FLOATS).double() - 0.5
        return 0.5 * (low + high) + 1.5 * (high - low) * offsets

    def at(self, places: Tensor) -> Tensor:
        """Evidence for each place (P, 3), (P,) float32.

        Mean of the :func:`explained_energy`; without SH, the correlation of the logarithms of size and distance.
        """
        if self.has_sh:
            return torch.stack([explained_energy(self.means - place, self.sh).mean() for place in places])
        return torch.stack([correlation(log_norms(self.means - place), self.sizes) for place in places]).float()

    def towards(self, directions: Tensor) -> Tensor:
        """Mean :func:`explained_energy` of far away places in each direction (D, 3), of length 1; (D,) float64, 1 for
        SH of random directions. Without SH, 1 for all."""
        if not self.has_sh:
            return torch.ones(len(directions), **DOUBLES)
        basis = sh_basis(-directions.float(), math.isqrt(self.sh.shape[1] + 1) - 1)[:, 1:].double()
        products = torch.einsum("nkc,nlc->kl", self.sh, self.sh).double() / len(self.sh)  # the mean over Gaussians
        return ((basis @ products) * basis).sum(1) / basis.square().sum(1) * self.sh.shape[1]


def photo_places(evidence: PhotoEvidence, generator: torch.Generator) -> PhotoPlaces | None:
    """Where the photos of a scene were taken, estimated from its Gaussians.

    Returns:
        The places and their shares, in the unit of the evidence; None if no Gaussian is compared.
    """
    if len(evidence.means) == 0:
        return None
    places = evidence.candidates(1_000, generator)
    found = evidence.at(places)
    best = float(found.max())
    shares = (found.clamp_min(0) / max(best, 1e-9)) ** LOOKING.photo_share_exponent + 1e-12
    needed = LOOKING.min_sh_evidence if evidence.has_sh else LOOKING.min_size_evidence
    return PhotoPlaces(places, shares / shares.sum(), sure=best >= needed)


def unit_sh(sh: Tensor) -> Tensor:
    """SH coefficients (n, K, 3), scaled to a length of 1 for each Gaussian, float32; 0 if they are at most
    :data:`MIN_SH` long."""
    sh = sh.double().clamp(-MAX_SH, MAX_SH)
    length = _energy(sh).sqrt()[:, None, None]
    return torch.where(length > MIN_SH, sh / length.clamp_min(MIN_SH), 0.0).float()


def log_widths(scales: Tensor) -> Tensor:
    """Logarithms (n,) of the geometric means of the two larger standard deviations of log-scales (n, 3), float64;
    finite, or NaN where a log-scale is."""
    return scales.double().clamp(-100.0, 100.0).sort(dim=1).values[:, 1:].mean(1)


def log_norms(offsets: Tensor) -> Tensor:
    """Logarithms (n,) of the lengths of offsets (n, 3); finite."""
    return offsets.norm(dim=1).clamp_min(torch.finfo(offsets.dtype).tiny).log()


def correlation(a: Tensor, b: Tensor) -> Tensor:
    """Pearson's correlation coefficient of a (n,) and b (n,), a scalar; 0 if either is constant."""
    return torch.corrcoef(torch.stack([a, b]))[0, 1].nan_to_num(0.0)


def explained_energy(offsets: Tensor, sh: Tensor) -> Tensor:
    """Share of the energy of SH that lies along the basis in one direction each, relative to its mean over SH of random
    directions.

    Args:
        offsets: (n, 3) from an eye to Gaussians, of any length.
        sh: (n, K, 3) SH coefficients of degrees 1 and up, of length 1.

    Returns:
        (n,) float32 in [0, K]: large if photos were taken from that direction.
    """
    directions = (offsets / offsets.norm(dim=1, keepdim=True).clamp_min(torch.finfo(offsets.dtype).tiny)).float()
    basis = sh_basis(directions, math.isqrt(sh.shape[1] + 1) - 1)[:, 1:]
    along = (sh * basis[:, :, None]).sum(1).square().sum(1) / basis.square().sum(1).clamp_min(MIN_SH)
    return along * sh.shape[1]
