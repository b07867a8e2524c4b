"""Kills commands that write, with SIGKILL at random moments, and looks at what is left.

    OMP_NUM_THREADS=1 python -m lab.robustness.kills --kills 250

Each command works on a tiny scene, in a process forked from this one, which has imported everything. After a kill no
file may have its final name that is not whole; what is unfinished has a hidden name. Then the same command is given
again, and has to end with the files that an undisturbed one gives: the same bytes, where no time of day or duration is
in them. Trainings go on from their last checkpoint, and have to have the losses of an undisturbed one.
"""

from __future__ import annotations

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")  # only one thread can be forked

import importlib
import pkgutil
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pointsplat_ns as ps
from lab.common.printing import start
from lab.robustness.kill_checks import differences, files_of, losses_of, not_whole, training_left


@dataclass
class Outcomes:
    """What kills of one command came to."""

    seconds: float
    """Of the undisturbed command."""
    counts: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Command:
    """What is killed: a function of the folder that it writes to, run with an input folder as the current one."""

    name: str
    run: Callable[[Path], None]
    again: Callable[[Path], None] | None = None
    """What finishes it; by default the same command."""
    weight: float = 1.0
    """Of its share of the kills; less for what takes long."""


def pointsplat(words: str) -> Callable[[Path], None]:
    """A ``pointsplat`` command; OUT stands for its folder."""

    def run(folder: Path) -> None:
        from pointsplat_ns.cli import main

        main([word.replace("OUT", str(folder)) for word in words.split()])

    return run


COMPACT = "compact scene.ply -o OUT/small.ply --html OUT/small.html"
TABLES = "--keeps 0.3 --views 2 --side 48 --scoring-views 2 --fine-tune 2 --only */merge/30% */random/30%"

COMMANDS = (
    Command("prune", pointsplat("prune scene.ply --keep 30% -o OUT/small.ply")),
    # Between its two files it leaves the first, which is not overwritten unless that is asked for.
    Command("compact", pointsplat(COMPACT), pointsplat(f"{COMPACT} --force")),
    Command("compact of a folder", pointsplat("compact scenes --effort instant -o OUT/small")),
    Command("convert to SPZ", pointsplat("convert scene.ply OUT/a.spz")),
    Command("convert to a SOG folder", pointsplat("convert scene.ply OUT/meta.json")),
    Command("convert to glTF", pointsplat("convert scene.ply OUT/a.glb")),
    Command("lod", pointsplat("lod scene.ply --levels 50% 20% -o OUT/lod")),
    Command(
        "tradeoff",
        pointsplat("tradeoff scene.ply -o OUT --points 3 --views 2 --resolution 48x36 --drawn exact --repairs none"),
    ),
    Command("tables", pointsplat(f"tables scene.ply -o OUT {TABLES}")),
    Command("rooms", pointsplat("rooms -o OUT --seeds 0 1 --frames 3 --width 32 --height 24")),
    Command("render", pointsplat("render scene.ply -o OUT/a.mp4 --width 32 --height 24 --seconds 1")),
    Command("export", pointsplat("export run -o OUT/a.ply")),
    Command("report", pointsplat("report evaluation.json --html OUT/a.html")),
    Command(
        "make-feedback",
        pointsplat("make-feedback scene.ply -o OUT/a.safetensors --keep 50% --updates 1 --at-once 1"),
        weight=0.25,
    ),
)

SLOW_IMPORTS = (
    *("av", "filelock", "kornia.metrics", "matplotlib.backends.backend_agg", "plyfile", "PIL.WebPImagePlugin"),
    *("safetensors.torch", "scipy.spatial", "torchmetrics.image", "zstandard"),
)
"""What commands import when they first need it; here it is shared by all that are forked."""

STEPS, SAVED_EVERY = 24, 5


def train(folder: Path) -> None:
    """A training, or what goes on with its last checkpoint; each loss is a line of a file."""
    import torch

    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    checkpoints = sorted((folder / "room").rglob("step-*.ckpt"))
    config = splatfacto_cpu_config()
    config.machine.device_type, config.experiment_name, config.output_dir = "cpu", "room", folder
    config.timestamp = f"2026-01-01_{len(list((folder / 'room').glob('*/*'))):06d}"
    config.pipeline.datamanager.dataparser = ReplicaDataParserConfig(num_seed_points=200)
    config.pipeline.datamanager.data = config.data = Path("room").resolve()
    config.pipeline.model.refine_every, config.steps_per_save, config.early_look = 10, SAVED_EVERY, False
    config.max_num_iterations = STEPS
    if checkpoints:
        config.load_dir = checkpoints[-1].parent
        config.max_num_iterations = STEPS - config.first_step()
    torch.manual_seed(0)
    random.seed(0)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    step_of = trainer.train_iteration
    with (folder / f"losses-{config.first_step()}.txt").open("w") as losses:

        def noted(step: int):
            result = step_of(step)
            print(step, result[0].item().hex(), file=losses, flush=True)
            return result

        trainer.train_iteration = noted
        if config.max_num_iterations > 0:
            trainer.train()


TRAIN = Command("train", train)


