"""Draws the pictures of the documentation's concepts, all from the room that ships.

    python -m lab.docs_pictures                  # all of them, to docs/concepts
    python -m lab.docs_pictures --only budgets   # one

Each is made by the functions that its page is about; figures in the titles are measured while drawing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from torch import Tensor

import pointsplat_ns as ps
from lab.common.printing import save_figure, start
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.looking.sampling import Sampler

SHOWN = 0
"""Index of the sampled view that most pictures show."""

WIDTH, HEIGHT = 400, 300

OPAQUE = 8.0
"""An opacity, as logit, that hides what is behind."""

Images = Sequence[Sequence[Tensor]]


@functools.cache
def room() -> ps.Gaussians:
    return ps.example_room()


@functools.cache
def views() -> ps.Views:
    return ps.sample_views(room(), 12, WIDTH, HEIGHT)


@functools.cache
def smaller(keep: str, by: str = "merge") -> ps.Gaussians:
    return ps.prune(room(), keep, by)


def drawn(scene: ps.Gaussians, index: int = SHOWN) -> Tensor:
    return ps.render(scene, views()[index])


def psnr_of(scene: ps.Gaussians) -> float:
    """Over all pixels of all views, dB."""
    errors = [(drawn(scene, i) - drawn(room(), i)).double().square().mean() for i in range(len(views()))]
    return -10 * math.log10(torch.stack(errors).mean().item())


def as_ellipsoids(scene: ps.Gaussians, size: float = 0.6) -> ps.Gaussians:
    """The Gaussians as opaque bodies of so many standard deviations."""
    return scene.replace(scales=scene.scales + math.log(size), opacities=torch.full_like(scene.opacities, OPAQUE))


def as_points(scene: ps.Gaussians, size: float = 0.006) -> ps.Gaussians:
    """The Gaussians' centres as opaque balls of one size, scene units."""
    return scene.replace(
        scales=torch.full_like(scene.scales, math.log(size)), opacities=torch.full_like(scene.opacities, OPAQUE)
    )


def closer(image: Tensor, zoom: int = 2) -> Tensor:
    """The middle of an image, enlarged without smoothing."""
    height, width = image.shape[0] // zoom, image.shape[1] // zoom
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    part = image[top : top + height, left : left + width]
    return part.repeat_interleave(zoom, 0).repeat_interleave(zoom, 1)


def heat(values: Tensor, most: float) -> Tensor:
    """Values (H, W) as colours, black to white."""
    from matplotlib import colormaps

    shares = (values / most).clamp(0, 1).numpy()
    return torch.from_numpy(np.asarray(colormaps["inferno"](shares))[..., :3])


def grid(rows: Images, titles: Sequence[str], path: Path) -> None:
    """Images of one size side by side, a title above each of the first row."""
    across = 3.4 if len(titles) < 4 else 2.9  # inches
    figure = Figure(figsize=(across * len(titles), (0.75 * across) * len(rows) + 0.7), layout="constrained")
    for axes, images in zip(figure.subplots(len(rows), len(titles), squeeze=False), rows, strict=True):
        for axis, image in zip(axes, images, strict=True):
            axis.imshow(np.asarray(image.clamp(0, 1)))
            axis.set_axis_off()
    for axis, title in zip(figure.axes, titles, strict=False):
        axis.set_title(title, fontsize=12 if len(titles) < 4 else 14)
    save_figure(figure, path, dpi=100, pil_kwargs={"quality": 82, "optimize": True})


def splats(path: Path) -> None:
    """What a Gaussian splat is: centres, bodies, and the sum of both."""
    scenes = (as_points(room()), as_ellipsoids(room()), room())
    titles = [f"centres of {len(room()):,} Gaussians", "bodies, cut off and opaque", "drawn: soft, summed"]
    grid([[drawn(scene) for scene in scenes], [closer(drawn(scene)) for scene in scenes]], titles, path)


def methods(path: Path) -> None:
    """A tenth by scores and by merging."""
    chosen = {"all": room(), "merge": smaller("10%"), "coverage": smaller("10%", "coverage")}
    chosen["paper"] = smaller("10%", "paper")
    titles = [f"all: {len(room()):,}", *(f"{name}: {psnr_of(chosen[name]):.1f} dB" for name in list(chosen)[1:])]
    rows = [[drawn(scene) for scene in chosen.values()], [drawn(as_ellipsoids(scene)) for scene in chosen.values()]]
    grid(rows, titles, path)


def budgets(path: Path) -> None:
    """The same room at four budgets."""
    from pointsplat_ns.pruning import ply_bytes

    scenes = [smaller(keep) for keep in ("50%", "30%", "10%", "3%")]
    titles = [
        f"{len(scene):,} Gaussians\n{ply_bytes(len(scene), scene.sh_degree) / 1e6:.2f} MB, {psnr_of(scene):.1f} dB"
        for scene in scenes
    ]
    grid([[drawn(scene) for scene in scenes], [closer(drawn(scene)) for scene in scenes]], titles, path)


