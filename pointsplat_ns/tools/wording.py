"""Turns results into sentences for commands, pages and logs."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

from pointsplat_ns.pipeline.acceptance import views_improved
from pointsplat_ns.pipeline.cleaning import Cleaning, Rule, RuleEffect
from pointsplat_ns.pipeline.quality import PhotoGain, Quality
from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.report import (
    HeldOut,
    PsnrSearch,
    Report,
    ShCut,
    SizeSearch,
    StageResult,
    TargetSearch,
)
from pointsplat_ns.pipeline.view_provider import Origin, ViewOrigin
from pointsplat_ns.rendering.comparison.closeness import LEAST_OPACITY, Closeness
from pointsplat_ns.scene.views import ImageSize, Views, sizes_text
from pointsplat_ns.system.files import bytes_text
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.tools.watched_file import FileState

logger = logging.getLogger("pointsplat_ns")

IMPRESSIONS = (
    (40.0, "looks the same"),
    (34.0, "hardly any difference"),
    (29.0, "finest details soften"),
    (25.0, "edges of small things blur"),
    (21.0, "small things are lost"),
    (0.0, "only large shapes are left"),
)
"""Impression of a PSNR against the dense scene, by lower bound in dB. Observed in pictures of
rooms, statues, a robot and stones at 50, 30, 10 and 3 % of their Gaussians."""

BEST_PSNR = 60.0
"""Largest PSNR to print, dB. Rounding pictures to 256 levels has 59 dB."""


_SPZ_READERS = {
    4: "the format's own library, SuperSplat, PlayCanvas and three.js read it; Spark 2.2 and older "
    "viewers need --spz-version 3",
    3: "the format's own library, SuperSplat, three.js and Spark read it; PlayCanvas' engine needs "
    "--spz-version 4, viewers from before 2025 need 2",
    2: "all viewers of SPZ but PlayCanvas' engine read it; rotations are coarser than in 3",
}


def spz_readers(version: int) -> str:
    """The version of an SPZ file, and the programs that read it."""
    return f"SPZ {version}: {_SPZ_READERS[version]}"


def spz_tiles(version: int) -> str:
    """The version of SPZ in 3D Tiles, and the program that reads it."""
    newest = ", the newest that it reads" if version == 3 else ""
    return f"tiles hold SPZ {version} for CesiumJS{newest}"


def decibels(psnr: float) -> str:
    """Text on a PSNR, dB."""
    return f"more than {BEST_PSNR:g} dB" if psnr > BEST_PSNR else f"{psnr:.1f} dB"


def impression(psnr: float) -> str:
    """Visual impression of a PSNR against the dense scene, dB."""
    return next((word for least, word in IMPRESSIONS if psnr >= least), IMPRESSIONS[-1][1])


def quality_line(psnr: float, ssim: float | None) -> str:
    """PSNR (dB) and SSIM against the dense scene, and the visual impression."""
    similarity = "" if ssim is None else f", SSIM {ssim:.2f}"
    return f"{decibels(psnr)}{similarity}: {impression(psnr)}"


def photo_gain_text(gain: PhotoGain) -> str:
    """Gain of training on photos."""
    if gain.accepted:
        return f"{gain.before:.1f} -> {gain.after:.1f} dB in {gain.photos} training photos"
    return f"{gain.before:.1f} dB in {gain.photos} photos, not improved by training on them"


def quality_text(quality: Quality) -> str:
    """The main line on the quality of a result."""
    line = quality_line(quality.psnr, quality.ssim)
    if quality.photos is not None:
        gain = photo_gain_text(quality.photos)
        similarity = "" if quality.ssim is None else f", SSIM {quality.ssim:.2f}"
        if quality.photos.accepted:
            line = f"{decibels(quality.psnr)}{similarity} against the dense scene"
        line = f"{gain}; {line}"
    if quality.opacity < LEAST_OPACITY:
        line += (
            "; the dense scene is translucent in all views (mean opacity "
            f"{100 * quality.opacity:.0f} %), as just after an opacity reset"
        )
    return line


def quality_lines(quality: Quality) -> tuple[str, ...]:
    """:func:`quality_text` as short lines, for the title of a picture."""
    similarity = "" if quality.ssim is None else f", SSIM {quality.ssim:.2f}"
    figures = f"{decibels(quality.psnr)}{similarity}"
    if quality.photos is None:
        return figures, impression(quality.psnr)
    gain = photo_gain_text(quality.photos)
    if quality.photos.accepted:
        return gain, f"{figures} against the dense scene"
    return gain, figures, impression(quality.psnr)


def quality_details(quality: Quality) -> str:
    """A line with further figures of a result."""
    sizes = ImageSize(quality.width, quality.height), *quality.other_sizes
    views = f"{views_text(quality.views)} of {sizes_text(sizes)} pixels"
    return f"in {views} ({origin_text(quality.origin)}), {decibels(quality.worst)} in the worst"


def fill_text(quality: Quality) -> str:
    """Fill (overdraw) of the dense scene and of a result; it limits the speed of viewers."""
    return f"fill: {quality.fill_before:.1f} -> {quality.fill:.1f} Gaussians drawn per pixel"


def quality_json(quality: Quality | None) -> dict[str, Any]:
    """Figures of a result and their line, for JSON."""
    if quality is None:
        return {"psnr": None}
    gain = quality.photos
    photos = None
    if gain is not None:
        photos = {
            "before": gain.before,
            "after": gain.after,
            "photos": gain.photos,
            "kept": gain.accepted,
        }
    return {
        "psnr": quality.psnr,
        "worst": quality.worst,
        "ssim": quality.ssim,
        "views": quality.views,
        "width": quality.width,
        "height": quality.height,
        "other_sizes": [size[:2] for size in quality.other_sizes],
        "origin": origin_text(quality.origin),
        "fill_before": quality.fill_before,
        "fill": quality.fill,
        "photos": photos,
        "opacity": quality.opacity,
        "quality": quality_text(quality),
    }


def views_text(count: int) -> str:
    """A number of views: "1 view", "3 views"."""
    return counted(count, "view")


def views_of_size(views: Views) -> str:
    """Number and size of views."""
    return f"{views_text(len(views))} of {sizes_text(views.image_sizes())} pixels"


def origin_text(origin: ViewOrigin | None) -> str:
    """Origin of views; empty if there are none."""
    if origin is None:
        return ""
    if origin.kind is Origin.SAMPLED:
        return f"sampled poses, up is {origin.up}{missing_text(origin.missing)}"
    return {Origin.GIVEN: "given views", Origin.DATASET: "poses of the dataset"}[origin.kind]


def missing_text(missing: str) -> str:
    """Error of reading poses from a run's dataset, in brackets; empty if there was none."""
    return f" (no dataset: {missing})" if missing else ""


