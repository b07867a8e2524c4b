"""Traces of photos in the Gaussians of a scene: where photos were taken, and what they showed.

Training starts without SH, or with round Gaussians of one colour. Each photo of a Gaussian changes
its SH coefficients and flattens it onto the surface. A Gaussian without photos keeps its initial
values. So the SH energy and the flatness of a neighbourhood grow with the number of photos that
showed it, including the effect of occlusion.

A photo from direction d moves the coefficients f along Y(d), the SH basis there. So the
direction-dependent part of the colour, f . Y, is large towards photo places and small elsewhere: a
photo place is one where it is large for many Gaussians. Without SH, sizes give weaker evidence:
training splits Gaussians that are large in a photo, so they are small near photo places and large
far away.
"""

from __future__ import annotations

import ctypes
import math

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.functional import avg_pool1d

from pointsplat_ns.rendering.spherical_harmonics import sh_basis
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    LANES,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.pieces import in_pieces
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.view_sampling.settings import current_settings


class PhotoEvidenceStruct(Struct):
    """``PhotoEvidence`` of ``photo_evidence.cpp``, which documents its members."""

    members = {
        "places": DOUBLE_POINTER,
        "count": ctypes.c_int64,
        "means": DOUBLE_POINTER,
        "sh": FLOAT_POINTER,
        "blocks": ctypes.c_int64,
        "degree": ctypes.c_int64,
        "factor": ctypes.c_double,
        "evidence": FLOAT_POINTER,
    }
    _fields_ = c_fields(members)


photo_evidence_kernel = Function("pointsplat_photo_evidence", PhotoEvidenceStruct, INT64_POINTER)

MIN_SH = 1e-4
"""Length of an SH coefficient vector, root of the sum of squares, that counts as untrained."""


def trace_factors(scene: Gaussians, members: Tensor) -> Tensor:
    """Trace factor of each member: large if photos showed its neighbourhood well, 1 for the median
    member.

    Args:
        scene, members: as for :func:`traces_around`.

    Returns:
        (n,) float32, see :func:`factors_of`.
    """
    return factors_of(*traces_around(scene, members))


def traces_around(scene: Gaussians, members: Tensor) -> tuple[Tensor, Tensor]:
    """Mean SH energy and mean flatness of each member's neighbourhood.

    Args:
        scene: N Gaussians.
        members: (n,) indices, n at least 1, in an order that puts neighbours together.

    Returns:
        (n,) each, float64.
    """
    energies = in_pieces(lambda rows: _energy(scene.features_rest[rows].double()), members)
    flatnesses = in_pieces(lambda rows: _flatness(scene.scales[rows].double()), members)
    energy, flatness = (
        means_around(values, current_settings().trace_neighbourhood)
        for values in (energies, flatnesses)
    )
    return energy, flatness


def factors_of(energy: Tensor, flatness: Tensor) -> Tensor:
    """The mean energy (n,) and the exponential of the mean flatness (n,), each to a power, relative
    to the median, (n,) float32; 1 for all if all are equal."""
    logs = (
        current_settings().energy_exponent * (energy + MIN_SH**2).log()
        + current_settings().flatness_exponent * flatness
    )
    return (
        (logs - logs.median())
        .clamp(-current_settings().max_log_factor, current_settings().max_log_factor)
        .exp()
        .float()
    )


def _energy(sh: Tensor) -> Tensor:
    """Sums of squares (n,) of SH coefficients (n, K, 3), clamped at 1,000; white is 1."""
    return sh.clamp(-1e3, 1e3).square().sum((1, 2))


def _flatness(scales: Tensor) -> Tensor:
    """Logarithms (n,) of width over thickness from log-scales (n, 3)."""
    thickness, width, length = scales.sort(dim=1).values.unbind(1)
    # flat ones of any kind are alike
    return (0.5 * (width + length) - thickness).nan_to_num(0.0).clamp(0.0, 7.0)


def means_around(values: Tensor, count: int) -> Tensor:
    """Moving average (n,) of values (n,) over ``count`` items, an odd number; fewer at the ends."""
    means: Tensor = avg_pool1d(
        values[None, None], count, stride=1, padding=count // 2, count_include_pad=False
    )
    return means[0, 0]


