"""Does a scene tell where its photos were taken? Runs know; their Gaussians are asked.

    python -m lab.training.photo_places RUN... [--picture photo_places.jpg]
    python -m lab.training.photo_places RUN... --sh 0      # by sizes, as if there were no SH

For each run: the evidence of the best place (explained energy of the SH, at least 2 in a scene that tells; without SH,
correlation of sizes and distances, at least 0.48); the distance from a training pose of the places found, by their
shares, and of random places, in shares of the content's diagonal; and how often a training pose has more evidence than
a random place. The picture shows the evidence from above, at the height of the training poses, with these in red, and
some Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

import pointsplat_ns as ps
from lab.common.printing import markdown, save_figure, start
from lab.common.scenes import name_of
from pointsplat_ns.gaussians import MAX_SH_DEGREE
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.looking.content import content_size
from pointsplat_ns.looking.traces import PhotoEvidence, photo_places
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.pruning import cut_sh

ANY = 500
"""Number of places that the poses are compared with."""

CELLS = 48
"""Side of the maps."""


@dataclass(frozen=True, eq=False)
class Map:
    """What explains the SH at one height, seen from above."""

    name: str
    evidence: Tensor  # [CELLS, CELLS]
    extent: float  # half of its side
    eyes: Tensor  # [E, 2]
    gaussians: Tensor  # [n, 2]


@torch.no_grad()
def asked(run: Path, sh: int) -> Map:
    """Print a row about a run, of at most an SH degree, and give its map."""
    dense, poses = ps.load(run), dataset_views(run, "train")
    dense = cut_sh(dense, sh) if dense.sh_degree > sh else dense
    eyes = invert_rigid(poses.viewmats.double())[:, :3, 3]
    generator = torch.Generator().manual_seed(0)
    evidence = PhotoEvidence.of(dense, generator)
    if len(evidence.means) == 0:
        raise SystemExit(f"{run} has no opaque Gaussian")
    size = content_size(dense)[1]
    anywhere = evidence.candidates(ANY, torch.Generator().manual_seed(0))
    found = photo_places(evidence, generator)
    at_eyes, at_any = evidence.at(eyes), evidence.at(anywhere)
    more = (at_eyes[:, None] > at_any).float().mean()
    away = float(torch.cdist(anywhere, eyes).amin(1).mean()) / size
    distance = "not sure"
    if found is not None and found.sure:
        distance = f"{float((found[1] * torch.cdist(found[0], eyes).amin(1)).sum()) / size:.1%}"
    best = float(torch.cat([at_eyes, at_any]).max())
    cells = (name_of(run), f"{best:.2f}", distance, f"{away:.1%}", f"{more:.0%}")
    print(f"| {' | '.join(cells)} |", flush=True)
    return mapped(name_of(run), evidence, eyes)


def mapped(name: str, evidence: PhotoEvidence, eyes: Tensor) -> Map:
    """The map of a scene; the axis along which its poses spread least is taken to be upright."""
    middle = eyes.mean(0)
    axes = torch.linalg.svd(eyes - middle, full_matrices=True).Vh[:2]  # level, as far as the poses are
    at, gaussians = (eyes - middle) @ axes.T, (evidence.means - middle) @ axes.T
    extent = 1.15 * float(torch.cat([gaussians.abs().quantile(0.8, dim=0), at.abs().amax(0)]).max())
    line = torch.linspace(-extent, extent, CELLS, dtype=torch.float64)
    cells = torch.cartesian_prod(line, line).flip(1)  # rows from bottom to top
    return Map(name, evidence.at(middle + cells @ axes).view(CELLS, CELLS), extent, at, gaussians)


def draw(maps: list[Map], path: Path) -> None:
    """Maps beside one another, as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6 * len(maps), 3.9), layout="constrained")
    for axes, drawn in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
        side = (-drawn.extent, drawn.extent)
        axes.imshow(drawn.evidence, origin="lower", extent=(*side, *side))
        axes.scatter(*drawn.gaussians[::3].T, s=1, c="white", alpha=0.35, linewidths=0)
        axes.scatter(*drawn.eyes.T, s=9, c="red", linewidths=0)
        axes.set(xlim=side, ylim=side, xticks=[], yticks=[], title=drawn.name)
    save_figure(figure, path, dpi=100)


def main(runs: tyro.conf.Positional[tuple[Path, ...]], picture: Path | None = None, sh: int = MAX_SH_DEGREE) -> None:
    """Print a table, and draw maps if asked to.

    Args:
        runs: trained runs whose data is at hand.
        picture: file to draw the maps into.
        sh: cut scenes to this SH degree first.
    """
    print(markdown(["", "explained, best place", "from a pose", "any place", "poses explain more"], []), flush=True)
    maps = [asked(run, sh) for run in runs]
    if picture is not None:
        draw(maps, picture)


if __name__ == "__main__":
    start(main)
