"""Goes the ways of users, and checks that every screen, page, picture and JSON says the same of one
file."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path
from typing import Annotated, Any

import tyro
from PIL import Image

from pointsplat_ns.system.files import bytes_text

UNSAID = ("inf", "nan", "told", "beyond", "closer in", "no difference", "Traceback")
"""Words that no screen and no page has."""

LINE = (
    r"(?:[\d.]+ (?:-> [\d.]+ )?dB in \d+ .*photos.*; .*)?"
    r"(?:more than )?[\d.]+ dB, SSIM \d\.\d\d(?:: .*| against the dense scene)?"
)
"""The line of quality."""


@dataclass
class Proof:
    """Runs commands in a folder, and collects what is wrong."""

    folder: Path
    checks: int = 0
    wrong: list[str] = field(default_factory=list)

    def check(self, right: bool, what: str) -> None:
        """Count a check, and print it if it fails."""
        self.checks += 1
        if not right:
            self.wrong.append(what)
            print(f"WRONG: {what}")

    def run(self, *words: object) -> str:
        """What a command prints, which has none of the words."""
        command = ["pointsplat", *map(str, words)]
        print(f"$ {shlex.join(command)}", flush=True)
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True)
        said = done.stdout if "--json" in command else done.stdout + done.stderr
        if "--json" not in command:
            print(said, end="", flush=True)
        self.check(
            done.returncode == 0,
            f"{shlex.join(command)} ends with {done.returncode}: {done.stderr[-300:]}",
        )
        self.words(said if "--json" not in command else "", shlex.join(command))
        return said

    def words(self, text: str, where: str) -> None:
        """Check that a text has none of the words."""
        for word in UNSAID:
            self.check(re.search(rf"\b{word}\b", text) is None, f"{where} says {word!r}")

    def json(self, *words: object) -> dict[str, Any]:
        """What a command prints with ``--json``."""
        return json.loads(self.run(*words, "--json", "--force"))

    def page(self, name: str) -> str:
        """The text that a page shows."""
        text = re.sub(
            r"(?s)<(script|style).*?</\1>|<[^>]*>", " ", (self.folder / name).read_text("utf-8")
        )
        self.words(unescape(text), name)
        return " ".join(unescape(text).split())

    def written(self, said: str, name: str) -> str:
        """The quality line of a screen, which names the size of the file."""
        size = bytes_text((self.folder / name).stat().st_size)
        self.check(f", {size}, in " in said, f"the screen says another size of {name} than {size}")
        lines = [line for line in said.splitlines() if re.fullmatch(LINE, line)]
        self.check(len(lines) == 1, f"{len(lines)} quality lines of {name}")
        return lines[0] if lines else ""


def downloaded(proof: Proof, scene: Path) -> None:
    """The way of somebody with a downloaded splat: a lossy file with a page and a picture."""
    name = scene.name.partition(".")[0]
    files = {"-o": f"{name}.sog", "--html": f"{name}.html", "--picture": f"{name}.png"}
    options = [word for pair in files.items() for word in pair]
    line = proof.written(
        proof.run("compact", scene, "--keep", "10%", "--effort", "instant", *options, "--force"),
        files["-o"],
    )
    alone = proof.written(
        proof.run("prune", scene, "--keep", "10%", "-o", files["-o"], "--force"), files["-o"]
    )
    proof.check(line == alone, f"compact without a repair says {line!r}, prune {alone!r}")
    proof.check(line in proof.page(files["--html"]), f"{files['--html']} lacks {line!r}")
    titles = Image.open(proof.folder / files["--picture"]).text["Description"]
    proof.check(
        all(part in titles for part in line.split(": ")),
        f"{files['--picture']} lacks {line!r}: {titles!r}",
    )
    sizes = [bytes_text(path.stat().st_size) for path in (scene, proof.folder / files["-o"])]
    proof.check(
        all(size in titles for size in sizes),
        f"{files['--picture']} lacks a size of {sizes}: {titles!r}",
    )
    text = (proof.folder / files["--html"]).read_text(
        "utf-8"
    )  # names of scenes are in the page's data
    proof.check(all(size in text for size in sizes), f"{files['--html']} lacks a size of {sizes}")
    found = proof.json("prune", scene, "--keep", "10%", "-o", files["-o"])
    about = proof.json("info", scene)
    proof.check(found["quality"] == line, f"the JSON of prune says {found['quality']!r}")
    proof.check(
        found["bytes"] == (proof.folder / files["-o"]).stat().st_size, "the JSON has another size"
    )
    proof.check(about["bytes"] == scene.stat().st_size, "info says another size")
    if found["origin"].startswith("sampled"):
        proof.check(
            abs(about["fill"] - found["fill_before"]) < 0.05,
            f"fill {about['fill']}, {found['fill_before']}",
        )


def measured(proof: Proof, scene: Path) -> None:
    """The way of somebody who writes a paper: levels and a sweep agree with the commands for one
    scene."""
    name = scene.name.partition(".")[0]
    line = proof.written(
        proof.run("prune", scene, "--keep", "10%", "-o", f"{name}.ply", "--force"), f"{name}.ply"
    )
    figures = line.partition(":")[0]
    proof.run("lod", scene, "--levels", "10%", "-o", f"{name}_lod", "--force")
    level = json.loads((proof.folder / f"{name}_lod" / "lod.json").read_text("utf-8"))["levels"][0]
    proof.check(level["quality"] == line, f"lod says {level['quality']!r}, prune {line!r}")
    folder = f"{name}_tradeoff"
    said = proof.run(
        "tradeoff", scene, "--keep", "10%", "--repairs", "none", "-o", folder, "--force"
    )
    sweep = json.loads((proof.folder / folder / "tradeoff.json").read_text("utf-8"))
    point = sweep["points"][1]["against_dense"]
    found = f"{point['psnr']:.1f} dB, SSIM {point['ssim']:.2f}"
    proof.check(found == figures, f"tradeoff says {found!r}, prune {figures!r}")
    proof.check(line in said, f"tradeoff lacks {line!r}")
    page = proof.page(f"{folder}/tradeoff.html")
    cells = f"{point['psnr']:.2f} {point['ssim']:.3f}", line.partition(": ")[2]
    proof.check(all(text in page for text in cells), f"its page lacks one of {cells}")


def captured(proof: Proof, run: Path, data: Path | None) -> None:
    """The way of somebody with a capture: photos lead, on the screen and on the page."""
    where = [] if data is None else ["--data", data]
    options = [
        "--keep",
        "10%",
        "--photos",
        "--seconds",
        "60",
        *where,
        "-o",
        "photos.ply",
        "--html",
        "photos.html",
    ]
    line = proof.written(proof.run("compact", run, *options, "--force"), "photos.ply")
    proof.check(
        re.match(r"[\d.]+ (?:-> [\d.]+ )?dB in \d+ .*photos", line) is not None,
        f"photos do not lead {line!r}",
    )
    proof.check(line in proof.page("photos.html"), f"photos.html lacks {line!r}")


def main(
    splats: tyro.conf.Positional[tuple[Path, ...]],
    *,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/proof"),
    capture: Path | None = None,
    data: Path | None = None,
) -> None:
    """Go the ways of users with scenes at hand, and check what they are shown.

    Args:
        splats: files of splats.
        output: folder for what the commands write.
        capture: a trained run whose photos are found.
        data: folder of these photos, if they are not where the run says.
    """
    output.mkdir(parents=True, exist_ok=True)
    proof = Proof(output.resolve())
    for scene in splats:
        downloaded(proof, scene.resolve())
        measured(proof, scene.resolve())
    if capture is not None:
        captured(proof, capture.resolve(), data)
    print(f"{proof.checks - len(proof.wrong)} of {proof.checks} checks hold")
    if proof.wrong:
        sys.exit(1)


if __name__ == "__main__":
    tyro.cli(main)
