"""What refinement is worth: the rows of the table, one at a time, kept in a file as soon as each is known."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from held_out import COLUMNS, REFERENCES, Scene, compare, load, photos_of

from pointsplat_ns.compression.closeness import Closeness
from pointsplat_ns.compression.compact import Comparison, as_far_as_it_helps
from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.compression.trained_refiner import TrainedRefiner, load_refiner, open_refiner_run
from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import open_run
from pointsplat_ns.io.files import replacing
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.metrics import psnr, ssim
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.rasterizer import render
from pointsplat_ns.refiner import read_metadata

REFINER = "refiner.safetensors"
"""In the folder of every training that reached its end."""

SHIPPED = "as shipped"
"""Refined by the dual-branch network as far as ``pointsplat compact`` refines."""

DENSE, SELECTED, TUNED, TUNED_PHOTOS = "dense", "selected", "fine-tuned", "fine-tuned on photos"


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained refiner and what it was trained for."""

    folder: Path
    start: str
    encoder: str
    seed: int
    digest: str  # of the weights
    steps: int
    supervision: str
    trained_on: frozenset[str]
    refiner: TrainedRefiner

    @property
    def label(self) -> str:
        return f"{self.start} + {self.encoder}, seed {self.seed}"


def find_refiners(folder: Path) -> list[Trained]:
    """Every finished training at or below a folder.

    Raises:
        PointSplatError: if two differ in nothing but the folder, or one cannot be opened.
    """
    found: dict[tuple, Trained] = {}
    for file in sorted(folder.rglob(REFINER)):
        run, refiner = open_refiner_run(file.parent, need_data=False), load_refiner(file.parent, "cpu")
        scenes = str(read_metadata(file).get("scenes", ""))
        trained = Trained(
            folder=file.parent,
            start=refiner.settings.by,
            encoder=run.model_fields["encoder"],
            seed=int(run.datamanager_fields.get("seed", 0)),
            digest=hashlib.sha256(file.read_bytes()).hexdigest()[:12],
            steps=run.step + 1,
            supervision=str(run.datamanager_fields.get("supervision", "photos")),
            trained_on=frozenset(name.strip() for name in scenes.split(",") if name.strip()),
            refiner=refiner,
        )
        other = found.setdefault((trained.start, trained.encoder, trained.seed), trained)
        if other is not trained:
            raise PointSplatError(f"{trained.folder} and {other.folder}: both are {trained.label}; name one of them")
    return list(found.values())


class Rows:
    """Rows in a JSON file, written anew whenever one is added.

    Args:
        path: of the file; what it has is taken up.
        settings: what all rows of a file must have in common.

    Raises:
        PointSplatError: if the file's rows were made with other settings.
    """

    def __init__(self, path: Path, settings: dict[str, Any]):
        self.path, self.settings, self.rows = path, settings, []
        if path.exists():
            content = json.loads(path.read_text("utf-8"))
            if content["settings"] != settings:
                raise PointSplatError(f"{path}: made with {content['settings']}, not {settings}; name another file")
            self.rows = content["rows"]

    def has(self, key: dict[str, Any]) -> bool:
        """Whether a row with these values is there."""
        return any(all(row.get(name) == value for name, value in key.items()) for row in self.rows)

    def add(self, row: dict[str, Any]) -> None:
        """Add a row, in the place of one of the same scene, budget, start, variant and seed."""
        self.rows = [other for other in self.rows if identity(other) != identity(row)] + [row]
        with replacing(self.path) as part:
            part.write_text(json.dumps({"settings": self.settings, "rows": self.rows}, indent=1), "utf-8")


def identity(row: dict[str, Any]) -> tuple:
    """What no two rows of a table share."""
    return tuple(row[name] for name in ("scene", "keep", "start", "variant", "seed"))


