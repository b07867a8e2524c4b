"""What refinement is worth on scenes that the refiner never saw: trains refiners, judges them, prints the table.

    python benchmarks/refinement.py train --scenes SCENES --eval-scenes room50 room51 --output OUT --steps 600
    python benchmarks/refinement.py evaluate --refiners OUT --scenes RUN RUN --json rows.json --pictures pictures
    python benchmarks/refinement.py report rows.json --groups unseen=room50,room51 kitchen=kitchen --markdown

Everything that is finished is kept and not done again, so each command can be stopped and given anew. ``train`` runs
the ``ns-train`` commands that a person would type and prints them; one of it at a time may work on an output folder.
Several ``evaluate`` may run side by side with a JSON file each, which ``report`` reads together.
"""

from __future__ import annotations

import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.commands import train_refiner_command

TIMESTAMP = "benchmark"
"""Names the runs, so that what is finished is found again."""

Start = Literal["paper", "merge"]
Encoder = Literal["dual", "concat"]


def train(
    scenes: Path,
    output: Path,
    steps: int,
    eval_scenes: tuple[str, ...] = (),
    starts: tuple[Start, ...] = ("paper", "merge"),
    encoders: tuple[Encoder, ...] = ("dual", "concat"),
    seeds: tuple[int, ...] = (0, 1, 2),
    keeps: tuple[float, ...] = (0.1, 0.3, 0.5),
    size: Literal["tiny", "small", "full"] = "tiny",
    workers: int = 1,
    extra: str = "",
    extra_paper: str = "",
    extra_merge: str = "",
) -> None:
    """Train a refiner for each start, encoder and seed, all of one seed before the next.

    Supervision is dense: nothing but renders of the dense scenes at their datasets' training poses is learned from.

    Args:
        scenes: folder above the trained scenes.
        output: folder for the refiners and what the trainings say.
        steps: of each training.
        eval_scenes: names of scenes never to train on.
        starts: how scenes are pruned before they are refined.
        encoders: of the network.
        seeds: of the weights, the order of scenes and the choice of poses; each is a training of its own.
        keeps: shares of the Gaussians; one network learns to repair all of them.
        size: of the network.
        workers: trainings side by side; more than one take one thread each.
        extra: more arguments of ns-train for all trainings, as --extra="--rates paper" (with the equals sign).
        extra_paper: and for those that start from the paper's selection.
        extra_merge: and for those that start from merged scenes.
    """
    more = {"paper": extra_paper, "merge": extra_merge}
    jobs = []
    for seed in seeds:
        for encoder in encoders:
            for start in starts:  # innermost: trainings side by side then do not prune the same scenes
                name = f"{start}-{encoder}-seed{seed}"
                words = shlex.split(extra) + shlex.split(more[start])
                command = train_command(
                    name, scenes, output, steps, eval_scenes, start, encoder, seed, keeps, size, words
                )
                jobs.append((name, command))
    failed: list[str] = []

    def work(job: tuple[str, str]) -> None:
        try:
            _train_one(output, *job, steps, 1 if workers > 1 else None)
        except PointSplatError as error:  # the others go on
            print(f"error: {error}", file=sys.stderr, flush=True)
            failed.append(job[0])

    with ThreadPoolExecutor(workers) as pool:
        try:
            list(pool.map(work, jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    if failed:
        raise PointSplatError(f"{len(failed)} of {len(jobs)} trainings failed: {', '.join(failed)}")
    print(f"{len(jobs)} refiners are in {output}")


def train_command(
    name: str,
    scenes: Path,
    output: Path,
    steps: int,
    eval_scenes: tuple[str, ...],
    start: str,
    encoder: str,
    seed: int,
    keeps: tuple[float, ...],
    size: str,
    extra: list[str],
) -> str:
    """The command line of one training."""
    options: dict[str, object] = {
        "steps-per-eval-image": 0,
        "pipeline.datamanager.supervision": "dense",
        "pipeline.datamanager.seed": seed,
        "pipeline.model.by": start,
        "pipeline.model.encoder": encoder,
        "pipeline.model.size": size,
        "pipeline.model.pruned-folder": output / "pruned",
        "pipeline.model.keep": keeps[0],
    }
    if keeps[1:]:
        options["pipeline.model.more-keeps"] = keeps[1:]
    command = train_refiner_command(scenes, output, name, steps, TIMESTAMP, eval_scenes, options)
    return shlex.join([*shlex.split(command), *extra])


def _train_one(output: Path, name: str, command: str, steps: int, threads: int | None) -> None:
    """Train unless that is done.

    Raises:
        PointSplatError: if it fails, or was done by another command.
    """
    from pointsplat_ns.nerfstudio_plugin.running import finished, remove_interrupted, run

    logs = output / "logs"
    note = logs / f"{name}.command"
    if note.exists() and note.read_text("utf-8") != command:
        raise PointSplatError(f"{output / name}: is of another command, see {note}; name another --output")
    if finished(output / name / "pointsplat" / TIMESTAMP, steps):
        print(f"{name}: trained already")
        return
    remove_interrupted(output / name / "pointsplat" / TIMESTAMP)
    logs.mkdir(parents=True, exist_ok=True)
    note.write_text(command, "utf-8")
    run(command, logs / f"{name}.txt", threads)


def evaluate(
    refiners: Path,
    scenes: tuple[Path, ...],
    json_path: Annotated[Path, tyro.conf.arg(name="json")],
    keeps: tuple[float, ...] = (0.1, 0.3, 0.5),
    starts: tuple[Start, ...] = ("paper", "merge"),
    views: int = 8,
    fine_tune: int = 300,
    photos: bool = False,
    lpips: bool = True,
    pictures: Path | None = None,
    threads: int | None = None,
) -> None:
    """Judge dense, selected, refined and fine-tuned scenes in held-out views; every row is written as it is known.

    Args:
        refiners: folder above trained refiners.
        scenes: Splatfacto runs whose photos are at hand.
        json_path: rows go there; those that it has are not computed again.
        keeps: shares of the Gaussians.
        starts: how scenes are pruned.
        views: at most so many held-out views of each scene.
        fine_tune: steps of per-scene fine-tuning against the dense scene's renders at its training poses; 0 for none.
        photos: fine-tune against the training photos as well.
        lpips: whether to compute LPIPS.
        pictures: folder for a picture of one held-out view of each scene and share.
        threads: of torch; one each when several evaluations share a machine.
    """
    import torch
    from held_out import lpips_or_none
    from refinement_rows import Judge, Rows, find_refiners

    if not refiners.is_dir():
        raise PointSplatError(f"{refiners}: no such folder; expected trained refiners below it")
    if threads is not None:
        torch.set_num_threads(threads)
    trained = [t for t in find_refiners(refiners) if t.start in starts]
    print(f"{len(trained)} refiners: {'; '.join(t.label for t in trained) or 'none'}", flush=True)
    network = lpips_or_none(lpips)
    settings = {"views": views, "fine_tune": fine_tune, "lpips": network is not None}
    rows = Rows(json_path, settings)
    for path in scenes:
        judge = Judge(path, trained, rows, network, views, lambda text: print(text, flush=True))
        judge.dense_row()
        for keep in keeps:
            judge.budget(keep, starts, fine_tune, photos, pictures)


def report(
    files: tyro.conf.Positional[tuple[Path, ...]],
    groups: tuple[str, ...] = (),
    markdown: bool = False,
) -> None:
    """Print means, gains with their spread over seeds, and which targets are met.

    Args:
        files: of evaluate.
        groups: NAME=SCENE,SCENE...; targets of quality are those of the group "unseen", or of the first. By default
            every scene that no refiner was trained on is in "unseen", and the others are in "seen".
        markdown: print Markdown tables, too.
    """
    from refinement_report import Table as Rows
    from refinement_report import default_groups, parse_groups, print_report, read_files

    rows, settings = read_files(files)
    table = Rows(rows)
    print_report(table, parse_groups(groups, table) if groups else default_groups(rows), settings, markdown)


def main() -> None:
    """Run one of the commands; input that cannot be used ends it with one line."""
    commands = {"train": train, "evaluate": evaluate, "report": report}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="refinement.py")
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
