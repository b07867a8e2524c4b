"""What each setting of merging is worth: scenes are merged with the defaults, and with variants
that turn rules off.

    python -m lab.judge.ablation scenes/bouquet.ply RUN --json ablation.json --resume
    python -m lab.judge.ablation scenes/bouquet.ply --variants no_regrouping neighbours_8 --keep 0.1
    python -m lab.judge.ablation --write ablation.json               # docs/record/ablation.md, from
    one file or several

A PLY is looked at along the camera path of its name in ``lab/judge/paths``, a Splatfacto run from
the poses of its held-out photos. A run is merged twice: without poses, and with those of its
training photos. Choose constants on scenes for tuning (``python -m lab.judge.judge --list``). A new
variant is one line in :data:`VARIANTS`.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import torch
import tyro

from lab.common.printing import markdown, percent, start
from lab.common.results import Results, Row
from lab.common.scenes import group_of, room
from lab.common.ways import count_of
from lab.judge.record import FOLDER, read, write_rows
from lab.judge.scenes import PHOTOS, DenseViews, JudgedScene, check, check_options, known_rows, load
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.pruning.merging import MERGING, MergeSettings, merge
from pointsplat_ns.system.files import replacing
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.view_sampling.settings import DEFAULT_SETTINGS, use_settings

BASELINE = "default"
"""Name of the settings that all variants are compared with."""

VARIANTS: dict[str, dict[str, Any]] = {
    "no_renders": dict(min_count_rendered=10**9),
    "reference_20k": dict(max_count_rendered=20_000),
    "sampled_views_24": dict(sampled_views=24),
    "other_views": dict(view_seed=2),
    "visibility_views_16": dict(visibility_views=16),
    "drawn_100k": dict(max_count_drawn=100_000),
    "no_blur": dict(blur=0.0),
    "equal_weights": dict(min_visibility=1.0),
    "min_visibility_1e-2": dict(min_visibility=1e-2),
    "neighbours_4": dict(neighbours=4),
    "neighbours_8": dict(neighbours=8),
    "round_share_0.3": dict(round_share=0.3),
    "round_share_0.5": dict(round_share=0.5),
    "matching_passes_3": dict(matching_passes=3),
    "background_decay_1": dict(background_decay=1.0),
    "min_cover_0.1": dict(min_cover=0.1),
    "max_opacity_0.99": dict(max_opacity=0.99),
    "growth_0": dict(growth_exponent=0.0),
    "growth_1": dict(growth_exponent=1.0),
    "no_regrouping": dict(regrouping_rounds=0),
    "regrouping_once": dict(regrouping_rounds=1),
    "no_regrouping_contrast": dict(regrouping_contrast=1e6),
    "no_finish": dict(finish_views=0),
    "finish_views_8": dict(finish_views=8),
    "no_energy": dict(energy_exponent=0.0),
    "no_flatness": dict(flatness_exponent=0.0),
    "no_trace_factors": dict(max_log_factor=0.0),
    "no_sh_evidence": dict(min_sh_evidence=1e9),
    "no_min_opacity": dict(min_opacity=0.0),
    "places_evenly": dict(photo_share_exponent=0.0),
    "likely_share_1": dict(likely_share_exponent=1.0),
    "candidates_4": dict(candidates_per_view=4),
    "half_gain_coverage_1": dict(half_gain_coverage=1.0),
}
"""For each rule the value that turns it off, or a value beside the default: fields of
:class:`~pointsplat_ns.pruning.merging.MergeSettings`."""

POSES = "photos, poses given"
"""In place of a width: the poses of held-out photos, where merging is given those of the training
photos."""

LITTLE = 0.1
"""Mean change in dB below which a variant has no row."""

PAGE = """# What each setting of merging is worth

`lab/judge/ablation.py` writes this page from [ablation.json](ablation.json), which it measured. Each variant turns a
rule off, or moves a setting to a value beside its default.

- Figures are [PSNR](judge.md) of the variant minus that of the defaults, dB: mean (smallest…largest) over scenes and
  poses with both. Below 0, the default is better. `other_views` shows how much is chance.
- Splats are judged in at most {views} views of a camera path, {width} pixels wide; captures in the poses of at most
  {views} held-out photos, merged without poses and with those of the training photos.
- CPU is CPU seconds of merging, relative to the defaults.
- `merging/settings.py` describes the settings.

## Scenes

PSNR of the defaults, dB:

{scenes}

## Variants

{variants}

