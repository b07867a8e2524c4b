"""Writes the record of what with_photos.py measured: a page, and the rows as JSON.

python -m lab.training.with_photos_record with_photos.json
"""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

import tyro

from lab.common.printing import markdown, start
from lab.common.results import Row, grouped
from lab.judge.record import ROOT, read, write_rows
from lab.training.with_photos import CAP_LONG, CAP_SHORT, COMPACTED, COMPACTED_LONG, DENSE, METHODS, SCORES
from pointsplat_ns.io.files import replacing

PAGE = f"""# With the photos at hand

`lab/training/with_photos.py` measures who has the photos, and wants few Gaussians; `lab/training/with_photos_record.py`
writes this page from [with_photos.json](with_photos.json). Constants of `compact --photos` and of the training with a
cap are chosen on fox, kitchen and vr_project. The others judge.

- PSNR, SSIM and LPIPS are means over all held-out photos, at the size of the photos that the dense scene is trained on.
- CPU s are CPU seconds of a process on one thread, with starting, reading and writing. "With dense" adds those of the
  dense training, which all ways need but the training with a cap.
- `{COMPACTED}` merges, repairs and trains on the training photos for 1,200 steps. "{COMPACTED_LONG}" trains on
  them for as many seconds (`--seconds`) of the clock as the dense training took of the processor: about half
  as many CPU seconds.
- "{SCORES["lightgaussian"]}" and "{SCORES["pup"]}" keep the Gaussians with the highest scores and train
  them on the photos as `{COMPACTED}` does, with its splits and merges, for as many CPU seconds as
  `{COMPACTED}` takes in all; reading and scores come on top. The methods' own schedules are longer.
- "cap" is `ns-train splatfacto-cpu --pipeline.model.max-gs-num` from the start. "{CAP_SHORT}" takes about the CPU
  seconds of `{COMPACTED}`; "{CAP_LONG}" those of `{COMPACTED}` and of the dense training.
- A way without a row was not measured there.
- The machine was busy: CPU seconds of equal work differ by up to a half.
- OpenSplat is not measured: at commit 15b7e80 it has no limit of Gaussians.
"""

HEADS = ("kept", "way", "Gaussians", "CPU s", "with dense", "PSNR", "SSIM", "LPIPS")


def page(rows: list[Row]) -> str:
    """The page of all tables."""
    parts = [PAGE.strip()]
    leads = lead_table(rows)
    if leads:
        parts.append(f"## Lead of `{COMPACTED}`\n\nPSNR in dB above each way, mean (smallest to largest):\n\n{leads}")
    for scene, same in sorted(grouped(rows, lambda row: row["scene"]).items()):
        first = same[0]
        size = f"{first['width']} x {first['height']}"
        parts.append(
            f"## {scene}\n\nDense: {first['steps']:,} steps. {first['photos']} held-out photos of {size}.\n\n"
            + scene_table(same)
        )
    return "\n\n".join(parts) + "\n"


def scene_table(rows: list[Row]) -> str:
    """All ways for one capture, by budget."""
    dense = next(row for row in rows if row["method"] == DENSE)
    lines = []
    for row in sorted(rows, key=lambda row: (-row["keep"], METHODS.index(row["method"]))):
        with_dense = row["cpu_seconds"] + (dense["cpu_seconds"] if row["needs_dense"] else 0.0)
        cells = [f"{100 * row['keep']:g} %", row["method"], f"{row['count']:,}"]
        cells += [f"{row['cpu_seconds']:,.0f}", f"{with_dense:,.0f}", f"{row['psnr']:.2f}", f"{row['ssim']:.3f}"]
        lines.append([*cells, f"{row['lpips']:.3f}" if "lpips" in row else "-"])
    return markdown(HEADS, lines)


def lead_table(rows: list[Row]) -> str:
    """How much better ``compact --photos`` is than each way, over captures; empty if it has no row."""
    psnrs = {(row["scene"], row["keep"], row["method"]): row["psnr"] for row in rows}
    for scene, keep, method in list(psnrs):
        if method == DENSE:
            psnrs |= {(scene, other, DENSE): psnrs[scene, keep, DENSE] for other in {row["keep"] for row in rows}}
    keeps = sorted({row["keep"] for row in rows if row["method"] == COMPACTED}, reverse=True)
    lines = []
    for method in METHODS:
        cells = []
        for keep in keeps if method != COMPACTED else ():
            leads = [
                psnr - psnrs[scene, keep, method]
                for (scene, at, way), psnr in psnrs.items()
                if (at, way) == (keep, COMPACTED) and (scene, keep, method) in psnrs
            ]
            span = f"{fmean(leads):+.2f} ({min(leads):+.2f} to {max(leads):+.2f})" if leads else "-"
            cells.append(f"{span}, {len(leads)}" if leads else span)
        if any(cell != "-" for cell in cells):
            lines.append([method, *cells])
    return markdown(["over", *(f"{100 * keep:g} %, captures" for keep in keeps)], lines) if lines else ""


def main(files: tyro.conf.Positional[tuple[Path, ...]], record: Path = ROOT / "docs" / "record") -> None:
    """Write the record of what with_photos.py measured.

    Args:
        files: that with_photos.py wrote.
        record: folder for with_photos.json and with_photos.md.
    """
    rows, settings = read(files)
    if not any(row["method"] == DENSE for row in rows):
        raise SystemExit(f"{', '.join(map(str, files))}: no row of a dense scene")
    write_rows(rows, settings, record / "with_photos.json")
    with replacing(record / "with_photos.md") as part:
        part.write_text(page(rows), "utf-8")
    print(record / "with_photos.md")


if __name__ == "__main__":
    start(main)