@dataclass
class Judge:
    """One scene, its views, and the rows that are made of it."""

    path: Path
    refiners: list[Trained]
    rows: Rows
    lpips: Lpips | None
    views: int
    tell: Callable[[str], None] = print

    @cached_property
    def scene(self) -> Scene:
        """The dense scene, its held-out photos and its renders."""
        return load(self.path, self.views)

    @cached_property
    def source(self) -> str:
        """Which training of the scene this is."""
        run = open_run(self.path)
        return f"{run.experiment_name}/{run.method_name}/{run.timestamp} step {run.step}"

    @cached_property
    def rule(self) -> Comparison | None:
        """The dense scene as seen from sampled poses, by which ``pointsplat compact`` of a PLY decides how far to
        refine; None if no free place to look from was found."""
        try:
            return Comparison(self.scene.dense, ViewSource(self.scene.dense))
        except DataError as error:
            self.tell(f"{self.scene.name}: {error}")
            return None

    def dense_row(self) -> None:
        """The scene itself against its photos."""
        key = self._key(1.0, "", DENSE, None, "")
        if self.rows.has(key):
            return
        pairs = list(zip(self.scene.renders, self.scene.photos or [], strict=True))
        measures = {"psnr": psnr, "ssim": ssim} | ({"lpips": self.lpips} if self.lpips else {})
        values: dict[str, Any] = {f"{against}_{column}": None for against in REFERENCES for column in COLUMNS}
        with torch.no_grad():
            for name, measure in measures.items():
                values[f"photo_{name}"] = fmean(float(measure(image, photo)) for image, photo in pairs)
        self._add(key, self.scene.dense, 0.0, 0.0, values)

    def budget(self, keep: float, starts: tuple[str, ...], steps: int, photos: bool, pictures: Path | None) -> None:
        """Every row of one share of the Gaussians that is not there yet, and the picture."""
        chosen = {start: Selected(self, keep, start) for start in starts}
        before = self.rows.rows
        for start, selected in chosen.items():
            key = self._key(keep, start, SELECTED, None, "")
            if not self.rows.has(key):
                self._add(key, selected.scene, selected.seconds, 0.0, compare_all(self, selected.scene))
            for trained in self.refiners:
                key = self._key(keep, start, trained.encoder, trained.seed, trained.digest)
                if trained.start != start or self.rows.has(key):
                    continue
                refined, seconds = selected.refined(trained)
                about = {
                    "seen": self.name in trained.trained_on,
                    "steps": trained.steps,
                    "supervision": trained.supervision,
                }
                if trained.encoder == "dual":  # first: the refined row says that both are there
                    shipped, strength, more = self._shipped(selected, refined)
                    values = compare_all(self, shipped) | about | {"strength": strength}
                    as_shipped = key | {"variant": SHIPPED}
                    self._add(as_shipped, shipped, selected.seconds, seconds + more, values)
                self._add(key, refined, selected.seconds, seconds, compare_all(self, refined) | about)
        if pictures is not None:
            path = pictures / f"{self.name}_{100 * keep:g}.png"
            if self.rows.rows is not before or not path.exists():
                self._picture(path, chosen)
        for variant in (TUNED, TUNED_PHOTOS)[: 1 + photos] if steps else ():
            for start, selected in chosen.items():
                key = self._key(keep, start, variant, None, "")
                if not self.rows.has(key):
                    tuned, seconds = self._fine_tuned(selected.scene, steps, variant == TUNED_PHOTOS)
                    self._add(key, tuned, selected.seconds, seconds, compare_all(self, tuned))

    def _shipped(self, selected: Selected, refined: Gaussians) -> tuple[Gaussians, float, float]:
        """What ``pointsplat compact`` would give, at which strength (0 where it leaves refinement out), and the seconds
        that finding out took."""
        if self.rule is None or selected.before is None or not _sound(refined, selected.scene):
            return selected.scene, 0.0, 0.0
        start = time.perf_counter()
        change = as_far_as_it_helps(self.rule, selected.before, selected.scene, refined)
        return change.scene, 0.0 if change.left_out else change.strength, time.perf_counter() - start

    def _fine_tuned(self, scene: Gaussians, steps: int, photos: bool) -> tuple[Gaussians, float]:
        """Fine-tuned at training poses, no more of them than steps, and seconds with rendering what is wanted."""
        if photos:
            _, views, targets = photos_of(self.path, "train", steps)
        else:
            views, targets = dataset_views(self.path, "train").spread(steps), self.scene.dense
        start = time.perf_counter()
        return fine_tune(scene, views, targets, steps), time.perf_counter() - start

    def _key(self, keep: float, start: str, variant: str, seed: int | None, weights: str) -> dict[str, Any]:
        names = {"scene": self.name, "source": self.source, "keep": keep}
        return names | {"start": start, "variant": variant, "seed": seed, "weights": weights}

    @cached_property
    def name(self) -> str:
        """The scene's, without reading it."""
        from pointsplat_ns.io import scene_name

        return scene_name(open_run(self.path))

    def _add(self, key: dict, scene: Gaussians, select: float, repair: float, values: dict[str, Any]) -> None:
        sizes = {"count": len(scene), "megabytes": scene.megabytes, "select_seconds": select, "seconds": repair}
        self.rows.add(key | sizes | values)
        seed = "" if key["seed"] is None else f" seed {key['seed']}"
        found = "".join(
            f", {values[f'{against}_psnr']:.2f} dB against {what}"
            for against, what in (("photo", "photos"), ("dense", "dense renders"))
            if values[f"{against}_psnr"] is not None
        )
        self.tell(f"{self.name} {100 * key['keep']:g} % {key['start']} {key['variant']}{seed}{found}, {repair:.1f} s")

    @torch.no_grad()
    def _picture(self, path: Path, chosen: dict[str, Selected]) -> None:
        """One held-out view: photo, dense, and for each start what was selected and that refined by the dual-branch
        refiner of the lowest seed."""
        index = len(self.scene.views) // 2
        photo = (self.scene.photos or self.scene.renders)[index]
        panels = [
            ("photo, held out", photo),
            (f"dense, {len(self.scene.dense):,} Gaussians", self.scene.renders[index]),
        ]
        for start, selected in chosen.items():
            shown = [(start, selected.scene)]
            duals = [t for t in self.refiners if (t.start, t.encoder) == (start, "dual")]
            if duals:
                trained = min(duals, key=lambda t: t.seed)
                shown.append((f"{start} + dual, seed {trained.seed}", selected.refined(trained)[0]))
            panels += [(f"{name}, {len(g):,} Gaussians", render(g, self.scene.views[index])) for name, g in shown]
        captions = [panels[0][0]] + [f"{text}, {float(psnr(image, photo)):.1f} dB" for text, image in panels[1:]]
        _write_panels(path, f"{self.name}, {path.stem.rsplit('_', 1)[1]} % kept", captions, [i for _, i in panels])