def main(
    kills: int = 250, commands: tuple[str, ...] = (), seed: int = 0, keep: Path | None = None, training: bool = True
) -> None:
    """Kill commands, and print a table of what was left.

    Args:
        kills: how many in all, shared out among the commands.
        commands: names; all by default.
        seed: of the moments.
        keep: folder for what is left where something is wrong.
        training: kill trainings too, which need nerfstudio.
    """
    possible = [*COMMANDS, TRAIN] if training else [c for c in COMMANDS if c.name != "export"]  # of a trained run
    chosen = [c for c in possible if not commands or c.name in commands]
    generator = random.Random(seed)
    begin = time.monotonic()
    print("| Command | Seconds | Kills | Nothing there yet | Unfinished, hidden | Some files | All there | Faults |")
    print("|---|---|---|---|---|---|---|---|")
    done = 0
    with tempfile.TemporaryDirectory() as place:
        prepare(Path(place), training)
        for number, command in enumerate(chosen):
            share = round((kills - done) * command.weight / sum(other.weight for other in chosen[number:]))
            found = killed(command, share, generator, Path(place), keep)
            done += share
            kinds = [str(found.counts[kind]) for kind in ("nothing", "hidden", "some", "all")]
            row = (command.name, f"{found.seconds:.2f}", str(share), *kinds, str(len(found.faults)))
            print(f"| {' | '.join(row)} |", flush=True)
            for fault in found.faults:
                print(f"  {command.name}: {fault}", flush=True)
    print(f"{done} kills in {time.monotonic() - begin:.0f} s")


def prepare(place: Path, training: bool) -> None:
    """Lay out the inputs in a folder, and make it the current one."""
    import json

    from pointsplat_ns.compression import repair
    from pointsplat_ns.looking import view_source
    from pointsplat_ns.rooms import light

    os.chdir(place)
    for module in pkgutil.walk_packages(ps.__path__, "pointsplat_ns."):
        if "nerfstudio_plugin" not in module.name:
            importlib.import_module(module.name)
    for name in SLOW_IMPORTS:
        importlib.import_module(name)
    scene = ps.example_room()[::150]
    ps.save(scene, "scene.ply")
    for name in "abc":
        ps.save(scene[:200], f"scenes/{name}.ply")
    row = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "gaussians": 10, "megabytes": 1.0, "fps": 5.0}
    rows = {variant: row for variant in ("dense", "pruned", "refined")}
    results = {"settings": {}, "average": rows, "scenes": {"a": {"seen_in_training": True, **rows}}}
    Path("evaluation.json").write_text(json.dumps({"results": results}))
    # Tiny views, few steps and coarse rooms: what is looked at is files.
    view_source.RESOLUTION = (48, 36)
    repair.STEPS["quick"] = 2
    light.TEXEL, light.LUMEL = 0.2, 1.0
    if training:
        import method_configs.methods  # noqa: F401  (as nerfstudio does)
        from pointsplat_ns.nerfstudio_plugin.third_party_warnings import import_nerfstudio

        import_nerfstudio()
    forked(lambda _: ps.write_room("room", 0, 8, 32, 24, progress=False), place)
    if training:
        forked(train, place / "trained")
        [run] = (place / "trained" / "room").glob("*/*")
        run.rename(place / "run")


def killed(command: Command, kills: int, generator: random.Random, place: Path, keep: Path | None) -> Outcomes:
    """Kill a command again and again, and compare what is left and what comes of going on with an undisturbed one."""
    whole = place / "whole"
    forked(command.run, whole)  # what is read for the first time takes longer
    shutil.rmtree(whole)
    begin = time.monotonic()
    status = forked(command.run, whole)
    outcomes = Outcomes(time.monotonic() - begin)
    if status != 0:
        outcomes.faults.append(f"ends with {status} undisturbed: {(place / 'said.txt').read_text()[-300:]}")
        return outcomes
    expected = files_of(whole)
    for number in range(kills):
        folder = place / "killed"
        moment = generator.uniform(0, 1.05 * outcomes.seconds)
        forked(command.run, folder, moment)
        faults = not_whole(folder)
        left = files_of(folder)
        hidden = any(any(part.startswith(".") for part in path.parts) for path in folder.rglob("*"))
        finished = left.keys() == expected.keys() and command is not TRAIN
        outcomes.counts["all" if finished else "some" if left else "hidden" if hidden else "nothing"] += 1
        if command is TRAIN:
            faults += training_left(folder)
        if not finished:
            status = forked(command.again or command.run, folder)
            if status != 0:
                faults.append(f"again ends with {status}: {(place / 'said.txt').read_text()[-300:]}")
        faults += [f"{fault}, in the end" for fault in not_whole(folder)]
        if command is TRAIN:
            faults += [] if losses_of(folder) == losses_of(whole) else ["other losses than undisturbed"]
        else:
            faults += differences(folder, whole)
        outcomes.faults += [f"killed after {moment:.3f} s: {fault}" for fault in faults]
        if faults and keep is not None:
            shutil.copytree(folder, keep / f"{command.name}-{number}", dirs_exist_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
    shutil.rmtree(whole, ignore_errors=True)
    return outcomes


def forked(run: Callable[[Path], None], folder: Path, seconds: float | None = None) -> int:
    """Run a function in a process forked from this one, and kill it after some seconds, with all that it started.

    Returns:
        Its exit status; the negative number of the signal that ended it.
    """
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            os.setsid()
            said = os.open("said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(said, 1)
            os.dup2(said, 2)
            run(folder)
            status = 0
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(status)
    if seconds is not None:
        time.sleep(seconds)
        try:
            os.killpg(pid, signal.SIGKILL)
        except ProcessLookupError:
            os.kill(pid, signal.SIGKILL)  # it has no group yet, or has ended
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


if __name__ == "__main__":
    start(main)