def closeness_text(close: Closeness) -> str:
    """Number and width of the compared views."""
    width = "" if close.width is None else f" of {close.width} pixels"
    return views_text(len(close.errors)) + width


def file_state_text(name: str, state: FileState) -> str:
    """State of the file of a shown scene; empty if it is as it was read."""
    shown = f"the page shows {name} as it was read"
    return {
        FileState.SAME: "",
        FileState.CHANGED: f"{name} has changed on disk: {shown}; start pointsplat view again",
        FileState.GONE: f"{name} is gone from disk, or cannot be read: {shown}",
    }[state]


def reason_text(reason: Reason) -> str:
    """Reason to reject a stage."""
    if reason.cause is Cause.NOT_FINITE:
        return f"{reason.count:,} of {reason.total:,} Gaussians are not finite"
    if reason.cause is Cause.NOT_COMPARED:
        return f"no comparison with the dense scene ({reason.error})"
    if reason.cause is Cause.SMALL_GAIN:
        return f"gain below {reason.decibels:g} dB"
    if reason.cause is Cause.WORSE_IN_OTHER_PHOTOS:
        return f"other photos lose {reason.decibels:.1f} dB"
    return {
        Cause.NO_CHANGE: "no change",
        Cause.NO_GAIN: "no gain",
        Cause.WORSE_IN_MOST_VIEWS: "error increased in most views",
        Cause.WORSE_IN_OTHER_SIZES: "PSNR decreased in pictures of other sizes",
    }[reason.cause]


