"""Every reader reads or refuses, in one typed error of one line, what fuzzing it has found worth keeping."""

from __future__ import annotations

import logging
import mmap
from contextlib import suppress

import pytest

from making import BENCHMARKS
from pointsplat_ns.errors import PointSplatError

CORPUS = BENCHMARKS.parent / "tests" / "benchmarks" / "fuzz_corpus"
NAMES = sorted(path.name for path in CORPUS.iterdir())


@pytest.fixture(scope="module")
def readers(benchmark):
    return benchmark("fuzz_readers").READERS


@pytest.fixture(scope="module")
def judging(benchmark):
    return benchmark("fuzz_judge")


@pytest.fixture(autouse=True)
def quiet():
    logger = logging.getLogger("pointsplat_ns")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(before)


def test_every_reader_has_files(readers):
    assert set(NAMES) == set(readers)
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 300_000


@pytest.mark.parametrize("name", NAMES)
def test_what_fuzzing_kept_is_read_or_refused(name, readers, judging, tmp_path):
    read, files = readers[name](tmp_path), sorted((CORPUS / name).iterdir())
    with suppress(PointSplatError):
        read(files[0].read_bytes())  # imports what it needs, whose memory is not the file's
    outcomes = {path.name: judging.judge(read, path.read_bytes()) for path in files}
    assert "read" in outcomes.values(), "or nothing beyond the first check is tried"


@pytest.mark.parametrize(
    "wrong, said",
    [
        (lambda _: [][1], "IndexError at "),
        (lambda _: (_ for _ in ()).throw(PointSplatError("")), "not one line"),
        (lambda _: mmap.mmap(-1, 64 << 20).write(bytes(64 << 20)), r"took \d+ MB for 1 bytes"),  # of the system, always
    ],
)
def test_the_judge_says_what_a_reader_must_not_do(wrong, said, judging):
    with pytest.raises(judging.Wrong, match=said):
        judging.judge(wrong, b"x")


def test_the_judge_stops_what_does_not_end(judging, monkeypatch):
    def endless(_):
        while True:
            pass

    monkeypatch.setattr(judging, "SECONDS", 0.1)  # of the processor
    with pytest.raises(judging.Wrong, match="more than 0.1 s"):
        judging.judge(endless, b"")


def test_of_files_that_reach_the_same_the_smallest_is_kept_and_those_with_names(benchmark, readers, tmp_path):
    for name, data in {"named": b"ply\nxx", "a" * 16: b"ply\nx", "b" * 16: b"ply\n", "c" * 16: b"nothing"}.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "folder").mkdir()
    read = readers["ply"](tmp_path / "folder")
    files = [path for path in tmp_path.iterdir() if path.is_file()]
    chosen = benchmark("fuzz_minimise").fewest(read, files, ["pointsplat_ns"], 1000)
    assert [path.name for path in chosen] == ["named", "c" * 16]
