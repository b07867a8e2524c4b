"""Fuzzes the readers of files that a stranger may have written, guided by coverage (needs ``pip install atheris``).

    OMP_NUM_THREADS=1 python benchmarks/fuzzing.py --readers ply spz --seconds 1800

Each reader (:mod:`fuzz_readers`) begins with the files that are kept in ``tests/benchmarks/fuzz_corpus``, which the
test suite reads as well. Whatever is neither read nor refused by one typed error in one line, or takes more than 5
seconds or more memory than it should (:mod:`fuzz_judge`), is written to the output folder, once per place in the code.
"""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

CORPUS = Path(__file__).resolve().parents[1] / "tests" / "benchmarks" / "fuzz_corpus"

INSTRUMENTED = ["pointsplat_ns", "plyfile", "yaml", "nerfstudio.data.dataparsers", "fuzz_readers", "fuzz_texts"]
"""Packages whose branches guide the search."""

MOST_CORPUS = 9000
"""Bytes of the files that are kept of a reader, at most."""

HEADROOM = 4 << 30
"""Address space beyond what is taken at the start, bytes; more than that fails as out of memory."""


@dataclass
class Result:
    """What fuzzing one reader came to."""

    reader: str
    runs: int = 0
    seconds: float = 0.0
    """Of fuzzing, without the start."""
    cpu_seconds: float = 0.0
    """Of the processor, with the start: less than ``seconds`` where other programs run."""
    kept: int = 0
    """Inputs that reach something of their own."""
    findings: int = 0


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
            nothing that smaller files do not.
    """
    known = [path.name for path in sorted(corpus.iterdir())]
    unknown = set(readers) - set(known)
    if unknown:
        raise SystemExit(f"no reader {', '.join(sorted(unknown))}; expected {', '.join(known)}")
    if minimise:
        for name in readers or known:
            print(f"{name}: {minimised(name, corpus / name, output / name)} files")
        return
    print("| Reader | Inputs | Seconds | CPU seconds | Kept | Findings |\n|---|---|---|---|---|---|")
    for name in readers or known:
        found = fuzzed(name, seconds, corpus / name, output / name, most_bytes, seed)
        times = (f"{found.seconds:.0f}", f"{found.cpu_seconds:.0f}")
        row = (f"{found.runs:,}", *times, f"{found.kept:,}", str(found.findings))
        print(f"| {name} | {' | '.join(row)} |", flush=True)


def fuzzed(name: str, seconds: int, seeds: Path, output: Path, most_bytes: int, seed: int) -> Result:
    """Fuzz one reader for some seconds, in processes of their own: a crash or a hang ends one."""
    result = Result(name)
    kept, found = output / "kept", output / "found"
    for folder in (kept, found):
        folder.mkdir(parents=True, exist_ok=True)
    while (left := round(seconds - result.seconds)) > 0:
        command = [sys.executable, __file__, "--child", name, str(found)]
        command += [f"-max_total_time={left}", f"-max_len={most_bytes}", "-timeout=20", "-rss_limit_mb=0"]
        command += ["-print_final_stats=1", f"-seed={seed}", f"-artifact_prefix={found}/", str(kept), str(seeds)]
        start, cpu = time.monotonic(), _cpu_of_children()
        with (output / "log.txt").open("w") as log:
            status = subprocess.run(command, stderr=log, stdout=log).returncode
        said = (output / "log.txt").read_text("utf-8", "replace")
        runs = re.findall(r"stat::number_of_executed_units: (\d+)", said) or re.findall(r"^#(\d+)", said, re.M)
        if not runs:
            raise SystemExit(f"{name} did not start; see {output / 'log.txt'}")
        result.runs += int(runs[-1])
        result.cpu_seconds += _cpu_of_children() - cpu
        took = re.findall(r"^Done \d+ runs in (\d+) second", said, re.M)  # without the start, which imports torch
        result.seconds += float(took[-1]) if took else time.monotonic() - start
        seed += 1
        if status == 0:
            break
    result.kept, result.findings = len(list(kept.iterdir())), len(list(found.iterdir()))
    return result


def minimised(name: str, corpus: Path, output: Path) -> int:
    """Choose the corpus of a reader anew, of what is in it and what fuzzing kept and found; the number of its files."""
    import logging
    import shutil

    from fuzz_minimise import HASH, fewest
    from fuzz_readers import READERS

    logging.getLogger("pointsplat_ns").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory(dir=_fast()) as folder:
        places = (corpus, output / "kept", output / "found")
        files = [path for place in places if place.is_dir() for path in place.iterdir()]
        chosen = fewest(READERS[name](Path(folder)), files, INSTRUMENTED, MOST_CORPUS)
    for path in chosen:
        if path.parent != corpus:
            shutil.copy(path, corpus / path.name[:HASH])
    names = {path.name if path.parent == corpus else path.name[:HASH] for path in chosen}
    for path in corpus.iterdir():
        if path.name not in names:
            path.unlink()
    return len(chosen)


def child(name: str, found: Path, options: list[str]) -> None:
    """Fuzz a reader in this process, which ends with it."""
    import atheris
    import torch

    with atheris.instrument_imports(include=INSTRUMENTED), tempfile.TemporaryDirectory(dir=_fast()) as folder:
        import logging

        from fuzz_judge import Wrong, judge
        from fuzz_readers import READERS

        logging.getLogger("pointsplat_ns").setLevel(logging.CRITICAL)
        torch.set_num_threads(1)
        read = READERS[name](Path(folder))
        for path in sorted(Path(options[-1]).iterdir()):  # what is imported when it is first needed is instrumented too
            try:
                judge(read, path.read_bytes())
            except Wrong as wrong:
                print(f"{path.name}: {wrong}", file=sys.stderr)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + HEADROOM, taken + HEADROOM))

        def one_input(data: bytes) -> None:
            try:
                judge(read, data)
            except Wrong as wrong:
                place = found / re.sub(r"\W+", "-", re.sub(r"\d+ MB.*", "MB", str(wrong)).partition("(")[0])[:80]
                if not place.exists():
                    place.write_bytes(data)
                    print(f"finding: {wrong}", file=sys.stderr)

        atheris.Setup([sys.argv[0], *options], one_input)
        atheris.Fuzz()


def _cpu_of_children() -> float:
    """CPU seconds of the processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _fast() -> str | None:
    """A folder in memory, where there is one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(sys.argv[2], Path(sys.argv[3]), sys.argv[4:])
    else:
        tyro.cli(main)
