"""What scenes lose in each format that is written: bytes, seconds, PSNR of renders, and errors of the numbers.

    python -m lab.numerics.formats
    python -m lab.numerics.formats outputs/fox/splatfacto-cpu/RUN
    python -m lab.numerics.formats --splat-transform node_modules/.bin/splat-transform

PSNR is over all pixels of twelve sampled views, of what is read back against the scene's own renders. With
splat-transform, the files that it writes on the CPU are measured by the same reader.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import markdown, number, start
from lab.common.results import Row, grouped, write_json
from lab.common.scenes import name_of
from lab.common.timing import seconds_of
from pointsplat_ns.geometry.transforms import zero_as_identity
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.spz import SH_BITS, encode_spz
from pointsplat_ns.looking.closeness import DenseReference

VIEWS, SEED = 12, 1
SPZ_4 = {"v4.spz": SH_BITS, "coarse.spz": (5, 4), "fine.spz": (8, 8)}
"""Bits of SH of the files of version 4; the format's own programs keep 5 and 4."""

WRITTEN = ("a.ply", "a.compressed.ply", "a.spz", *SPZ_4, "a.sog", "a.splat")
OF_SPLAT_TRANSFORM = ("a.compressed.ply", "a.spz", "a.sog")


def measure(scene: ps.Gaussians, name: str, peer: Path | None) -> Iterator[Row]:
    """A row for each format; numbers are compared only where the order of Gaussians is known."""
    reference = DenseReference(scene, ps.sample_views(scene, VIEWS, seed=SEED))

    def row(label: str, path: Path, writing: float) -> Row:
        back: list[ps.Gaussians] = []
        reading = seconds_of(lambda: back.append(ps.load(path)))
        size, about = path.stat().st_size, {"scene": name, "format": label, "writing": writing, "reading": reading}
        known = {"bytes": size, "bytes_each": size / len(back[0]), "psnr": reference.psnr(back[0])[0], "errors": {}}
        if label.endswith("splat-transform"):
            return about | known
        order = format_to_write(path).order
        return about | known | {"errors": errors(scene if order is None else scene[order(scene)], back[0])}

    with tempfile.TemporaryDirectory() as folder:
        for file in WRITTEN:
            path, bits = Path(folder) / file, SPZ_4.get(file)
            if bits is None:
                label = format_to_write(path).name + " 3" * (file == "a.spz")
                yield row(label, path, seconds_of(lambda path=path: ps.save(scene, path)))
            else:
                write = lambda path=path, bits=bits: path.write_bytes(encode_spz(scene, version=4, sh_bits=bits))  # noqa: E731
                yield row(f"SPZ 4, SH of {bits[0]} and {bits[1]} bits", path, seconds_of(write))
        for file in OF_SPLAT_TRANSFORM if peer is not None else ():
            path = Path(folder) / f"peer_{file}"
            command = [str(peer), "-w", "-g", "cpu", str(Path(folder) / "a.ply"), str(path)]
            writing = seconds_of(lambda command=command: subprocess.run(command, check=True, capture_output=True))
            yield row(f"{format_to_write(path).name}, by splat-transform", path, writing)


def errors(before: ps.Gaussians, after: ps.Gaussians) -> dict[str, tuple[float, float]]:
    """Greatest and mean differences of two scenes in the same order."""
    one, other = (torch.nn.functional.normalize(zero_as_identity(s.quats).double(), dim=1) for s in (before, after))
    apart = torch.minimum((one - other).norm(dim=1), (one + other).norm(dim=1))  # q and -q are one rotation
    differences = {
        "position": (before.means - after.means).norm(dim=1),
        "log-scale": (before.scales - after.scales).abs(),
        "rotation, degrees": 4 * torch.asin(apart / 2).rad2deg(),
        "opacity": (before.alphas - after.alphas).abs(),
        "SH constant": (before.features_dc - after.features_dc).abs(),
    }
    if before.sh_degree == after.sh_degree > 0:
        differences["SH, others"] = (before.features_rest - after.features_rest).abs()
    return {name: (float(value.max()), float(value.double().mean())) for name, value in differences.items()}


def tables(rows: list[Row]) -> str:
    """Two Markdown tables for each scene: files, and errors of numbers."""
    parts = []
    for scene, mine in grouped(rows, lambda row: row["scene"]).items():
        columns = {"bytes": number(2, 1e-6), **dict.fromkeys(("bytes_each", "psnr", "writing", "reading"), number(1))}
        lines = [[row["format"], *(write(row[name]) for name, write in columns.items())] for row in mine]
        parts.append(markdown([scene, "MB", "bytes each", "PSNR, dB", "writing, s", "reading, s"], lines))
        names = list(mine[0]["errors"])
        lines = [
            [row["format"], *("{:.2g}, {:.2g}".format(*found[n]) if n in found else "left out" for n in names)]
            for row in mine
            if (found := row["errors"])
        ]
        parts.append(markdown([f"{scene}: max, mean", *names], lines))
    return "\n\n".join(parts)


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (), splat_transform: Path | None = None, json: Path | None = None
) -> None:
    """Print tables of what formats lose.

    Args:
        scenes: files or runs; by default the scene that ships.
        splat_transform: the program, to measure its files too.
        json: write all figures here.
    """
    rows: list[Row] = []
    for path in scenes or (None,):
        scene, name = (ps.example_room(), "example room") if path is None else (ps.load(path), name_of(path))
        rows += measure(scene, name, splat_transform)
        write_json(json, rows)
    print(tables(rows))


if __name__ == "__main__":
    start(main)
