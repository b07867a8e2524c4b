"""Every reader reads or refuses, in one typed error of one line, what fuzzing it has found worth keeping."""

import logging
import mmap
from contextlib import suppress

import pytest

from lab.robustness import fuzz_judge
from lab.robustness.fuzz_readers import READERS
from lab.robustness.fuzzing import CORPUS
from pointsplat_ns.errors import PointSplatError

NAMES = sorted(path.name for path in CORPUS.iterdir())


@pytest.fixture(autouse=True)
def quiet():
    logger = logging.getLogger("pointsplat_ns")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(before)


def test_every_reader_has_files():
    assert set(NAMES) == set(READERS)
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 300_000


@pytest.mark.parametrize("name", NAMES)
def test_what_fuzzing_kept_is_read_or_refused(name, tmp_path):
    read, files = READERS[name](tmp_path), sorted((CORPUS / name).iterdir())
    with suppress(PointSplatError):
        read(files[0].read_bytes())  # imports what it needs, whose memory is not the file's
    outcomes = {path.name: fuzz_judge.judge(read, path.read_bytes()) for path in files}
    assert "read" in outcomes.values(), "or nothing beyond the first check is tried"


@pytest.mark.parametrize(
    "wrong, said",
    [
        (lambda _: [][1], "IndexError at "),
        (lambda _: (_ for _ in ()).throw(PointSplatError("")), "not one line"),
        (lambda _: mmap.mmap(-1, 64 << 20).write(bytes(64 << 20)), r"took \d+ MB for 1 bytes"),  # of the system, always
    ],
)
def test_the_judge_says_what_a_reader_must_not_do(wrong, said):
    with pytest.raises(fuzz_judge.Wrong, match=said):
        fuzz_judge.judge(wrong, b"x")


def test_the_judge_stops_what_does_not_end(monkeypatch):
    def endless(_):
        while True:
            pass

    monkeypatch.setattr(fuzz_judge, "SECONDS", 0.1)  # of the processor
    with pytest.raises(fuzz_judge.Wrong, match="more than 0.1 s"):
        fuzz_judge.judge(endless, b"")
