"""Traces that photos leave in a scene: how much they showed of each part of it, and where they were taken.

A scene is trained from nothing, or from round Gaussians of one colour. Each photo that shows a Gaussian moves its SH
coefficients, and pulls it flat onto the surface; what no photo shows stays as it was. So the energy of the SH and the
flatness of a neighbourhood tell how much it was looked at, with what was in the way taken into account.

A photo from direction d moves the coefficients f along Y(d), the basis there. So the part of the colour that depends
on the direction, f . Y, is large where photos were taken from, and small elsewhere. A place from which it is large for
many Gaussians is one where photos were taken. Without SH, sizes tell, if less: training splits what is large in a
photo, so that Gaussians are small near the places of photos and large far from them.

None of this is in the literature that we know of; it was found on trained scenes whose poses are known, see
``docs/concepts/sampled_views.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool1d

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis
from pointsplat_ns.system.pieces import in_pieces

NEIGHBOURHOOD = 129
"""Number of Gaussians along the curve whose mean says how much a place was seen; one alone says little."""

ENERGY_POWER = 0.75
"""Exponent of the mean energy of the SH; with that of the mean flatness, 1, fitted to the poses of four captures."""

FLATNESS_POWER = 2.0
"""Exponent of the mean flatness where there are no SH."""

FAINTEST = 1e-4
"""SH coefficients, root of the sum of squares, below which no photo is taken to have changed them."""

LARGEST = 1e3
"""SH coefficients are taken to be at most this: a colour of 1 is white."""

FLATTEST = 7.0
"""Largest flatness, logarithm of width over thickness: flat Gaussians of any kind are alike."""

MOST_LOG = 100.0
"""Bound of log-scales, either way, when sizes are compared: some are infinite."""

MOST_FACTOR = 8.0
"""Bound of the logarithm of a factor, either way from the median's."""

PROBED = 1_500
"""Number of Gaussians, at most, that are asked for the places of photos."""

OPAQUE_ENOUGH = 0.1
"""Least opacity of these."""

CANDIDATES = 2_000
"""Number of places that are compared."""

ASKED_FIRST, PROMISING = 300, 0.8
"""Number of them that are compared first, and share of :data:`TELLING` that the best of these must reach for the others
to be compared as well."""

AROUND = 1.5
"""Size of the box that these are in, relative to one that holds 96 % of those Gaussians along each axis."""

TELLING = 2.0
"""How much more than SH of no direction a place must explain, for the scene to have told where photos were taken.
The captures reach 3.3 to 3.7 where photos were taken; scenes seen from all around 1.2 to 1.6, and their best places lie
in the wrong parts of them (-0.1 to -0.4 dB)."""

CONTRAST = 16
"""Shares of places rise with this power of what they explain."""

TELLING_SIZE, CONTRAST_OF_SIZE = 0.48, 8
"""The same for sizes: least correlation of the logarithms of size and distance, and its power. The captures that are
looked at from outside reach 0.50 to 0.78, those of rooms, where any free place will do, 0.23 to 0.46."""

LEAST_SHARE = 0.01
"""Places of a smaller share than this, relative to the best one's, are left out."""


def how_much_seen(scene: Gaussians, members: Tensor) -> Tensor:
    """How much photos showed of the neighbourhood of each member, relative to the median, (n,) float32.

    Mean energy of the SH to the power 3/4, times the mean flatness, the geometric mean of width over thickness; without
    SH, that squared. 1 for all if the Gaussians have no SH and are equally flat.

    Args:
        scene: N Gaussians.
        members: (n,) indices, n at least 1, in an order in which neighbours are near each other.
    """
    energy = means_around(in_pieces(lambda rows: _energy(scene.features_rest[rows].double()), members), NEIGHBOURHOOD)
    flatness = means_around(in_pieces(lambda rows: _flatness(scene.scales[rows].double()), members), NEIGHBOURHOOD)
    power = 1.0 if bool((energy > 0).any()) else FLATNESS_POWER
    logs = ENERGY_POWER * (energy + FAINTEST**2).log() + power * flatness
    return (logs - logs.median()).clamp(-MOST_FACTOR, MOST_FACTOR).exp().float()


def _energy(rest: Tensor) -> Tensor:
    """Sums of squares (n,) of SH coefficients (n, K, 3)."""
    return rest.clamp(-LARGEST, LARGEST).square().sum((1, 2))


def _flatness(scales: Tensor) -> Tensor:
    """Logarithms (n,) of width over thickness of log-scales (n, 3)."""
    thickness, width, length = scales.sort(dim=1).values.unbind(1)
    return (0.5 * (width + length) - thickness).nan_to_num(0.0).clamp(0.0, FLATTEST)