Within {little:g} dB on average: {still}.{moved}
"""

Task = tuple[int | str, float, str]
"""``at`` of a row (where the result is looked at, and whether poses are given), the share to keep,
the variant."""


def changes_of(name: str) -> dict[str, Any]:
    """The changes of a variant as JSON has them: none for :data:`BASELINE`."""
    return json.loads(json.dumps(VARIANTS.get(name, {})))


def settings_of(views: int, width: int) -> dict[str, Any]:
    """What rows depend on beside what they name themselves."""
    values = {f"merging.{name}": value for name, value in vars(MERGING).items()}
    return (
        {"views": views, "width": width}
        | values
        | {f"looking.{name}": v for name, v in vars(DEFAULT_SETTINGS).items()}
    )


@contextmanager
def applied(changes: dict[str, Any]) -> Iterator[MergeSettings]:
    """Settings of merging with changes; inside of the context, those of view sampling change too."""
    sampling = {name: value for name, value in changes.items() if name in vars(DEFAULT_SETTINGS)}
    with use_settings(dataclasses.replace(DEFAULT_SETTINGS, **sampling)):
        yield dataclasses.replace(
            MERGING, **{name: v for name, v in changes.items() if name not in sampling}
        )


def current(rows: list[Row]) -> list[Row]:
    """The rows of the defaults, and of variants that there are still, with the same changes."""
    known = {BASELINE, *VARIANTS}
    return [
        row
        for row in rows
        if row["method"] in known and row["changes"] == changes_of(row["method"])
    ]


def key(row: Row) -> Task:
    """The task that a row is of."""
    return row["at"], row["keep"], row["method"]


@cache
def warm_up() -> None:
    """Merge a small room once, so that the first row does not count the seconds of imports."""
    merge(room(3_000), 300)


def measure(
    scene: JudgedScene, path: Path, tasks: list[Task], results: Results, rows: dict[Task, Row]
) -> None:
    """Measure tasks, and write the rows of the scene after each.

    Args:
        scene: with one look.
        path: where it was read from.
        tasks: what to measure.
        results: where rows go.
        rows: those of the scene that are there and stay.
    """
    poses = dataset_views(path, "train") if any(at == POSES for at, _, _ in tasks) else None
    warm_up()
    dense = DenseViews(scene.dense, scene.looks[0].views)
    for at, keep, name in tracked(tasks, f"{scene.name}: merged and compared", len(tasks)):
        views = poses if at == POSES else None
        begin = time.process_time()
        with applied(VARIANTS.get(name, {})) as settings:
            small = merge(
                scene.dense, count_of(keep, len(scene.dense)), views=views, settings=settings
            ).scene
        seconds = time.process_time() - begin
        row: Row = {
            "scene": scene.name,
            "digest": scene.digest,
            "gaussians": len(scene.dense),
            "at": at,
            "keep": keep,
        }
        row |= {"method": name, "changes": changes_of(name)}
        rows[at, keep, name] = row | {"covered_psnr": dense.psnr(small), "cpu_seconds": seconds}
        results.put(scene.name, list(rows.values()))


def table_of(rows: list[Row]) -> pd.DataFrame:
    """Changes in dB and CPU seconds of each variant and budget, by scene and poses, the largest
    loss first."""
    table = pd.DataFrame(current(rows))
    place = ["scene", "at", "keep"]
    defaults = table[table["method"] == BASELINE].set_index(place)[["covered_psnr", "cpu_seconds"]]
    found = table[table["method"] != BASELINE].join(
        defaults, on=place, rsuffix="_default", how="inner"
    )
    found["change"] = found["covered_psnr"] - found["covered_psnr_default"]
    found["mean"] = found.groupby("method")["change"].transform("mean")
    return found.sort_values(["mean", "method"], kind="stable")


def variant_table(found: pd.DataFrame, settings: dict[str, Any]) -> tuple[str, list[str]]:
    """A row for each variant that changes much, or other views, and the names of the others."""
    keeps = sorted(found["keep"].unique())
    lines = []
    still = []
    for name, same in found.groupby("method", sort=False):
        if name != "other_views" and (same.groupby("keep")["change"].mean().abs() < LITTLE).all():
            still.append(str(name))
            continue
        changes = changes_of(str(name))
        known = {name.partition(".")[2]: value for name, value in settings.items()}
        moves = (
            f"`{field}` {_value(known.get(field))} to {_value(value)}"
            for field, value in changes.items()
        )
        cells = []
        for keep in keeps:
            some = same.loc[same["keep"] == keep, "change"]
            cells.append(
                f"{some.mean():+.2f} ({some.min():+.2f}…{some.max():+.2f})" if len(some) else "-"
            )
        ratio = same["cpu_seconds"].sum() / same["cpu_seconds_default"].sum()
        lines.append([f"`{name}`", "; ".join(moves), *cells, f"{ratio:.2f}"])
    return markdown(["variant", "change", *map(percent, keeps), "CPU"], lines), still


def page(rows: list[Row], settings: dict[str, Any]) -> str:
    """The page of all tables."""
    base = pd.DataFrame([row for row in current(rows) if row["method"] == BASELINE])
    where = {PHOTOS: "held-out photos", POSES: "held-out photos, poses given"}
    keeps = sorted(base["keep"].unique())
    lines = []
    for (scene, count, at), same in base.groupby(["scene", "gaussians", base["at"].astype(str)]):
        psnr = same.set_index("keep")["covered_psnr"]
        cells = [f"{psnr[keep]:.2f}" if keep in psnr else "-" for keep in keeps]
        lines.append(
            [
                f"{scene} ({group_of(scene) or 'other'})",
                f"{count:,}",
                where.get(at, "camera path"),
                *cells,
            ]
        )
    variants, still = variant_table(table_of(rows), settings)
    now = json.loads(json.dumps(settings_of(0, 0)))
    moved = [n for n, value in now.items() if "." in n and settings.get(n, value) != value]
    return PAGE.format(
        **{name: settings[name] for name in ("views", "width")},
        little=LITTLE,
        variants=variants,
        scenes=markdown(["scene (list)", "Gaussians", "views", *map(percent, keeps)], lines),
        still=", ".join(f"`{name}`" for name in still) or "none",
        moved=f"\n\nDefaults that have changed since: {', '.join(f'`{name}`' for name in moved)}."
        if moved
        else "",
    )


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"({', '.join(map(_value, value))})"
    return f"{value:,}" if isinstance(value, int) else f"{value:g}"


def write(files: tuple[Path, ...], folder: Path) -> None:
    """Write ablation.json and ablation.md from files of this program.

    Raises:
        SystemExit: if a file cannot be read, two files have different settings or one row twice, or
            there is nothing to compare.
    """
    rows, settings = read(files, "ablation.py")
    rows = current(rows)
    if table_of(rows).empty:
        raise SystemExit(
            f"{', '.join(map(str, files))}: no variant and the defaults of one scene; expected some"
        )
    write_rows(rows, settings, folder / "ablation.json")
    with replacing(folder / "ablation.md") as part:
        part.write_text(page(rows, settings), "utf-8")
    print(folder / "ablation.md")


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.1, 0.5),
    variants: tuple[str, ...] = tuple(VARIANTS),
    views: int = 8,
    width: int = 960,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    write_from: Annotated[tuple[Path, ...], tyro.conf.arg(name="write")] = (),
    record: Path = FOLDER,
) -> None:
    """Print what each setting of merging is worth: the change in dB where a variant takes the place
    of the defaults.

    Args:
        scenes: PLY files that have a camera path of their name, and Splatfacto runs, judged in
            their held-out photos.
        keep: shares of the Gaussians to keep.
        variants: names of variants to measure.
        views: at most so many views of each scene, evenly spread.
        width: of the pictures of camera paths, pixels; the height is 9/16 of it.
        json_path: write all rows there, after each.
        resume: take up the rows of that file. What it lacks is measured.
        write_from: only write the record, from these files of one or several runs.
        record: folder of the record.
    """
    if write_from:
        write(write_from, record)
        return
    check_options(scenes, keep, views, (width,))
    if unknown := {*variants} - {*VARIANTS}:
        raise SystemExit(
            f"--variants {', '.join(sorted(unknown))}; expected some of: {', '.join(VARIANTS)}"
        )
    settings = settings_of(views, width)
    results = Results(json_path, settings, resume)
    shown: list[Row] = []
    for name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        rows = {key(row): row for row in known_rows(results, scene)}
        there = {key(row) for row in current(list(rows.values()))}
        ats = (PHOTOS, POSES) if scene.looks[0].at == PHOTOS else (scene.looks[0].at,)
        wanted = [
            (at, share, variant)
            for at in ats
            for share in keep
            for variant in (BASELINE, *variants)
        ]
        if tasks := [task for task in wanted if task not in there]:
            measure(scene, path, tasks, results, rows)
        shown += [row for row in results.of(name) if row["keep"] in keep]
    text, still = variant_table(table_of(shown), json.loads(json.dumps(settings)))
    print(f"{text}\n\nWithin {LITTLE:g} dB in each: {', '.join(still) or 'none'}.")


if __name__ == "__main__":
    start(main)