def sampled(path: Path) -> None:
    """Where the twelve views stand, from above, and what they show."""
    up = Sampler(room()).up.direction
    right = torch.linalg.cross(up, torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64))
    right = right / right.norm()
    plan = torch.stack([right, torch.linalg.cross(up, right)], 1)  # [3, 2]
    height = room().means.double() @ up
    below = height < height.quantile(0.85)  # without the ceiling
    flat = (room().means.double()[below] @ plan).numpy()
    colours = (0.5 + 0.2820948 * room().features_dc[below]).clamp(0, 1).numpy()
    poses = invert_rigid(views().viewmats.double())
    eyes, ahead = poses[:, :3, 3] @ plan, poses[:, :3, 2] @ plan
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    left, panels = figure.subfigures(1, 2, width_ratios=(1, 1.75))
    axis = left.subplots()
    axis.scatter(*flat.T, s=1.6, c=colours, linewidths=0, alpha=0.8)
    axis.quiver(*eyes.T.numpy(), *ahead.T.numpy(), color="crimson", scale=12, width=0.008)
    for number, eye in enumerate(eyes.tolist(), 1):
        text = axis.annotate(f"{number}", eye, fontsize=12, color="crimson", xytext=(4, 4), textcoords="offset points")
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    axis.set_aspect("equal")
    axis.set_axis_off()
    axis.set_title("the room from above, and twelve cameras", fontsize=13)
    for number, axis in enumerate(panels.subplots(3, 4).flat, 1):
        axis.imshow(np.asarray(drawn(room(), number - 1).clamp(0, 1)))
        axis.set_title(f"{number}", fontsize=11, color="crimson", pad=2)
        axis.set_axis_off()
    save_figure(figure, path, dpi=100, pil_kwargs={"quality": 82, "optimize": True})


def repaired(path: Path) -> None:
    """A tenth before and after the repair, and where each is wrong."""
    result = ps.compact(room(), keep="10%")
    scenes = {"merged to a tenth": result.pruned, "and repaired": result.scene}
    images = {name: drawn(scene) for name, scene in scenes.items()}
    titles = ["all Gaussians", *(f"{name}: {psnr_of(scene):.1f} dB" for name, scene in scenes.items())]
    errors = [(image - drawn(room())).abs().mean(-1) for image in images.values()]
    legend = torch.ones(HEIGHT, WIDTH, 3)
    bar = heat(torch.linspace(0, 1, WIDTH - 80).repeat(24, 1), 1)
    legend[HEIGHT // 2 - 12 : HEIGHT // 2 + 12, 40:-40] = bar
    grid([[drawn(room()), *images.values()], [legend, *(heat(error, 0.25) for error in errors)]], titles, path)


def layers(path: Path) -> None:
    """What the rasterizer gives: colour, depth, how much is covered, and what float32 makes of it."""
    view = views()[SHOWN]

    def rasterized(scene: ps.Gaussians) -> tuple[Tensor, Tensor]:
        sh = torch.cat([scene.features_dc[:, None], scene.features_rest], 1)
        image, alpha, _ = ps.rasterization(
            scene.means, scene.quats, scene.scales.exp(), scene.opacities.sigmoid()[:, 0], sh,
            view.viewmat[None].to(scene.means.dtype), view.K[None].to(scene.means.dtype), view.width, view.height,
            sh_degree=scene.sh_degree, render_mode="RGB+ED",
        )  # fmt: skip
        return image[0].double(), alpha[0, ..., 0].double()

    with torch.no_grad():
        image, alpha = rasterized(room())
        exact, _ = rasterized(room().to(torch.float64))
    depth = image[..., 3]
    worst = (image[..., :3] - exact[..., :3]).abs().amax(-1)
    digits = (worst.clamp_min(1e-8).log10() + 8) / 4  # 1e-8 is black, 1e-4 and more white
    titles = ["colour", f"depth, 0 to {depth.max():.1f} units", f"not covered, 0 to {1 - alpha.min():.2f}"]
    titles.append("error of float32")
    shown = [image[..., :3].float(), heat(depth, depth.max().item()), heat(1 - alpha, (1 - alpha).max().item())]
    grid([[*shown, heat(digits, 1.0)]], titles, path)


PICTURES: dict[str, Callable[[Path], None]] = {
    draw.__name__: draw for draw in (splats, methods, budgets, sampled, repaired, layers)
}


def main(folder: Path = Path("docs/concepts"), only: tuple[str, ...] = ()) -> None:
    """Draw pictures of the documentation.

    Args:
        folder: where they go.
        only: names of some; by default all.
    """
    for name in only or PICTURES:
        PICTURES[name](folder / f"{name}.jpg")


if __name__ == "__main__":
    start(main)