def means_around(values: Tensor, count: int) -> Tensor:
    """Means (n,) of values (n,) over the ``count`` nearest in their order, an odd number; fewer at the ends."""
    means: Tensor = avg_pool1d(values[None, None], count, stride=1, padding=count // 2, count_include_pad=False)
    return means[0, 0]


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Some Gaussians of a scene that say from where photos showed them: by their SH; if none has any, by their size."""

    means: Tensor  # [n, 3] float64, scene units
    sh: Tensor  # [n, K, 3] float32, SH coefficients of degrees 1 and up, of length 1
    sizes: Tensor  # [n] float64, logarithms of the geometric means of width and length

    @staticmethod
    def of(scene: Gaussians, generator: torch.Generator) -> Witnesses:
        """At most :data:`PROBED` Gaussians drawn from a scene that have SH; if none has, four times as many others, as
        the size of one says less."""
        drawn = torch.randperm(len(scene), generator=generator)[: 8 * PROBED]
        some = scene[drawn.to(scene.device)].to("cpu")
        sh = unit_sh(some.features_rest)
        telling = some.usable() & (some.alphas > OPAQUE_ENOUGH)
        with_sh = telling & (sh != 0).any(2).any(1)
        chosen = with_sh.nonzero()[:PROBED, 0] if bool(with_sh.any()) else telling.nonzero()[: 4 * PROBED, 0]
        sizes = some.scales[chosen].double().clamp(-MOST_LOG, MOST_LOG).sort(dim=1).values[:, 1:].mean(1)
        return Witnesses(some.means[chosen].double(), sh[chosen], sizes)

    @property
    def have_sh(self) -> bool:
        """Whether they tell by their SH."""
        return bool((self.sh != 0).any())

    def places(self, count: int, generator: torch.Generator) -> Tensor:
        """Places (count, 3) drawn evenly from the box that those of photos are looked for in, float64."""
        low, high = torch.quantile(self.means, self.means.new_tensor([0.02, 0.98]), dim=0)
        spread = torch.rand(count, 3, generator=generator).double() - 0.5
        return 0.5 * (low + high) + AROUND * (high - low) * spread

    def votes(self, places: Tensor) -> Tensor:
        """How well photos from each place (P, 3) explain the SH, relative to SH of no direction, or the sizes: how the
        logarithms of size and distance correlate; (P,) float32."""
        if self.have_sh:
            return torch.stack([explained(self.means - place, self.sh).mean() for place in places])
        return torch.stack([correlation(log_norms(self.means - place), self.sizes) for place in places]).float()


def photo_places(scene: Gaussians) -> tuple[Tensor, Tensor] | None:
    """Where the photos were taken that a scene was trained on, as far as its Gaussians tell.

    Args:
        scene: N Gaussians.

    Returns:
        Places (P, 3), in the scene's unit, float64, and their shares (P,), which sum to 1; None if they do not tell.
        Deterministic.
    """
    generator = torch.Generator().manual_seed(0)
    witnesses = Witnesses.of(scene, generator)
    if len(witnesses.means) == 0:
        return None
    places = witnesses.places(CANDIDATES, generator)
    telling, contrast = (TELLING, CONTRAST) if witnesses.have_sh else (TELLING_SIZE, CONTRAST_OF_SIZE)
    votes = witnesses.votes(places[:ASKED_FIRST])
    if not float(votes.max()) >= PROMISING * telling:
        return None
    votes = torch.cat([votes, witnesses.votes(places[ASKED_FIRST:])])
    best = float(votes.max())
    if best < telling:
        return None
    shares = (votes.clamp_min(0) / best) ** contrast
    chosen = shares > LEAST_SHARE
    return places[chosen], shares[chosen] / shares[chosen].sum()


def unit_sh(rest: Tensor) -> Tensor:
    """SH coefficients (n, K, 3) at a length of 1, or 0 if they are :data:`FAINTEST`, float32."""
    rest = rest.double().clamp(-LARGEST, LARGEST)
    length = _energy(rest).sqrt()[:, None, None]
    return torch.where(length > FAINTEST, rest / length.clamp_min(FAINTEST), 0.0).float()


def log_norms(offsets: Tensor) -> Tensor:
    """Logarithms (n,) of the lengths of offsets (n, 3); finite."""
    return offsets.norm(dim=1).clamp_min(torch.finfo(offsets.dtype).tiny).log()


def correlation(a: Tensor, b: Tensor) -> Tensor:
    """Pearson's correlation coefficient of a (n,) and b (n,), a scalar; 0 if either is constant."""
    return torch.corrcoef(torch.stack([a, b]))[0, 1].nan_to_num(0.0)


def explained(offsets: Tensor, rest: Tensor) -> Tensor:
    """Share of the energy of SH that lies along the basis in some directions, relative to that of SH of no direction.

    Args:
        offsets: (n, 3) from an eye to Gaussians, of any length.
        rest: (n, K, 3) SH coefficients of degrees 1 and up, of length 1.

    Returns:
        (n,) float32, 0 to K: large if photos were taken from that direction.
    """
    directions = (offsets / offsets.norm(dim=1, keepdim=True).clamp_min(torch.finfo(offsets.dtype).tiny)).float()
    basis = sh_basis(directions, math.isqrt(rest.shape[1] + 1) - 1)[:, 1:]
    along = (rest * basis[:, :, None]).sum(1).square().sum(1) / basis.square().sum(1).clamp_min(FAINTEST)
    return along * rest.shape[1]
