"""What each way to be less exact gains and loses: time against error, one image at a time.

    python benchmarks/quality.py SCENE... --plot quality.png

For the synthetic room and each trained scene, dense and pruned to a tenth: the lowest alpha drawn, the transmittance at
which a pixel is finished, and the degree of the spherical harmonics, each moved alone, then the named qualities. Speed
is that of inference against the exact image, the fastest of some rounds taken in turn.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table
from scenes import Scene, room_scene, trained_scenes

from pointsplat_ns.metrics import psnr
from pointsplat_ns.rasterizer import rasterization
from pointsplat_ns.rasterizer.constants import EXACT, QUALITIES, Quality


@dataclass(frozen=True)
class Setting:
    """One point of one curve."""

    knob: str
    value: str
    quality: Quality = EXACT
    sh_degree: int = 3


SETTINGS = [
    Setting("exact", "", EXACT),
    *(Setting("lowest alpha", f"{a}/255", Quality(alpha_min=a / 255)) for a in (2, 3, 4, 6, 8, 12, 16)),
    *(Setting("stop below", f"{t:g}", Quality(transmittance_min=t)) for t in (1e-3, 3e-3, 1e-2, 3e-2)),
    *(Setting("SH degree", str(degree), EXACT, degree) for degree in (2, 1, 0)),
    *(Setting("named", name, quality) for name, quality in QUALITIES.items() if name != "exact"),
]


def measure(scene: Scene, width: int, height: int, rounds: int) -> list[dict]:
    """One row for each setting."""
    K, tensors = scene.K(width, height), [t.detach() for t in scene.tensors]

    def draw(setting: Setting) -> torch.Tensor:
        options = {"sh_degree": setting.sh_degree, "quality": setting.quality}
        with torch.inference_mode():
            return rasterization(*tensors, scene.viewmat[None], K[None], width, height, **options)[0].clamp(0, 1)

    images = [draw(setting) for setting in SETTINGS]
    best = [float("inf")] * len(SETTINGS)
    for _ in range(rounds):
        for i, setting in enumerate(SETTINGS):
            start = time.perf_counter()
            draw(setting)
            best[i] = min(best[i], time.perf_counter() - start)
    rows = []
    for setting, image, seconds in zip(SETTINGS, images, best, strict=True):
        same = torch.equal(image, images[0])
        rows.append({
            "scene": scene.name, "knob": setting.knob, "value": setting.value,
            "seconds": seconds, "speed": best[0] / seconds,
            "psnr": None if same else float(psnr(image, images[0])),
            "largest": float((image - images[0]).abs().max()),
        })  # fmt: skip
    return rows


def plot(rows: list[dict], path: Path) -> None:
    """Speed against PSNR, a line for each knob, a panel for each scene."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, axes = plt.subplots(1, len(scenes), figsize=(4 * len(scenes), 3.6), squeeze=False, layout="constrained")
    for axis, scene in zip(axes[0], scenes, strict=True):
        for knob in dict.fromkeys(row["knob"] for row in rows):
            line = [row for row in rows if row["scene"] == scene and row["knob"] == knob and row["psnr"] is not None]
            style = "*" if knob == "named" else "o-"
            axis.plot([row["psnr"] for row in line], [row["speed"] for row in line], style, label=knob, markersize=5)
        axis.set(title=scene, xlabel="PSNR against exact, dB", ylabel="speed against exact")
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main(
    scenes: tuple[Path, ...] = (),
    /,
    size: tuple[int, int] = (640, 480),
    rounds: int = 5,
    json_file: Path | None = None,
    plot_file: Path | None = None,
) -> None:
    """Measure what each way to be less exact gains and loses.

    Args:
        scenes: trained Splatfacto runs (folder or config.yml).
        size: width and height, pixels.
        rounds: of which the fastest counts.
        json_file: write the rows there.
        plot_file: draw the curves there.
    """
    todo = [room_scene(200_000)] + [scene for path in scenes for scene in trained_scenes(path, None, None)]
    rows = [row for scene in todo for row in measure(scene, *size, rounds)]
    table = Table("scene", "knob", "value", "ms", "speed", "PSNR, dB", "largest error")
    for row in rows:
        level = "" if row["psnr"] is None else f"{row['psnr']:.1f}"
        ms, speed = f"{1e3 * row['seconds']:.0f}", f"{row['speed']:.2f}"
        table.add_row(row["scene"], row["knob"], row["value"], ms, speed, level, f"{row['largest']:.3f}")
    Console().print(table)
    if json_file:
        json_file.write_text(json.dumps(rows, indent=1))
    if plot_file:
        plot(rows, plot_file)


if __name__ == "__main__":
    tyro.cli(main)