class PhotoTraces:
    """Photo places estimated from a scene, in its unit. A random selection of Gaussians with SH is
    compared with places. If there are none, the sizes of four times as many are used, because a
    single size is weaker evidence."""

    places: Tensor
    """(P, 3) float64, uniform in a box 1.5 times that of the Gaussians; empty if no Gaussian can be
    compared."""
    shares: Tensor
    """(P,) of the photos, which sum to 1."""
    sure: bool
    """Whether the best place explains enough to be a photo place."""

    def __init__(self, scene: Gaussians):
        generator = torch.Generator().manual_seed(0)
        count = current_settings().evidence_count
        # more than needed, because some are faint
        some = scene[torch.randperm(len(scene), generator=generator, device="cpu")[: 8 * count]]
        sh = unit_sh(some.features_rest)
        opaque = some.usable() & (some.alphas > current_settings().min_opacity)
        with_sh = opaque & (sh != 0).any(2).any(1)
        self.has_sh = bool(with_sh.any())
        """Whether SH are compared, instead of sizes."""
        chosen = with_sh.nonzero()[:count, 0] if self.has_sh else opaque.nonzero()[: 4 * count, 0]
        self._means = some.means[chosen].double()
        self._sh = sh[chosen]
        self._sizes = log_widths(some.scales[chosen])
        self.places = torch.zeros(0, 3, **DOUBLES)
        self.shares = torch.zeros(0, **FLOATS)
        self.sure = False
        if len(chosen) == 0:
            return
        low, high = torch.quantile(self._means, self._means.new_tensor([0.02, 0.98]), dim=0)
        offsets = torch.rand(1_000, 3, generator=generator, **FLOATS).double() - 0.5
        self.places = 0.5 * (low + high) + 1.5 * (high - low) * offsets
        found = self.evidence(self.places)
        best = float(found.max())
        shares = (
            found.clamp_min(0) / max(best, 1e-9)
        ) ** current_settings().photo_share_exponent + 1e-12
        self.shares = shares / shares.sum()
        self.sure = best >= (
            current_settings().min_sh_evidence
            if self.has_sh
            else current_settings().min_size_evidence
        )

    def evidence(self, places: Tensor) -> Tensor:
        """Evidence (P,) float32 for places (P, 3): the mean of the :func:`explained_energy`;
        without SH, the correlation of the logarithms of size and distance."""
        if self.has_sh:
            return mean_explained(self._means, self._sh, places)
        tiny = torch.finfo(torch.float64).tiny
        found = [
            correlations(
                (self._means - some[:, None]).norm(dim=2).clamp_min(tiny).log(), self._sizes
            )
            for some in places.split(64)
        ]
        return torch.cat(found).float() if found else torch.zeros(0, **FLOATS)


def mean_explained(
    means: Tensor, sh: Tensor, places: Tensor, compiled: bool | None = None
) -> Tensor:
    """Mean of the :func:`explained_energy` of n Gaussians for each place, (P,) float32.

    Args:
        means: (n, 3) float64; n at least 1.
        sh: (n, K, 3) float32, as there.
        places: (P, 3) float64.
        compiled: False uses torch; True warns if the kernels are missing.
    """
    count, width = sh.shape[:2]
    if not KERNELS.usable_for(compiled, sh):
        found = [explained_energy(means - place, sh).mean() for place in places]
        return torch.stack(found) if found else torch.zeros(0, **FLOATS)
    evidence = torch.empty(len(places), **FLOATS)
    blocks = -(-count // LANES)
    means_in_lanes, sh_in_lanes = (
        F.pad(values.flatten(1), (0, 0, 0, LANES * blocks - count))
        .view(blocks, LANES, -1)
        .transpose(1, 2)
        .contiguous()
        for values in (means, sh)
    )
    task = PhotoEvidenceStruct(
        places=places.contiguous(),
        count=len(places),
        means=means_in_lanes,
        sh=sh_in_lanes,
        blocks=blocks,
        degree=math.isqrt(width + 1) - 1,
        factor=4 * math.pi / count,
        evidence=evidence,
    )
    on_threads(len(places) > 1, photo_evidence_kernel, task)
    return evidence


def unit_sh(sh: Tensor) -> Tensor:
    """SH coefficients (n, K, 3) normalised per Gaussian, float32; 0 if their length is at most
    :data:`MIN_SH`."""
    sh = sh.double().clamp(-1e3, 1e3)
    length = _energy(sh).sqrt()[:, None, None]
    return torch.where(length > MIN_SH, sh / length.clamp_min(MIN_SH), 0.0).float()


def log_widths(scales: Tensor) -> Tensor:
    """Logarithms (n,) of the geometric means of the two larger standard deviations from log-scales
    (n, 3), float64; finite, or NaN if a log-scale is."""
    return scales.double().clamp(-100.0, 100.0).sort(dim=1).values[:, 1:].mean(1)


def correlations(several: Tensor, one: Tensor) -> Tensor:
    """Pearson's correlation coefficients (m,) of rows (m, n) with one (n,), float64; 0 if either is
    constant."""
    centred = []
    for values in (several, one[None]):
        apart = values - values.mean(1, keepdim=True)
        tiny = torch.finfo(apart.dtype).tiny
        apart = apart / apart.abs().amax(1, keepdim=True).clamp_min(tiny)
        centred.append(apart / apart.norm(dim=1, keepdim=True))
    return (centred[0] @ centred[1][0]).nan_to_num(0.0).clamp(-1.0, 1.0)


def explained_energy(offsets: Tensor, sh: Tensor) -> Tensor:
    """Share of the SH energy along the basis in one direction per Gaussian, relative to its mean
    over SH of random directions.

    Args:
        offsets: (n, 3) from an eye to Gaussians, of any length.
        sh: (n, K, 3) SH coefficients of degrees 1 and up, of length 1.

    Returns:
        (n,) float32 in [0, K]: large if photos were taken from that direction.
    """
    directions = (
        offsets / offsets.norm(dim=1, keepdim=True).clamp_min(torch.finfo(offsets.dtype).tiny)
    ).float()
    basis = sh_basis(directions, math.isqrt(sh.shape[1] + 1) - 1)[:, 1:]
    # the squares of all K basis functions have the sum K / (4 pi) in every direction (Unsöld)
    return (sh * basis[:, :, None]).sum(1).square().sum(1) * (4 * math.pi)
