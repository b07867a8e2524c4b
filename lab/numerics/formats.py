"""What scenes lose in each format that is written: bytes, seconds, PSNR of renders, and errors of the numbers.

    python benchmarks/formats.py
    python benchmarks/formats.py outputs/fox/splatfacto-cpu/RUN
    python benchmarks/formats.py --splat-transform node_modules/.bin/splat-transform

PSNR is over all pixels of twelve sampled views, of what is read back against the scene's own renders. With
splat-transform, the files that it writes on the CPU are measured by the same reader.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from options import write_whole

import pointsplat_ns as ps
from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.geometry.quaternions import zero_as_identity
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.spz import SH_BITS, write_spz

VIEWS, SEED = 12, 1
SPZ_4 = {"v4.spz": SH_BITS, "coarse.spz": (5, 4), "fine.spz": (8, 8)}
"""Bits of SH of the files of version 4; the format's own programs keep 5 and 4."""

WRITTEN = ("a.ply", "a.compressed.ply", "a.spz", *SPZ_4, "a.sog", "a.splat")
OF_SPLAT_TRANSFORM = ("a.compressed.ply", "a.spz", "a.sog")


@dataclass(frozen=True)
class Row:
    """One scene in one format."""

    scene: str
    format: str
    megabytes: float
    bytes_each: float
    writing: float
    """Seconds."""
    reading: float | None
    """Seconds; None where the order of Gaussians is unknown and reading is not what is measured."""
    psnr: float | None
    errors: dict[str, tuple[float, float]]
    """Greatest and mean error by what is compared."""


def measure(scene: ps.Gaussians, name: str, peer: Path | None) -> Iterator[Row]:
    """A row for each format."""
    reference = DenseReference(scene, ps.sample_views(scene, VIEWS, seed=SEED))
    with tempfile.TemporaryDirectory() as folder:
        for file in WRITTEN:
            path = Path(folder) / file
            kind = format_to_write(path)
            seconds = timed(lambda path=path: save(scene, path))
            start = time.perf_counter()
            back = ps.load(path)
            reading = time.perf_counter() - start
            ordered = scene if kind.order is None else scene[kind.order(scene)]
            bits = SPZ_4.get(file)
            label = f"SPZ 4, SH of {bits[0]} and {bits[1]} bits" if bits else f"{kind.name}{' 3' * (file == 'a.spz')}"
            yield row(name, label, path, seconds, reading, reference.psnr(back)[0], errors(ordered, back))
        for file in OF_SPLAT_TRANSFORM if peer is not None else ():
            path = Path(folder) / f"peer_{file}"
            command = [str(peer), "-w", "-g", "cpu", str(Path(folder) / "a.ply"), str(path)]
            seconds = timed(lambda command=command: subprocess.run(command, check=True, capture_output=True))
            label = f"{format_to_write(path).name}, by splat-transform"
            yield row(name, label, path, seconds, None, reference.psnr(ps.load(path))[0], {})


def save(scene: ps.Gaussians, path: Path) -> None:
    """Write a file; those in :data:`SPZ_4` in version 4."""
    if path.name in SPZ_4:
        write_spz(scene, path, version=4, sh_bits=SPZ_4[path.name])
    else:
        ps.save(scene, path)


def timed(call: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def row(
    scene: str, label: str, path: Path, writing: float, reading: float | None, psnr: float | None, found: dict
) -> Row:
    """A row about a file."""
    size = path.stat().st_size
    return Row(scene, label, size / 1e6, size / len(ps.load(path)), writing, reading, psnr, found)


def errors(before: ps.Gaussians, after: ps.Gaussians) -> dict[str, tuple[float, float]]:
    """Greatest and mean differences of two scenes in the same order."""
    one, other = unit(before), unit(after)
    apart = torch.minimum((one - other).norm(dim=1), (one + other).norm(dim=1))  # q and -q are one rotation
    angles = 4 * torch.asin(apart / 2).rad2deg()
    differences = {
        "position": (before.means - after.means).norm(dim=1),
        "log-scale": (before.scales - after.scales).abs(),
        "rotation, degrees": angles,
        "opacity": (before.alphas - after.alphas).abs(),
        "SH constant": (before.features_dc - after.features_dc).abs(),
    }
    if before.sh_degree == after.sh_degree > 0:
        differences["SH, others"] = (before.features_rest - after.features_rest).abs()
    return {name: (float(value.max()), float(value.double().mean())) for name, value in differences.items()}


def unit(scene: ps.Gaussians) -> torch.Tensor:
    """Quaternions of length 1, float64."""
    return torch.nn.functional.normalize(zero_as_identity(scene.quats).double(), dim=1)


def markdown(rows: list[Row]) -> str:
    """Two tables for each scene: files, and errors of numbers."""
    lines: list[str] = []
    for scene in dict.fromkeys(row.scene for row in rows):
        mine = [row for row in rows if row.scene == scene]
        lines += ["", f"| {scene} | MB | bytes each | PSNR, dB | writing, s | reading, s |", "|---" * 6 + "|"]
        for row in mine:
            reading = "" if row.reading is None else f"{row.reading:.1f}"
            psnr = "" if row.psnr is None else f"{row.psnr:.1f}"
            cells = (row.format, f"{row.megabytes:.2f}", f"{row.bytes_each:.1f}", psnr, f"{row.writing:.1f}", reading)
            lines.append(f"| {' | '.join(cells)} |")
        names = list(mine[0].errors)
        lines += ["", f"| {scene}: max, mean | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
        for row in mine:
            if row.errors:
                cells = [f"{most:.2g}, {mean:.2g}" for most, mean in (row.errors.get(n, (0, 0)) for n in names)]
                cells = [cell if name in row.errors else "left out" for name, cell in zip(names, cells, strict=True)]
                lines.append(f"| {row.format} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    splat_transform: Path | None = None,
    json: Path | None = None,
) -> None:
    """Print tables of what formats lose.

    Args:
        scenes: files or runs; by default the scene that ships.
        splat_transform: the program, to measure its files too.
        json: write all figures here.
    """
    rows: list[Row] = []
    for path in scenes or (None,):
        scene = ps.example_room() if path is None else ps.load(path)
        rows += measure(scene, "example room" if path is None else path.stem, splat_transform)
        write_whole(json, {"rows": [asdict(row) for row in rows]})
    print(markdown(rows))


if __name__ == "__main__":
    tyro.cli(main)