def _sound(refined: Gaussians, selected: Gaussians) -> bool:
    """Whether every Gaussian that could be drawn before still can."""
    return not bool((selected.usable() & ~refined.usable()).any())


class Selected:
    """A scene at a budget by one start, made when it is first asked for, with what refiners make of it."""

    def __init__(self, judge: Judge, keep: float, start: str):
        self._judge, self._keep, self._start = judge, keep, start
        self._refined: dict[str, tuple[Gaussians, float]] = {}

    @cached_property
    def _pruned(self) -> tuple[Gaussians, float]:
        settings = PruneSettings(self._keep, self._start)
        for trained in self._judge.refiners:
            weight = trained.refiner.settings.opacity_weight
            if trained.start == self._start and weight not in (None, DEFAULT_OPACITY_WEIGHT):
                raise PointSplatError(
                    f"{trained.folder}: trained on scenes pruned by {trained.refiner.settings}, not {settings}"
                )
        dense = self._judge.scene.dense
        begin = time.perf_counter()
        return settings.prune(dense), time.perf_counter() - begin

    @property
    def scene(self) -> Gaussians:
        return self._pruned[0]

    @property
    def seconds(self) -> float:
        return self._pruned[1]

    @cached_property
    def before(self) -> Closeness | None:
        """How close it comes to the dense scene, from the poses of the rule."""
        return None if self._judge.rule is None else self._judge.rule.reference.closeness(self.scene)

    @torch.no_grad()
    def refined(self, trained: Trained) -> tuple[Gaussians, float]:
        """The scene refined, and seconds with serialization."""
        if trained.digest not in self._refined:
            scene = self.scene  # pruning is not part of the seconds
            begin = time.perf_counter()
            refined = trained.refiner(scene)
            self._refined[trained.digest] = refined, time.perf_counter() - begin
        return self._refined[trained.digest]


def compare_all(judge: Judge, small: Gaussians) -> dict[str, Any]:
    """Against photos and dense renders."""
    return compare(judge.scene, small, judge.lpips)


def _write_panels(path: Path, title: str, captions: list[str], images: list[torch.Tensor]) -> None:
    from matplotlib.figure import Figure

    height, width = images[0].shape[:2]
    columns = min(3, len(images))
    lines = -(-len(images) // columns)
    figure = Figure(figsize=(5 * columns, lines * (5 * height / width + 0.4) + 0.4), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, caption, image in zip(axes, captions, images, strict=False):
        axis.imshow(image.clamp(0, 1).numpy())
        axis.set_title(caption, fontsize=11)
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
