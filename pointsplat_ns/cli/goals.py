"""Goals of ``pointsplat compact --for``: the format, the budget and the page that a purpose asks for."""

from __future__ import annotations

import shlex
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple
from urllib.parse import quote

from pointsplat_ns.cli.printing import written_size
from pointsplat_ns.cli.scene_options import output_beside

if TYPE_CHECKING:
    from pointsplat_ns.compression.quality import Quality

GoalName = Literal["web", "phone", "headset", "email"]


class Goal(NamedTuple):
    """What a purpose asks for."""

    suffix: str | None = None
    """Suffix of the file; None for that of the scene."""
    keep: str | None = None
    """Budget; None for the usual one."""
    page: bool = False
    """Whether a page with the scene alone is written beside the file."""
    page_mb: float = 60.0
    """Largest page, in units of 10^6 bytes."""
    use: str = "to fly through in a browser"
    """Text on the use of a page."""


GOALS: dict[GoalName | None, Goal] = {
    None: Goal(),
    "web": Goal(
        ".sog", "2MB", True, use="to upload; paste this where the scene is to appear:\n"
        '<iframe src="{url}" title="{name}" style="width: 100%; height: 30rem; border: 0" allowfullscreen></iframe>',
    ),
    "phone": Goal(".sog", "500000gaussians"),
    "headset": Goal(".spz", "400000gaussians"),
    "email": Goal(".spz", "5MB", True, 10.0, "to fly through after a double click, also offline"),
}  # fmt: skip
"""Sources of the figures: docs/guides/downloaded_splat.md."""


def file_for(goal: GoalName | None, scene: Path, output: Path | None) -> Path:
    """The file to write, by default beside the scene. Raises SceneError if ``output`` has another format than the
    goal's."""
    from pointsplat_ns.errors import SceneError

    suffix = GOALS[goal].suffix
    if output is not None and suffix is not None and not output.name.lower().endswith(suffix):
        raise SceneError(f"{output}: --for {goal} writes {suffix}; expected such a name, or --keep in place of --for")
    return output or output_beside(scene, goal or "compact", suffix)


def print_use(goal: GoalName | None, page: Path | None, name: str, quality: Quality | None) -> None:
    """Print what a page of the scene called ``name`` is for; for a headset, also the fill, which can slow it."""
    if page is not None:
        use = GOALS[goal].use.format(url=quote(page.name), name=escape(name))
        print(f"{page}: {written_size(page)}, {use}")
    if goal == "headset" and quality is not None:
        fill = f"{quality.fill_before:.1f} -> {quality.fill:.1f} Gaussians drawn per pixel"
        print(f"fill: {fill}; where it is too slow near things, a smaller --keep lowers it")


def print_next(scene: Path, output: Path, quality: Quality | None) -> None:
    """Print two commands to try after a budget that nobody chose: a look at the result, and another budget where its
    PSNR asks for one, else a goal."""
    share = "30%" if quality is not None and quality.psnr < 27.0 else "3%" if quality and quality.psnr > 35.0 else None
    other = ["--for", "web"] if share is None else ["--keep", share, "-o", str(output_beside(scene, share[:-1]))]
    commands = ["pointsplat", "view", str(scene), str(output)], ["pointsplat", "compact", str(scene), *other]
    print("next: " + "\n      ".join(map(shlex.join, commands)))
