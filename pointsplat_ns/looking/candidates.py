"""Candidate views of a scene, and how likely it is that people took each. All is in units of the content.

Training spends Gaussians on what photos show, makes them as small as photos show them, and leaves nothing to see where
no photo looked. So a view is likely if its picture is full and shows many Gaussians, all of them small. SH tell more:
they explain best the places that photos were taken from (:mod:`~pointsplat_ns.looking.traces`). The logarithm of the
likelihood, up to a constant, is

    log(shown) - log(empty + 0.01) - 2 log(blur) + 0.75 evidence - (pitch + 15)^2 / (2 25^2)

with the share of the Gaussians that are shown, the share of the picture that is empty, the mean over the picture of
the angle that a Gaussian subtends, radians, the evidence of SH for its place, and its pitch, degrees: few photos look
far up or down. A logistic regression between the poses of six captures and candidates gives 1.2, 1.3 and 0.75 without
blur and pitch: with each capture left out in turn, a pose of it is likelier than a candidate in 89 % of cases. Blur
tells poses from candidates no better; views from within walls, which captures lack, need it. Candidates whose pitch
is bound to -50 to 10 degrees instead lose 0.2 dB on average over the six at 10 %, most where the estimated up is
wrong. ``docs/concepts/sampled_views.md`` says more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from pointsplat_ns.comparing.each_view import each_view
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import curve_keys, invert_rigid, unit_cells
from pointsplat_ns.looking.content import UNITS, thinned, thinning
from pointsplat_ns.looking.poses import look_at, views_of
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.looking.traces import PhotoEvidence, PhotoPlaces, log_widths, means_around
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.views import Views

MIN_EMPTY = 0.01
"""Share of a picture up to which it counts as full."""

MIN_BLUR = 1e-9
"""Blur of Gaussians that are points, radians."""

BLUR_EXPONENT = 2.0
EVIDENCE_WEIGHT = 0.75
PITCH_MEAN = -15.0
PITCH_DEVIATION = 25.0


@dataclass(frozen=True, eq=False)
class Candidates:
    """What candidate views are drawn from and judged by."""

    few: Gaussians
    """Some of the Gaussians, enlarged to cover as much as all."""
    targets: Tensor
    """Indices (t,) of those that are opaque enough to be looked at."""
    widths: Tensor
    """Widths (n,) before they were enlarged, float32: geometric means of the two larger standard deviations."""
    widths_around: Tensor
    """Means (n,) of their logarithms over neighbours, float64."""
    evidence: PhotoEvidence
    places: PhotoPlaces | None
    """Places that photos may have been taken from; None if nothing of the scene tells."""
    up: Tensor
    """(3,) of length 1."""
    resolution: tuple[int, int]
    """Width and height of the pictures, pixels."""

    @staticmethod
    def of(
        scene: Gaussians,
        step: int,
        evidence: PhotoEvidence,
        places: PhotoPlaces | None,
        up: Tensor,
        resolution: tuple[int, int],
    ) -> Candidates:
        """Candidates of a scene.

        Args:
            scene: N Gaussians on the CPU.
            step: the scene is every so many-th Gaussian of another, enlarged to cover as much as all.
            evidence, places: of this scene.
            up: (3,) of length 1.
            resolution: width and height, pixels.
        """
        scene = scene[scene.usable()]
        few = thinned(scene, LOOKING.candidate_gaussians)
        along = curve_keys(unit_cells(few.means)).argsort(stable=True)
        few = few[along]
        enlarged = 0.5 * math.log(step * thinning(len(scene), LOOKING.candidate_gaussians))
        widths = log_widths(few.scales) - enlarged
        alphas = few.alphas
        targets = (alphas > min(LOOKING.min_opacity, 0.5 * float(alphas.max()))).nonzero()[:, 0]
        around = means_around(widths, 9)
        return Candidates(few, targets, widths.exp().float(), around, evidence, places, up, resolution)

    def views(self, count: int, generator: torch.Generator, likeliest: bool = False) -> Tensor:
        """World-to-camera matrices (count, 4, 4), float64, of likely views that complete each other, or of the
        likeliest ones, which may show the same."""
        drawn = self._drawn(max(LOOKING.min_candidates, LOOKING.candidates_per_view * count), generator)
        likelihoods, shown = self.judged(views_of(drawn, *self.resolution, UNITS))
        return drawn[likelihoods.topk(count).indices if likeliest else self.completing(likelihoods, shown, count)]

    def completing(self, likelihoods: Tensor, shown: Tensor, count: int) -> list[int]:
        """Indices of at most ``count`` views, as :meth:`judged`. The next one always has the largest product of its
        likelihood and of what it adds to those before."""
        likely = (likelihoods - likelihoods.max()).exp().float()
        shown = shown[:, self.targets].float()
        coverage = torch.zeros(shown.shape[1], **FLOATS)
        taken: list[int] = []
        for _ in range(min(count, len(likely))):
            gains = likely * (shown @ (1 / (LOOKING.half_gain_coverage + coverage)))
            gains[taken] = -1.0
            taken.append(int(gains.argmax()))
            coverage += shown[taken[-1]]
        return taken

    @cached_property
    def _floor(self) -> float:
        """Height below which no camera stands, units."""
        heights = self.few.means[self.targets].double() @ self.up
        return float(heights.quantile(0.05))

    def _drawn(self, count: int, generator: torch.Generator) -> Tensor:
        """Candidates (V, 4, 4): half of them at random distances from Gaussians, half from likely photo places."""
        if self.places is None:
            return self._at_gaussians(count, generator)
        half = count // 2
        return torch.cat([self._at_gaussians(count - half, generator), self._from_places(half, generator)])

    def _at_gaussians(self, count: int, generator: torch.Generator) -> Tensor:
        """Cameras (count, 4, 4) that look at Gaussians at any pitch, from where their neighbourhood is as small as in
        photos, or, if that is too far away, from any distance."""
        aim = self._targets(count, generator)
        angle, turn, pitch = torch.rand(3, count, generator=generator, **DOUBLES)
        small, large = LOOKING.apparent_sizes
        distance = self.widths_around[aim].exp() / (small * (large / small) ** angle)
        distance = torch.where(distance < UNITS, distance, UNITS * angle).clamp_min(0.01 * UNITS)
        pitch = math.pi * (pitch - 0.5)
        ahead = pitch.cos()[:, None] * level_directions(self.up, 2 * math.pi * turn) + pitch.sin()[:, None] * self.up
        target = self.few.means[aim].double()
        below = ((target - distance[:, None] * ahead) @ self.up < self._floor).to(ahead.dtype)
        ahead = ahead - (2 * below * (ahead @ self.up))[:, None] * self.up  # from above instead
        return look_at(target - distance[:, None] * ahead, target, self.up)

    def _from_places(self, count: int, generator: torch.Generator) -> Tensor:
        """Cameras (count, 4, 4) near photo places, which are drawn by their shares, each looking at a Gaussian."""
        assert self.places is not None
        drawn = torch.multinomial(self.places.shares.float(), count, replacement=True, generator=generator)
        offsets = torch.randn(count, 3, generator=generator, **DOUBLES)
        eyes = self.places.places[drawn] + LOOKING.photo_place_deviation * offsets
        eyes = eyes + (self._floor - eyes @ self.up).clamp_min(0)[:, None] * self.up
        return look_at(eyes, self.few.means[self._targets(count, generator)].double(), self.up)

    def _targets(self, count: int, generator: torch.Generator) -> Tensor:
        """Indices (count,) of Gaussians to look at, each as likely as any other."""
        return self.targets[torch.randint(len(self.targets), (count,), generator=generator, device="cpu")]

    def judged(self, views: Views) -> tuple[Tensor, Tensor]:
        """Logarithms (V,) of the likelihood of views in units of the content, up to a constant, float64, and which of
        the Gaussians each shows (V, n), bool."""
        viewmats = views.viewmats.double()
        eyes = invert_rigid(viewmats)[:, :3, 3]
        views = replace(views.resized(LOOKING.candidate_side), rasterize_mode="antialiased")
        likelihoods, shown = [], []
        for eye, pixels in zip(eyes, each_view(self.few, views, pixels_of), strict=True):
            covered = float(pixels.double().sum())
            distances = (self.few.means - eye.float()).norm(dim=1).clamp_min(1e-3)
            blur = 1.0  # radian, of a view that shows nothing
            if covered > 0:
                blur = max(float((pixels * self.widths / distances).double().sum()) / covered, MIN_BLUR)
            shown.append(pixels > LOOKING.min_candidate_pixels)
            share = (float(shown[-1].sum()) + 1) / len(pixels)
            empty = max(0.0, 1 - covered / (views.width * views.height))
            likelihoods.append(math.log(share) - math.log(empty + MIN_EMPTY) - BLUR_EXPONENT * math.log(blur))
        evidence = self.evidence.at(eyes).double() if self.evidence.has_sh else torch.zeros(len(eyes), **DOUBLES)
        pitch = torch.rad2deg(torch.asin((viewmats[:, 2, :3] @ self.up).clamp(-1, 1)))
        usual = -0.5 * ((pitch - PITCH_MEAN) / PITCH_DEVIATION).square()
        return torch.tensor(likelihoods, **DOUBLES) + EVIDENCE_WEIGHT * evidence + usual, torch.stack(shown)
