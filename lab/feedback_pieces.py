"""Pieces of scenes for the training of the feedback network: small dense scenes, what they are
merged to, and views of them.

A step in a piece of 600 merged Gaussians and 128 x 72 pixels takes a hundredth of a second on one
core, and pieces differ more than the places of one scene. What a step does to a Gaussian is that of
its whole scene: the rate of the means is a share of the extent of the *scene*, and merged Gaussians
are as large as in the merged scene.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.pipeline.optimiser import extent
from pointsplat_ns.pruning.merging import merge
from pointsplat_ns.refinement.scene_cut import cut_scene
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.sizes import (
    RESOLUTION,
    middle_side,
    several_sizes,
    subsampled,
)
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.files import one_line, write_tensors
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.settings import current_settings, use_settings


@dataclass(frozen=True)
class PieceSettings:
    """Settings of the pieces."""

    merged: int = 600
    """Merged Gaussians of a piece. Its dense ones are as many as this divided by the share kept."""
    most_dense: int = 20_000
    """Maximum number of dense Gaussians of a piece."""
    fewest_merged: int = 50
    """Pieces with fewer merged Gaussians are left out."""
    views: int = 48
    """Sampled views of a piece."""
    candidates_per_view: int = 2
    """Candidates for each of them; a piece is small, and its views need not be the best."""
    held_out: int = 8
    """Of these, views that measure and take no part in steps."""
    drawn_side: int = 128
    """Longer side of the subsampled pictures, pixels."""


PIECES = PieceSettings()

MEMBERS = 5
"""Columns of :func:`member_features`."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a dense scene, merged."""

    name: str
    dense: Gaussians
    merged: Gaussians  # K Gaussians
    members: Tensor  # [K, MEMBERS] float32, see member_features
    viewmats: Tensor  # [C, 4, 4] float64
    Ks: Tensor  # [C, 3, 3] float64, pixels at RESOLUTION
    near_plane: float  # scene units
    reach: float  # extent of the merged whole scene, scene units
    psnr: float
    """PSNR of the merged piece over the pixels that the dense one covers, dB."""
    _sizes: list[tuple[Views, Views, Views]] = field(default_factory=list)
    _targets: dict[tuple[int, int], Tensor] = field(default_factory=dict)

    def view(self, index: int, size: int) -> View:
        """A view, subsampled from a picture of one of three sizes."""
        if not self._sizes:
            whole = views_of(self.viewmats, self.Ks, self.near_plane)
            self._sizes.append(several_sizes(whole, PIECES.drawn_side))
        return self._sizes[0][size][index]

    @torch.no_grad()
    def target(self, index: int, size: int, backend: Literal["torch", "auto"] = "torch") -> Tensor:
        """Render of the dense piece in a view, (H, W, 3); drawn once, kept with 8 bits."""
        key = index, size
        if key not in self._targets:
            image = render(self.dense, self.view(index, size), backend=backend)
            self._targets[key] = image.clamp(0, 1).mul(255).round().byte()
        return self._targets[key] / 255

    def to(self, device: torch.device) -> Piece:
        """The piece on a device."""
        return Piece(
            name=self.name,
            dense=self.dense.to(device),
            merged=self.merged.to(device),
            members=self.members.to(device),
            viewmats=self.viewmats,
            Ks=self.Ks,
            near_plane=self.near_plane,
            reach=self.reach,
            psnr=self.psnr,
        )

    def write(self, path: Path, key: str) -> None:
        """Write a file that :meth:`read` reads again with the same key."""
        tensors = {
            f"{which}.{name}": value
            for which, scene in (("dense", self.dense), ("merged", self.merged))
            for name, value in scene.items()
        }
        tensors |= {"members": self.members, "viewmats": self.viewmats, "Ks": self.Ks}
        about = {
            "name": self.name,
            "near_plane": self.near_plane,
            "reach": self.reach,
            "psnr": self.psnr,
            "traits": {"antialiased": self.dense.antialiased},
        }
        write_tensors(path, tensors, {"piece": key, "about": json.dumps(about)})

    @classmethod
    def read(cls, path: Path, key: str) -> Piece | None:
        """The piece of a file; None if there is none, it is damaged, or of another key."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, "pt") as file:
                header = file.metadata() or {}
                if header.get("piece") != key:
                    return None
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            about = json.loads(header["about"])
            traits = about.pop("traits")
            dense, merged = (
                Gaussians(**{name: tensors[f"{which}.{name}"] for name in PARAMETERS}, **traits)
                for which in ("dense", "merged")
            )
            rest = {name: tensors[name] for name in ("members", "viewmats", "Ks")}
            return cls(dense=dense, merged=merged, **rest, **about)
        except (OSError, KeyError, ValueError, TypeError, SafetensorError, PointSplatError):
            return None


def views_of(viewmats: Tensor, Ks: Tensor, near_plane: float) -> Views:
    """Views of :data:`RESOLUTION` over black."""
    return Views(viewmats, Ks, *RESOLUTION, torch.zeros(3), near_plane=near_plane)


def pieces_of(
    name: str,
    scene: Gaussians,
    keep: Sequence[float],
    count: int,
    folder: Path,
    seed: int = 0,
) -> Iterator[Piece]:
    """Pieces of a scene, evenly spread over it; each is made once, and kept as a file. A piece that
    is too small or that no view shows is left out, with one line.

    Args:
        name: name of the scene.
        scene: N Gaussians on the CPU.
        keep: shares that pieces are merged to, in turns.
        count: number of pieces.
        folder: folder of the files.
        seed: determines planes and views.
    """
    scene = scene[scene.usable()]
    digest = hashlib.sha256(repr((PIECES, seed)).encode())
    for value in scene.tensors():
        digest.update(value.contiguous().numpy().tobytes())
    scene_key = digest.hexdigest()
    reach = extent(scene)
    for number in range(count):
        share = keep[number % len(keep)]
        of_share = number // len(keep)
        total = len(range(number % len(keep), count, len(keep)))
        path = folder / f"{name}_{number}.safetensors"
        key = f"{scene_key} {share} {number} {total}"
        piece = Piece.read(path, key)
        if piece is None:
            try:
                members = _members(scene, share, of_share, total, seed + number)
                piece = _made(
                    f"{name}, piece {number}", scene[members], share, reach, seed + number
                )
            except (DataError, PointSplatError) as error:
                print(f"{name}, piece {number}: left out ({one_line(error)})", flush=True)
                continue
            piece.write(path, key)
        yield piece


def _members(scene: Gaussians, share: float, number: int, total: int, seed: int) -> Tensor:
    """Indices of the Gaussians of one piece of a cut; pieces follow one another in space."""
    most = min(round(PIECES.merged / share), PIECES.most_dense)
    cut = cut_scene(scene.means, most, seed)
    chosen = (2 * number + 1) * cut.count // (2 * total)
    return (cut.pieces_of(scene.means) == chosen).nonzero()[:, 0]


def _made(name: str, dense: Gaussians, share: float, reach: float, seed: int) -> Piece:
    count = round(share * len(dense))
    if count < PIECES.fewest_merged:
        raise DataError(f"{count} merged Gaussians; expected at least {PIECES.fewest_merged}")
    few = replace(current_settings(), candidates_per_view=PIECES.candidates_per_view)
    with use_settings(few):
        sampler = Sampler(dense)
        sampled = sampler.views(PIECES.views, seed)
        merged = merge(dense, count, views=sampler)
    middle = subsampled(sampled[: PIECES.held_out], middle_side(sampled), PIECES.drawn_side)
    return Piece(
        name=name,
        dense=dense,
        merged=merged.scene,
        members=member_features(dense, merged.scene, merged.assignment),
        viewmats=sampled.viewmats,
        Ks=sampled.Ks,
        near_plane=sampled.near_plane,
        reach=reach,
        psnr=DenseReference(dense, middle).psnr(merged.scene)[0],
    )


def member_features(dense: Gaussians, merged: Gaussians, assignment: Tensor) -> Tensor:
    """Features of the dense Gaussians that each merged one stands for, of order 1.

    Columns: logarithm of their number; logarithm of the root mean square distance of their means
    from the merged one's, in its mean standard deviation; logarithm of their mean size in the same
    unit; standard deviations of opacity and of colour.

    Args:
        dense: N Gaussians.
        merged: K Gaussians.
        assignment: (N,) index of the merged Gaussian of each; -1 for none.

    Returns:
        (K, 5) float32, finite.
    """
    rows = (assignment >= 0).nonzero()[:, 0]
    group = assignment[rows]
    number = torch.bincount(group, minlength=len(merged)).clamp_min(1)[:, None].to(dense.means)

    def mean(values: Tensor) -> Tensor:
        """Mean of (n, D) over the members of each. # [K, D]"""
        return values.new_zeros(len(merged), values.shape[1]).index_add_(0, group, values) / number

    own = merged.scales.mean(1, keepdim=True)
    apart = (dense.means[rows] - merged.means[group]).square().sum(1, keepdim=True)
    spread = 0.5 * (mean(apart) + 1e-30).log() - own
    sizes = mean(dense.scales[rows].mean(1, keepdim=True)) - own
    alphas = dense.alphas[rows].view(-1, 1)
    colours = dense.features_dc[rows]
    deviations = [
        (mean(values.square()) - mean(values).square()).clamp_min(0).mean(1, keepdim=True).sqrt()
        for values in (alphas, colours)
    ]
    columns = [number.log() / 2, spread.clamp(-8, 8) / 2, sizes.clamp(-8, 8) / 2, *deviations]
    return torch.cat(columns, dim=1).float().clamp(-8, 8).nan_to_num(0.0)