STAGES = {
    "merge": "merged",
    "prune": "pruned",
    "refine": "refined",
    "repair": "repaired",
    "photos": "trained",
    "round": "rounded",
}
"""Participle for the effect of each stage."""


def stage_text(result: StageResult) -> str:
    """Gain of a stage, or the reason to reject it."""
    done = STAGES[result.stage]
    done += {"refine": " by the network", "round": " for the file size"}.get(result.stage, "")
    figures = ""
    if result.photos is not None:
        done += f" on {result.photos.used} photos"
        figures = (
            f"{result.photos.before:.1f} -> {result.photos.after:.1f} dB PSNR in "
            f"{result.photos.compared} photos"
        )
    elif result.before is not None and result.after is not None:
        figures = _errors_text(result.before, result.after)
    cost = ""
    if result.stage in ("repair", "photos"):
        cost = f" by {counted(result.steps, 'step')} in {result.seconds:.1f} s"
    if result.interrupted:
        cost += ", interrupted"
    reason = ""
    if result.reason is not None:
        reason = f"{', ' if figures else ': '}{reason_text(result.reason)}"
    negation = "" if result.accepted else "not "
    return f"{negation}{done}{cost}{reason}" + (f": {figures}" if figures else "")


def _errors_text(before: Closeness, after: Closeness) -> str:
    gain = f"{before.psnr:.1f} -> {after.psnr:.1f} dB PSNR against the dense scene"
    closer = views_improved(before, after)
    worst = f"worst {before.worst:.1f} -> {after.worst:.1f} dB, better in {closer}"
    return f"{gain} ({closeness_text(before)}; {worst})"


def verdict_text(report: Report) -> str:
    """A line per stage after pruning: its gain, or the reason to reject it. One line if there is no
    such stage."""
    lines = [stage_text(result) for result in report.stages[1:]]
    if lines:
        return "\n".join(lines)
    if report.before is None:
        reason = Reason(Cause.NOT_COMPARED, error=report.uncompared)
        return f"not refined or repaired: {reason_text(reason)}"
    return (
        f"not repaired: {report.before.psnr:.1f} dB PSNR against the dense scene "
        f"({closeness_text(report.before)})"
    )


def sh_text(cut: ShCut) -> str:
    """Text on a cut of SH bands."""
    if cut.after >= cut.before:
        return f"SH degree {cut.before} kept"
    reached = "" if cut.psnr is None else f", {cut.psnr:.1f} dB PSNR against all bands"
    return (
        f"SH degree {cut.before} cut to {cut.after}: colours change {cut.lost:.0%} less with the "
        f"view{reached}"
    )


def cleaning_lines(cleaning: Cleaning) -> tuple[str, ...]:
    """A line per rule of cleaning."""
    if not cleaning.effects:
        removable = len(cleaning.junk.indices)
        spared = f"; the budget keeps all {removable:,} removable Gaussians" if removable else ""
        return (f"clean: nothing removed{spared}",)
    return tuple(
        f"clean: {effect.removed:,} of {cleaning.count:,} removed {_rule_text(effect)}"
        f"{_effect_text(effect)}"
        for effect in cleaning.effects
    )


def _rule_text(effect: RuleEffect) -> str:
    if effect.rule is Rule.UNDRAWABLE:
        return "that cannot be drawn"
    if effect.rule is Rule.UNSEEN:
        places = (
            f"{effect.places} camera positions" if effect.places else "no camera position found"
        )
        return f"that are never visible ({places})"
    found = counted(effect.clusters, "cluster")
    return f"that float in front of the surfaces in {effect.seen_in} views, {found}"


