"""Takes frames of Replica through the whole method: trains a scene and a refiner on them, evaluates
on held-out frames, exports; and writes the row of the record.

    python -m lab.tables.replica_row replica/room0 -o outputs/room0 --json docs/record/replica.json
"""

from __future__ import annotations

import json
import resource
import shlex
import textwrap
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lab.common.printing import markdown, number, start
from lab.common.results import write_json
from lab.common.running import folder_of_run, run
from pointsplat_ns.nerfstudio_plugin.replica.layout import load_replica
from pointsplat_ns.refinement import read_metadata
from pointsplat_ns.scene.runs import METHOD_NAMES, RUN_FILES
from pointsplat_ns.tools.tradeoff.measuring import machine_text

HEADS = ("scene", "Gaussians", "MB", "PSNR", "SSIM", "LPIPS")

COMPARED = "merge,compact"
"""Ways of this package that ns-eval adds, of the same number of Gaussians."""

TIMESTAMP = "run"

EVALUATE = "evaluate"
"""The step that compares, as :data:`COMPARED` says."""

Step = tuple[str, str]
"""What a command does, and the command."""


def steps_of(
    scene: Path, output: Path, steps: int, scale: float, seconds: float, keep: str
) -> list[Step]:
    """The commands of the whole way, in their order; arguments as for :func:`main`."""
    name = scene.name
    scenes = output / "scenes"
    refined = folder_of_run(output / "refiner", name, METHOD_NAMES.refiner, TIMESTAMP)
    common = ["--vis", "tensorboard", "--timestamp", TIMESTAMP, "--experiment-name", name]
    train = ["ns-train", METHOD_NAMES.scene, *common, "--output-dir", scenes]
    train += ["--max-num-iterations", steps]
    train += ["--pipeline.datamanager.camera-res-scale-factor", f"{scale:g}"]
    tune = ["ns-train", METHOD_NAMES.refiner, *common, "--output-dir", output / "refiner"]
    tune += ["--data", scenes, "--init", "shipped", "--pipeline.model.keep", keep]
    evaluate = ["ns-eval", "--load-config", refined / "config.yml"]
    export = ["pointsplat", "export", refined, "-o", output / f"{name}_small.ply", "--force"]
    words = {
        "train the scene": [*train, "--data", scene, "replica-data"],
        "train the refiner": [*tune, "--seconds", f"{seconds:g}"],
        EVALUATE: [*evaluate, "--output-path", output / "eval.json"],
        "export": export,
    }
    return [(what, shlex.join(map(str, command))) for what, command in words.items()]


def row(evaluation: dict[str, Any], name: str) -> dict[str, dict[str, float | None]]:
    """Figures of each variant of the scene, from what ns-eval wrote: the dense scene, the
    selection, refined, and :data:`COMPARED`."""
    scene = evaluation["results"]["scenes"][name]
    wanted = ("gaussians", "megabytes", "psnr", "ssim", "lpips")
    return {
        variant: {measure: figures[measure] for measure in wanted}
        for variant, figures in scene.items()
        if isinstance(figures, dict)
    }


def section(content: dict[str, Any]) -> str:
    """The part of the page of the record, from the JSON that :func:`main` writes."""
    written = (number(0), number(2), number(2), number(3), number(3))
    lines = [
        [variant, *(write(value) for write, value in zip(written, figures.values(), strict=True))]
        for variant, figures in content["row"].items()
    ]
    taken = "; ".join(f"{what} {spent:.0f} s" for what, spent in content["cpu_seconds"].items())
    wrapped = (textwrap.wrap(line, 114, break_on_hyphens=False) for line in content["commands"])
    commands = "\n".join(" \\\n    ".join(words) for words in wrapped)
    size = f"{content['width']} x {content['height']}"
    about = (
        f"Replica itself, {size}: {content['trained']} frames train, {content['held_out']} "
        "are held out. They lie close to each other, so these figures show that the whole way "
        "works, and not quality. The network starts from the one that ships and takes "
        f"{content['refiner_steps']:,} steps on the photos of this scene (*own photos*). PSNR "
        "(dB), SSIM and LPIPS (AlexNet) are against the held-out photos, at "
        f"{content['scale']:g} of their size."
    )
    return f"""## {content["frames"]} frames of one room: Replica's {content["scene"]}

{textwrap.fill(about, 120)}

{markdown(HEADS, lines)}

```bash
{commands}
```

CPU time on {content["machine"]}: {taken}."""


def _cpu_seconds() -> float:
    """CPU seconds of all commands so far, which others on the machine do not stretch."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main(
    scene: tyro.conf.Positional[Path],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    *,
    steps: int = 1_000,
    scale: float = 0.5,
    seconds: float = 300.0,
    keep: str = "10%",
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Train on nine of ten frames of a scene in Replica's layout, and judge on the others.

    Args:
        scene: folder of the scene, with ``cam_params.json`` beside or in it.
        output: folder for runs, logs and results, which must not have runs of an earlier call.
        steps: of splatfacto-cpu.
        scale: factor on the size of the photos, in training and evaluation.
        seconds: of training the refiner.
        keep: budget of the selection.
        json_path: write the row of the record there.
    """
    frames = load_replica(scene)
    commands = steps_of(scene, output, steps, scale, seconds, keep)
    spent = {}
    for what, command in commands:
        begun = _cpu_seconds()
        log = output / "logs" / f"{what.replace(' ', '_')}.txt"
        run(command, log, POINTSPLAT_COMPARE=COMPARED)
        spent[what] = _cpu_seconds() - begun
    found = json.loads((output / "eval.json").read_text("utf-8"))
    held_out = found["results"]["scenes"][scene.name]["views"]
    refined = folder_of_run(output / "refiner", scene.name, METHOD_NAMES.refiner, TIMESTAMP)
    weights = refined / RUN_FILES.refiner
    content = {
        "scene": scene.name,
        "frames": len(frames),
        "trained": len(frames) - held_out,
        "held_out": held_out,
        "width": frames.params.width,
        "height": frames.params.height,
        "scale": scale,
        "machine": machine_text(torch.device("cpu")),
        "commands": [
            f"POINTSPLAT_COMPARE={COMPARED} {text}" if what == EVALUATE else text
            for what, text in commands
        ],
        "cpu_seconds": spent,
        "refiner_steps": read_metadata(weights)["steps"],
        "row": row(found, scene.name),
    }
    write_json(json_path, content)
    print(section(content))


if __name__ == "__main__":
    start(main)
