"""Fuzzes the readers of files that a stranger may have written, guided by coverage (needs ``pip install atheris``).

    OMP_NUM_THREADS=1 python -m lab.robustness.fuzzing --readers ply spz --seconds 1800

Each reader (:mod:`lab.robustness.fuzz_readers`) begins with the files that are kept in ``tests/lab/fuzz_corpus``, which
the test suite reads as well. Whatever is neither read nor refused by one typed error in one line, or takes more than 5
seconds or more memory than it should (:mod:`lab.robustness.fuzz_judge`), is written to the output folder, once per
place in the code. ``--minimise`` takes the smallest files that reach all branches into the corpus, by libFuzzer.
"""

from __future__ import annotations

import re
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lab.common.printing import start

ROOT = Path(__file__).resolve().parents[2]
CORPUS = ROOT / "tests" / "lab" / "fuzz_corpus"

INSTRUMENTED = ["pointsplat_ns", "plyfile", "yaml", "nerfstudio.data.dataparsers", "lab.robustness.fuzz_readers"]
"""Packages whose branches guide the search."""

NAMED = 16
"""Letters of a corpus file's name from which it is a fuzzer's; shorter ones are those that people gave, and stay."""

HEADROOM = 4 << 30
"""Address space beyond what is taken at the start, bytes; more than that fails as out of memory."""


def main(
    readers: tuple[str, ...] = (),
    seconds: int = 60,
    corpus: Path = CORPUS,
    output: Path = Path("outputs/fuzzing"),
    most_bytes: int = 4096,
    seed: int = 1,
    minimise: bool = False,
) -> None:
    """Fuzz readers one after the other, and print how many inputs each got.

    Args:
        readers: their names; all by default.
        seconds: for each.
        corpus: folder with a folder of files to begin with for each reader.
        output: folder for the inputs that were kept, and for findings.
        most_bytes: size of an input, at most.
        seed: of the random changes.
        minimise: instead, put what earlier fuzzing kept in the output folder into the corpus, and take out what reaches
            nothing that smaller files do not. Files with names that people gave stay.
    """
    known = [path.name for path in sorted(corpus.iterdir())]
    if unknown := set(readers) - set(known):
        raise SystemExit(f"no reader {', '.join(sorted(unknown))}; expected {', '.join(known)}")
    if not minimise:
        print("| Reader | Inputs | Seconds | CPU seconds | Kept | Findings |\n|---|---|---|---|---|---|")
    for name in readers or known:
        if minimise:
            print(f"{name}: {minimised(name, corpus / name, output.resolve() / name)} files", flush=True)
        else:
            cells = fuzzed(name, seconds, corpus / name, output.resolve() / name, most_bytes, seed)
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


def fuzzed(name: str, seconds: int, seeds: Path, output: Path, most_bytes: int, seed: int) -> list[str]:
    """Fuzz one reader for some seconds, in processes of their own: a crash or a hang ends one.

    Returns:
        Inputs, seconds without the start, CPU seconds with it, inputs kept, findings.
    """
    kept, found = output / "kept", output / "found"
    runs, spent, cpu = 0, 0.0, _cpu_of_children()
    for folder in (kept, found):
        folder.mkdir(parents=True, exist_ok=True)
    while (left := round(seconds - spent)) > 0:
        options = [f"-max_total_time={left}", f"-max_len={most_bytes}", "-timeout=20", "-rss_limit_mb=0"]
        options += ["-print_final_stats=1", f"-seed={seed}", f"-artifact_prefix={found}/"]
        began = time.monotonic()
        status, said = _libfuzzer(name, output, [*options, str(kept), str(seeds.resolve())])
        done = re.findall(r"stat::number_of_executed_units: (\d+)", said) or re.findall(r"^#(\d+)", said, re.M)
        if not done:
            raise SystemExit(f"{name} did not start; see {output / 'log.txt'}")
        runs += int(done[-1])
        took = re.findall(r"^Done \d+ runs in (\d+) second", said, re.M)  # without the start, which imports torch
        spent += float(took[-1]) if took else time.monotonic() - began
        seed += 1
        if status == 0:
            break
    counts = (len(list(kept.iterdir())), len(list(found.iterdir())))
    return [f"{runs:,}", f"{spent:.0f}", f"{_cpu_of_children() - cpu:.0f}", *(f"{count:,}" for count in counts)]


def minimised(name: str, corpus: Path, output: Path) -> int:
    """Choose the corpus of a reader anew, of what is in it and what fuzzing kept; the number of its files."""
    chosen = output / "chosen"
    chosen.mkdir(parents=True, exist_ok=True)
    (output / "kept").mkdir(exist_ok=True)
    status, _ = _libfuzzer(name, output, ["-merge=1", str(chosen), str(corpus.resolve()), str(output / "kept")])
    if status != 0 or not any(chosen.iterdir()):
        raise SystemExit(f"{name} could not be merged; see {output / 'log.txt'}")
    for path in corpus.iterdir():
        if len(path.name) >= NAMED:
            path.unlink()
    known = {path.read_bytes() for path in corpus.iterdir()}
    for path in chosen.iterdir():
        if path.read_bytes() not in known:
            (corpus / path.name[:NAMED]).write_bytes(path.read_bytes())
    return len(list(corpus.iterdir()))


def _libfuzzer(name: str, output: Path, options: list[str]) -> tuple[int, str]:
    """Run libFuzzer on a reader in a process; its status, and what it said, which is in log.txt too."""
    command = [sys.executable, "-m", "lab.robustness.fuzzing", "--child", name, str(output / "found"), *options]
    with (output / "log.txt").open("w") as log:
        status = subprocess.run(command, cwd=ROOT, stderr=log, stdout=log).returncode
    return status, (output / "log.txt").read_text("utf-8", "replace")


def child(name: str, found: Path, options: list[str]) -> None:
    """Fuzz a reader in this process, which ends with it."""
    import atheris
    import torch

    fast = "/dev/shm" if Path("/dev/shm").is_dir() else None  # in memory
    with atheris.instrument_imports(include=INSTRUMENTED), tempfile.TemporaryDirectory(dir=fast) as folder:
        import logging

        from lab.robustness.fuzz_judge import Wrong, judge
        from lab.robustness.fuzz_readers import READERS

        logging.getLogger("pointsplat_ns").setLevel(logging.CRITICAL)
        torch.set_num_threads(1)
        read = READERS[name](Path(folder))

        def one_input(data: bytes) -> None:
            try:
                judge(read, data)
            except Wrong as wrong:
                place = found / re.sub(r"\W+", "-", re.sub(r"\d+ MB.*", "MB", str(wrong)).partition("(")[0])[:80]
                if not place.exists():
                    place.write_bytes(data)
                    print(f"finding: {wrong}", file=sys.stderr)

        for path in sorted((CORPUS / name).iterdir()):  # what is imported when first needed is instrumented too
            one_input(path.read_bytes())
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + HEADROOM, taken + HEADROOM))
        again = shlex.join([sys.executable, "-m", "lab.robustness.fuzzing", "--child", name, str(found)])
        atheris.Setup([again, *options], one_input)  # libFuzzer starts itself by a shell when it merges
        atheris.Fuzz()


def _cpu_of_children() -> float:
    """CPU seconds of the processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], Path(sys.argv[3]), sys.argv[4:])
    else:
        start(main)