def _effect_text(effect: RuleEffect) -> str:
    if effect.psnr is None or effect.worst is None:
        return ""
    seen = views_text(effect.views)
    if math.isinf(effect.psnr):
        return f"; no change in {seen}"
    return (
        f"; {effect.psnr:.1f} dB against the dense scene in {seen}, {effect.worst:.1f} dB in the "
        "worst"
    )


def search_text(search: PsnrSearch | SizeSearch) -> str:
    """Text on the search for the count of a budget."""
    tried = counted(search.tried, "size")
    if isinstance(search, SizeSearch):
        return f"{tried} tried for {bytes_text(search.bytes)} as {search.format}"
    return (
        f"{tried} tried: {decibels(search.psnr)} against the dense scene, "
        f"{decibels(search.worst)} in the worst of {views_text(search.views)}"
    )


def target_text(target: TargetSearch, views: Views | None = None) -> str:
    """Reached quality of a search, its views or photos, and its cost."""
    if target.photos:
        photos = counted(target.photos, "held-out photo")
        reached = f"{target.psnr:.1f} dB in {photos}, the dense scene {target.dense_psnr:.1f} dB"
    else:
        where = "" if views is None else f" in {views_of_size(views)}"
        reached = f"{decibels(target.psnr)} against the dense scene{where}"
    cost = f"{target.tried} sizes tried" + (", interrupted" if target.interrupted else "")
    return f"{reached}, {bytes_text(target.bytes)}, {target.gaussians:,} Gaussians; {cost}"


def held_out_text(found: HeldOut) -> str:
    """PSNR in held-out photos."""
    figures = " -> ".join(f"{psnr:.1f}" for psnr in found.psnrs)
    return (
        f"held-out photos: {figures} dB PSNR in {found.photos} photos, the dense scene "
        f"{found.dense:.1f} dB"
    )


def note_lines(report: Report) -> tuple[str, ...]:
    """Lines on a report: origin of views, cut SH bands, cleaning, search."""
    lines: list[str] = []
    if report.origin is not None:
        lines.append(f"views: {origin_text(report.origin)}")
    if report.sh is not None:
        lines.append(sh_text(report.sh))
    if report.cleaning is not None:
        lines += cleaning_lines(report.cleaning)
    if report.search is not None:
        lines.append(search_text(report.search))
    return tuple(lines)


QUICK_NOTE = (
    "a first look, measured with --quick: few budgets, frames of half the width, and no repairs "
    "unless --repairs names them"
)
"""Note on a quick trade-off."""


def tradeoff_estimate(points: int, gaussians: int, seconds: float, quick: bool) -> str:
    """How long a trade-off will take, before it starts."""
    if seconds < 60:
        rough = f"{10 * max(1, round(seconds / 10))} s"
    else:
        rough = f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
    advice = "" if quick or seconds < 60 else "; --quick gives a first look"
    return (
        f"measuring {counted(points, 'point')} of {gaussians:,} Gaussians takes about {rough} on "
        f"this machine{advice}"
    )


def log_report(report: Report) -> None:
    """Log a report: photos, searches and missing poses of a run at level INFO, details at level
    DEBUG."""
    if report.no_held_out:
        logger.info("there are no held-out photos: %s", report.no_held_out)
    notes = note_lines(report)
    missing = report.origin is not None and bool(report.origin.missing)
    for place, line in enumerate(notes):
        logger.log(logging.INFO if missing and place == 0 else logging.DEBUG, "%s", line)
    if len(report.stages) > 1 or report.reference is not None or report.uncompared:
        for line in verdict_text(report).splitlines():
            logger.debug("%s", line)
    if report.target is not None:
        views = None if report.judge is None else report.judge.views
        logger.info("%s", target_text(report.target, views))
    if report.held_out is not None:
        logger.info("%s", held_out_text(report.held_out))


def log_lines(lines: Sequence[str]) -> None:
    """Log lines of text at level INFO."""
    for line in lines:
        logger.info("%s", line)
