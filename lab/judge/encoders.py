"""The models of Table 4 and the concatenating one by networks that were trained alike: a section of
docs/record/results.md, from what refiners.py measured of them.

Refiners are named after the rows of :mod:`lab.tables.ways`, and each name has one network a seed:

    python -m lab.judge.refiners scenes/rock.ply RUN --refiners pointsplat=NET1 pointsplat=NET2
    paper-splatformer=NET3 paper-splatformer=NET4 --json docs/record/encoders.json
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from lab.common.printing import markdown, wrapped
from lab.common.results import Row, grouped
from lab.judge.captures import CAPTURES
from lab.judge.refiners import gain, mean_and_spread
from lab.tables.findings import CLAIMS, Claim, Outcome, sentences
from lab.tables.ways import WAYS, Way

MODELS = {
    "II": "pointsplat-ii",
    "III": "pointsplat-iii",
    "IV": "pointsplat-iv",
    "V": WAYS.pointsplat.name,
    "concat": WAYS.paper_splatformer.name,
}
"""Names of the paper's models, and of their rows."""

HEADS = ("model", "scenes", "gain, dB", "spread of seeds", "worst scene")

SECTION = """## Table 4 by networks trained alike

{finding}

`lab/judge/refiners.py` measured [encoders.json](encoders.json): the gain over the paper's selection at 10 %, in PSNR
against renders of the dense scene over the pixels that it covers, 960 pixels wide. Splats are seen from six views
written by hand, captures from at most six of their held-out poses. Gains are means over {seeds} seeds; the worst scene
is the one with the smallest. No network saw these scenes.

Each network learned {steps} steps from pieces of nine splats (mujoco_tabletop, kettle_pod, pc_flowers, pc_playbot and the
statues angel, angel_with_candlestick, massa, narcissus, trumpet), the way of the refiner that ships but for its
length. Other models and seeds have other values of `--pipeline.model.encoder`, `--pipeline.model.use-appearance`,
`--pipeline.model.use-position` and `--pipeline.datamanager.seed`:

```bash
ns-train pointsplat --data scenes --max-num-iterations {steps} --rate-factor 10 \\
    --pipeline.datamanager.supervision dense --pipeline.datamanager.pieces 12000 --pipeline.datamanager.cuts 2 \\
    --pipeline.datamanager.sampled-size 240 180 --pipeline.datamanager.seed 0 --pipeline.model.by paper \\
    --pipeline.model.keep 0.1 --pipeline.model.size tiny --pipeline.model.units local --pipeline.model.augment True \\
    --pipeline.model.pixel-loss rmse --pipeline.model.lpips-weight 0 --pipeline.model.encoder dual
```

{table}
"""

STEPS = 600
"""Of each training."""


def gains(rows: Sequence[Row], name: str) -> dict[str, float]:
    """What the refiners of a name gain in each scene, dB; means over seeds."""
    mine = grouped((row for row in rows if row["method"] == name), lambda row: row["scene"])
    return {scene: fmean(map(gain, of_scene)) for scene, of_scene in mine.items()}


def verdicts(rows: Sequence[Row]) -> list[Outcome]:
    """The claims of the paper that two of these models decide."""
    known = {row["method"] for row in rows}

    def outcome(claim: Claim, than: Way) -> Outcome:
        better, worse = gains(rows, claim.better.name), gains(rows, than.name)
        return Outcome(claim, tuple(better[scene] - worse[scene] for scene in better))

    return [
        outcome(claim, *claim.than)
        for claim in CLAIMS
        if claim.measure == "psnr" and {way.name for way in (claim.better, *claim.than)} <= known
    ]


def lines(rows: Sequence[Row]) -> list[list[str]]:
    """Cells of :data:`HEADS`, for splats and captures."""
    found = []
    for label, name in MODELS.items():
        mine = [row for row in rows if row["method"] == name]
        kinds = grouped(mine, lambda row: "captures" if row["scene"] in CAPTURES else "splats")
        for kind, of_kind in kinds.items():
            by_scene = gains(of_kind, name)
            worst = min(by_scene, key=by_scene.__getitem__)
            scenes = f"{len(by_scene)} {kind}"
            least = f"{by_scene[worst]:+.2f} ({worst})"
            found.append([label, scenes, *mean_and_spread(of_kind), least])
    return found


def section(rows: Sequence[Row]) -> str:
    """The section of the page."""
    seeds = {
        len(same) for same in grouped(rows, lambda row: (row["method"], row["scene"])).values()
    }
    return SECTION.format(
        finding=wrapped(sentences(verdicts(rows))),
        seeds=" or ".join(map(str, sorted(seeds))),
        steps=STEPS,
        table=markdown(HEADS, lines(rows)),
    )
