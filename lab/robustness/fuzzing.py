"""Fuzzes a reader of files that a stranger may have written, guided by coverage (needs ``pip
install atheris``).

    OMP_NUM_THREADS=1 python -m lab.robustness.fuzzing ply --seconds 1800
    OMP_NUM_THREADS=1 python -m lab.robustness.fuzzing ply --minimise

libFuzzer begins with the files in ``tests/lab/fuzz_corpus``, which the test suite reads as well,
and keeps new ones in the output folder. It ends at the first file that is neither read nor refused
by one typed error in one line, or takes more than 5 seconds or more memory than it should, and
writes it to the output folder. ``--minimise`` adds to the corpus the kept files that reach new
branches.
"""

from __future__ import annotations

import logging
import shlex
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import tyro

from lab.common.printing import start
from lab.common.timing import start_of_peak, status_bytes
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.scene.gaussians import Gaussians

CORPUS = Path(__file__).resolve().parents[2] / "tests" / "lab" / "fuzz_corpus"

INSTRUMENTED = [
    "pointsplat_ns",
    "plyfile",
    "yaml",
    "nerfstudio.data.dataparsers",
    "lab.robustness.fuzz_readers",
]
"""Packages whose branches guide the search."""

SECONDS = 5.0
"""Longest time of one input, of the processor."""

MEMORY = 16 << 20
"""Bytes that an input of a few kB may take, beyond twice its size and four times the scene in
it."""


class Wrong(Exception):
    """A reader did what it must not: another exception, a hang, too much memory."""


class _TooLong(BaseException):
    pass


def judge(read: Callable[[bytes], object], data: bytes) -> Literal["read", "refused"]:
    """What a reader does with bytes.

    Raises:
        Wrong: if that is neither a result nor one typed error in one line, or takes too long or too
            much memory.
    """
    size = 0
    outcome = "read"
    try:
        start_of_peak()
        before = status_bytes("VmRSS")
    except OSError:  # not counted on this system
        before = None
    try:
        with _cpu_time_limited():
            result = read(data)
        if isinstance(result, Gaussians):
            size = sum(value.numel() * value.element_size() for value in result.tensors())
        del result
    except PointSplatError as error:
        outcome = "refused"
        if "\n" in str(error) or not str(error).strip():
            raise Wrong(f"an error that is not one line: {str(error)!r:.200}") from error
        error.__traceback__ = None  # frees what its frames hold
    except (Exception, _TooLong) as error:
        what = f"more than {SECONDS:g} s" if isinstance(error, _TooLong) else repr(error)
        raise Wrong(what) from error
    taken = 0 if before is None else status_bytes("VmHWM") - before
    if taken > MEMORY + 2 * len(data) + 4 * size:
        raise Wrong(f"took {taken / 1e6:.0f} MB for {len(data)} bytes")
    return outcome


@contextmanager
def _cpu_time_limited() -> Iterator[None]:
    def late(*_: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def main(
    reader: tyro.conf.Positional[str],
    seconds: int = 60,
    seed: int = 1,
    output: Path = Path("outputs/fuzzing"),
    minimise: bool = False,
) -> None:
    """Fuzz a reader in this process.

    Args:
        reader: its name, that of its folder in the corpus.
        seconds: how long.
        seed: of the random changes.
        output: folder for new inputs and for findings.
        minimise: instead, add to the corpus what earlier fuzzing kept and what reaches new
            branches.
    """
    if not (CORPUS / reader).is_dir():
        raise SystemExit(
            f"no reader {reader}; expected "
            f"{', '.join(sorted(path.name for path in CORPUS.iterdir()))}"
        )
    import atheris

    kept = output.resolve() / reader
    kept.mkdir(parents=True, exist_ok=True)
    folders = [str(CORPUS / reader), str(kept)] if minimise else [str(kept), str(CORPUS / reader)]
    limits = [
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        "-max_len=4096",
        "-timeout=20",
        "-rss_limit_mb=6000",
    ]
    options = ["-merge=1"] if minimise else [*limits, f"-artifact_prefix={kept}."]
    with atheris.instrument_imports(include=INSTRUMENTED), tempfile.TemporaryDirectory() as folder:
        from lab.robustness.fuzz_readers import READERS

        logging.getLogger("pointsplat_ns").setLevel(logging.CRITICAL)
        read = READERS[reader](Path(folder))
        for path in sorted(
            (CORPUS / reader).iterdir()
        ):  # what is imported when first needed is instrumented too
            judge(read, path.read_bytes())
        again = shlex.join([sys.executable, "-m", "lab.robustness.fuzzing", *sys.argv[1:]])

        def one_input(data: bytes) -> None:
            judge(read, data)

        atheris.Setup(
            [again, *options, *folders], one_input
        )  # libFuzzer starts itself by a shell when it merges
        atheris.Fuzz()


if __name__ == "__main__":
    start(main)
