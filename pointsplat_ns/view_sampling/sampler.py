"""Samples views of a scene without cameras, similar to those of its photos.

Training spends Gaussians on content of photos, makes them as small as photos show them, and leaves
regions without photos empty. So a view is likely if its image is full and shows many Gaussians, all
of them small. SH give more evidence: they are explained best by the true photo places
(:mod:`~pointsplat_ns.view_sampling.traces`). The log-likelihood, up to a constant, is

    log(shown) - log(empty + 0.01) - 2 log(blur) + 0.75 evidence - (pitch + 15)^2 / (2 25^2)

where shown is the share of Gaussians that are visible, empty the share of the image that is empty,
blur the mean over the image of the angle that a Gaussian subtends, radians, evidence that of SH for
its place, and pitch is in degrees: few photos look far up or down. A logistic regression between
the poses of six captures and candidates gives 1.2, 1.3 and 0.75 without blur and pitch: in
leave-one-out tests, a capture's pose is likelier than a candidate in 89 % of cases. Blur does not
separate poses from candidates any better, but is needed for views from within walls, which captures
lack. Limiting the pitch of candidates to -50 to 10 degrees instead loses 0.2 dB on average over the
six at 10 %, most if the estimated up direction is wrong.
In a closed room, candidates beyond its walls are left out
(:mod:`~pointsplat_ns.view_sampling.enclosure`).

Few candidates are likely in a room: most look at a wall from near by, or through one. So only half
of the candidates are drawn without regard to likelihood. The others look around from where likely
ones of the first half stand (population Monte Carlo: Cappé et al., 2004). See
``docs/concepts/sampled_views.md``.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import camera_positions, curve_keys, unit_cells
from pointsplat_ns.rendering import pixels_of_each
from pointsplat_ns.rendering.comparison.sizes import RESOLUTION
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.system.threads import parallel_map
from pointsplat_ns.view_sampling.content import (
    UNITS,
    content_size,
    in_scene_units,
    in_units,
    thinned,
    thinning,
)
from pointsplat_ns.view_sampling.enclosure import enclosures, outside_of_a_room
from pointsplat_ns.view_sampling.poses import level_directions, look_at, views_of
from pointsplat_ns.view_sampling.settings import current_settings
from pointsplat_ns.view_sampling.traces import PhotoTraces, log_widths, means_around
from pointsplat_ns.view_sampling.upright import Surface, Up, checked_up, known_up, upright

VIEWS_AT_ONCE = 16
"""Number of candidates that a thread judges at a time: their numbers fit into its cache."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """C views that may be taken, in units of the content."""

    viewmats: Tensor  # [C, 4, 4] float64
    likelihoods: Tensor  # [C] float64, logarithms up to a constant
    shown: Tensor  # [C, n] bool, of the Gaussians Sampler.few
    enclosure: Tensor  # [C] float64 in (0, 1]

    def within_walls(self) -> Tensor:
        """Log-likelihoods (C,), of which those beyond the walls of a closed room are -infinity."""
        outside = outside_of_a_room(
            self.enclosure, self.likelihoods, current_settings().room_enclosure
        )
        return self.likelihoods.masked_fill(outside, -math.inf)

    def joined(self, others: Candidates) -> Candidates:
        """These candidates, followed by others."""
        return Candidates(
            viewmats=torch.cat([self.viewmats, others.viewmats]),
            likelihoods=torch.cat([self.likelihoods, others.likelihoods]),
            shown=torch.cat([self.shown, others.shown]),
            enclosure=torch.cat([self.enclosure, others.enclosure]),
        )


@torch.no_grad()
def sample_views(
    scene: Gaussians,
    count: int,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    up: Tensor | None = None,
) -> Views:
    """Sample cameras similar to those of a scene's photos.

    Candidates look at random Gaussians, from distances at which these are small, or from places
    where SH suggest that photos were taken. Among likely ones
    (:mod:`pointsplat_ns.view_sampling.sampler`), the next view is the one that adds most to the
    earlier views. Views complement each other, so request all of them at once.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1.
        width: of the images, pixels.
        height: of the images, pixels. The field of view is 70 degrees across the longer side.
        seed: the same scene and seed give the same views; another seed gives others.
        up: (3,) up direction in the world, of any length; by default declared by the scene, or
            estimated (:mod:`pointsplat_ns.view_sampling.upright`).

    Returns:
        ``count`` views, on the CPU, with a black background: ``viewmats`` (count, 4, 4)
        world-to-camera in OpenCV axes and ``Ks`` (count, 3, 3) in pixels, float64, with a near
        plane that suits the scene's size.

    Raises:
        DataError: if ``count`` or the size is not positive, ``up`` is not a direction, or nothing
            of the scene is visible.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 3, width=64, height=48)
        >>> len(views), tuple(views.viewmats.shape), (views.width, views.height)
        (3, (3, 4, 4), (64, 48))
    """
    if up is not None:
        up = torch.as_tensor(up, **DOUBLES).detach()
        if up.shape != (3,) or not 0 < float(up.norm()) < math.inf:
            raise DataError(f"up is {up.tolist()}; expected three numbers, not all 0")
    return Sampler(scene, (width, height), None if up is None else Up(up / up.norm())).views(
        count, seed
    )


class Sampler:
    """Samples views of a scene as :func:`sample_views` does. Data shared by all views is computed
    once.

    Args:
        scene: N Gaussians. A large scene is thinned.
        resolution: width and height of the views, pixels.
        up: up direction; by default declared by the scene, or estimated.
        stands_for: number of Gaussians of a larger scene that each one represents; they were
            enlarged by this factor (:func:`enlarged`).

    Raises:
        DataError: if the resolution is not positive; from attributes and methods, if nothing of the
            scene is visible.
    """

    def __init__(
        self,
        scene: Gaussians,
        resolution: tuple[int, int] = RESOLUTION,
        up: Up | None = None,
        stands_for: float = 1.0,
    ):
        if min(resolution) < 1:
            raise DataError(
                f"cannot sample views of {resolution[0]} x {resolution[1]} pixels; expected at "
                "least 1 x 1"
            )
        # on the CPU, because the operations are many and small
        self.scene = thinned(scene.detach(), current_settings().sampled_count).to("cpu")
        self._step = stands_for * thinning(len(scene), current_settings().sampled_count)
        self.resolution = resolution
        self._named_up = up
        self._declared_up = known_up(None, scene)

    @cached_property
    def content(self) -> tuple[Tensor, float]:
        """Centre (3,) and diagonal of the content, scene units."""
        return content_size(self.scene)

    @cached_property
    def _in_units(self) -> Gaussians:
        """The drawable Gaussians in units of the content; all other attributes are in units."""
        scene = in_units(self.scene, *self.content)
        scene = scene[scene.usable()]
        if not bool((scene.alphas > 0).any()):
            raise DataError("nothing of the scene is visible, so no view can be sampled")
        return scene

    @cached_property
    def surface(self) -> Surface:
        """Points on the visible surfaces."""
        return Surface.of(self._in_units)

    @cached_property
    def _traces(self) -> PhotoTraces:
        return PhotoTraces(self._in_units)

    @property
    def traced(self) -> bool:
        """Whether SH show where the scene's photos were taken, so that trace factors apply."""
        return self._traces.has_sh and self._traces.sure

    @cached_property
    def up(self) -> Up:
        """Up direction: named, or declared by the scene and checked against it, or estimated."""
        if self._named_up is not None:
            return self._named_up
        # with half as many, a published room is upside down
        few = thinned(self._in_units, 20_000)
        if self._declared_up is not None:
            return checked_up(self._declared_up, few, self.surface, self._traces.sure)
        return upright(few, self.surface, self._traces.sure)

    @cached_property
    def few(self) -> Gaussians:
        """A selection of Gaussians, enlarged to cover as much as all, with neighbours together."""
        few = thinned(self._in_units, current_settings().candidate_gaussians)
        return few[curve_keys(unit_cells(few.means)).argsort(stable=True)]

    @cached_property
    def _log_widths(self) -> Tensor:
        """Logarithms (n,) of the widths of :attr:`few` before enlarging, float64."""
        step = self._step * thinning(len(self._in_units), current_settings().candidate_gaussians)
        return log_widths(self.few.scales) - 0.5 * math.log(step)

    @cached_property
    def _targets(self) -> Tensor:
        """Indices (t,) of the Gaussians in :attr:`few` that are opaque enough as targets."""
        alphas = self.few.alphas
        return (alphas > min(current_settings().min_opacity, 0.5 * float(alphas.max()))).nonzero()[
            :, 0
        ]

    @cached_property
    def _some_points(self) -> Tensor:
        """Positions (p, 3) of at most about 2,500 targets, for :func:`enclosures`."""
        return self.few.means[self._targets[:: max(1, len(self._targets) // 2500)]]

    @cached_property
    def _floor(self) -> float:
        """Minimum height of cameras."""
        return float((self.few.means[self._targets].double() @ self.up.direction).quantile(0.05))

    def prepare(self) -> None:
        """Compute the data shared by all views, if anything of the scene is visible."""
        with contextlib.suppress(DataError):
            _ = self.up, self._log_widths

    @torch.no_grad()
    def views(self, count: int, seed: int = 0, likeliest: bool = False) -> Views:
        """``count`` views on the CPU. ``count``, ``seed`` and errors are those of
        :func:`sample_views`. Views complement each other, or are the likeliest ones, which may
        show the same content."""
        if count < 1:
            raise DataError(f"cannot sample {count} views; expected at least 1")
        generator = torch.Generator().manual_seed(seed)
        total = max(
            current_settings().min_candidates, current_settings().candidates_per_view * count
        )
        half = total // 2
        candidates = self._candidates(self._drawn(total - half, generator))
        if half:
            others = self._from_likely(candidates, half, generator)
            candidates = candidates.joined(self._candidates(others))
        likelihoods = candidates.within_walls()
        taken = (
            likelihoods.topk(count).indices.tolist()
            if likeliest
            else self.completing(likelihoods, candidates.shown, count)
        )
        views = views_of(candidates.viewmats[taken], *self.resolution, UNITS)
        return in_scene_units(views, *self.content)

    def _candidates(self, viewmats: Tensor) -> Candidates:
        """The candidates of world-to-camera matrices (C, 4, 4)."""
        likelihoods, shown = self.judged(views_of(viewmats, *self.resolution, UNITS))
        enclosure = enclosures(self._some_points, camera_positions(viewmats))
        return Candidates(viewmats, likelihoods, shown, enclosure)

    def judged(self, views: Views) -> tuple[Tensor, Tensor]:
        """Log-likelihoods (V,) of views in units of the content, up to a constant, float64, and a
        mask (V, n) of the Gaussians :attr:`few` that each view shows."""
        viewmats = views.viewmats.double()
        eyes = camera_positions(viewmats)
        small = replace(
            views.resized(current_settings().candidate_side), rasterize_mode="antialiased"
        )
        widths = self._log_widths.exp().float()
        means = self.few.means.float().unbind(1)
        sizes = torch.tensor([size[:2] for size in small.size_of_each()], **DOUBLES).prod(1)

        def look(these: slice) -> tuple[Tensor, Tensor]:
            pixels = pixels_of_each(self.few, small[these]).float()
            squares = (
                (mean - eye[:, None]).square_()
                for mean, eye in zip(means, eyes[these].float().unbind(1), strict=True)
            )
            distances = sum(squares, pixels.new_zeros(())).sqrt_().clamp_min_(1e-3)
            covered = pixels.sum(1, dtype=torch.float64)
            blur = (distances.reciprocal_().mul_(pixels) @ widths) / covered
            # 1 radian for an empty view
            blur = blur.clamp_min(1e-9).where(covered > 0, torch.ones_like(covered))
            shown = pixels > 0.02  # sum of blending weights
            share = (shown.sum(1).double() + 1) / shown.shape[1]
            empty = (1 - covered / sizes[these]).clamp_min(0.0)
            return share.log() - (empty + 0.01).log() - 2 * blur.log(), shown

        found = parallel_map(
            look, pieces(len(small), self.few.device, VIEWS_AT_ONCE), self.few.device
        )
        likelihoods, shown = (torch.cat(parts) for parts in zip(*found, strict=True))
        traces = self._traces
        evidence = (
            traces.evidence(eyes).double() if traces.has_sh else torch.zeros(len(eyes), **DOUBLES)
        )
        pitch = torch.rad2deg(torch.asin((viewmats[:, 2, :3] @ self.up.direction).clamp(-1, 1)))
        usual = -0.5 * ((pitch + 15) / 25).square()
        return likelihoods + 0.75 * evidence + usual, shown

    def completing(self, likelihoods: Tensor, shown: Tensor, count: int) -> list[int]:
        """Indices of at most ``count`` views, from the result of :meth:`judged`. Greedy: the next
        view has the largest product of its likelihood and its addition to earlier views."""
        likely = (likelihoods - likelihoods.max()).exp().float()
        shown = shown[:, self._targets].float()
        coverage = torch.zeros_like(shown[0])
        taken: list[int] = []
        for _ in range(min(count, len(likely))):
            gains = likely * (shown @ (1 / (current_settings().half_gain_coverage + coverage)))
            gains[taken] = -1.0
            taken.append(int(gains.argmax()))
            coverage += shown[taken[-1]]
        return taken

    def _drawn(self, count: int, generator: torch.Generator) -> Tensor:
        """Cameras (count, 4, 4): half of them at random distances from Gaussians, half at likely
        photo places."""
        half = count // 2 if len(self._traces.places) else 0
        at_gaussians = self._at_gaussians(count - half, generator)
        return (
            torch.cat([at_gaussians, self._from_places(half, generator)]) if half else at_gaussians
        )

    def _at_gaussians(self, count: int, generator: torch.Generator) -> Tensor:
        """Cameras (count, 4, 4) that look at Gaussians at any pitch, from where their neighbourhood
        is as small as in photos, or from any distance if that is too far away."""
        up = self.up.direction
        aim = self._some_targets(count, generator)
        angle, turn, pitch = torch.rand(3, count, generator=generator, **DOUBLES)
        small, large = current_settings().apparent_sizes
        distance = means_around(self._log_widths, 9)[aim].exp() / (small * (large / small) ** angle)
        distance = torch.where(distance < UNITS, distance, UNITS * angle).clamp_min(0.01 * UNITS)
        pitch = math.pi * (pitch - 0.5)
        ahead = (
            pitch.cos()[:, None] * level_directions(up, 2 * math.pi * turn)
            + pitch.sin()[:, None] * up
        )
        target = self.few.means[aim].double()
        below = ((target - distance[:, None] * ahead) @ up < self._floor).to(ahead.dtype)
        ahead = ahead - (2 * below * (ahead @ up))[:, None] * up  # from above instead
        return look_at(target - distance[:, None] * ahead, target, up)

    def _from_places(self, count: int, generator: torch.Generator) -> Tensor:
        """Cameras (count, 4, 4) that look at Gaussians from near photo places, drawn by share."""
        traces = self._traces
        drawn = torch.multinomial(
            traces.shares.float(), count, replacement=True, generator=generator
        )
        return self._around(traces.places[drawn], generator)

    def _from_likely(
        self, candidates: Candidates, count: int, generator: torch.Generator
    ) -> Tensor:
        """Cameras (count, 4, 4) that look at Gaussians from near candidates, drawn by a power of
        their likelihood."""
        exponent = current_settings().likely_share_exponent
        shares = (exponent * candidates.within_walls()).softmax(dim=0)
        drawn = torch.multinomial(shares, count, replacement=True, generator=generator)
        return self._around(camera_positions(candidates.viewmats)[drawn], generator)

    def _around(self, places: Tensor, generator: torch.Generator) -> Tensor:
        """Cameras (C, 4, 4) near places (C, 3), above the floor, that look at random Gaussians."""
        up = self.up.direction
        offsets = torch.randn(len(places), 3, generator=generator, **DOUBLES)
        eyes = places + current_settings().place_deviation * offsets
        eyes = eyes + (self._floor - eyes @ up).clamp_min(0)[:, None] * up
        targets = self.few.means[self._some_targets(len(places), generator)]
        return look_at(eyes, targets.double(), up)

    def _some_targets(self, count: int, generator: torch.Generator) -> Tensor:
        """Indices (count,) of random target Gaussians, with equal probabilities."""
        return self._targets[
            torch.randint(len(self._targets), (count,), generator=generator, device="cpu")
        ]
