"""Programs of the lab, and fuzzing."""

import functools
import logging
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing, suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lab.common import scenes
from lab.robustness import fuzzing, mutants
from lab.robustness.fuzz_readers import READERS
from lab.robustness.fuzzing import CORPUS
from making import LAB, REPOSITORY
from pointsplat_ns.errors import PointSplatError

PROGRAMS = sorted(
    ".".join(path.relative_to(REPOSITORY).with_suffix("").parts).removesuffix(".__main__")
    for path in LAB.rglob("*.py")
    if 'if __name__ == "__main__":' in path.read_text("utf-8")
)

ASK_FOR_HELP = """
import os, runpy, sys
import lab.common.compare, lab.common.scenes  # take seconds, so once for all; then each runs in a process of its own
for program in sys.argv[1:]:
    if os.fork() == 0:
        sys.argv = [program, "--help"]
        runpy.run_module(program, run_name="__main__", alter_sys=True)
        sys.exit("it did not end after its help")
    assert os.wait()[1] == 0, program
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="saves imports by forking")
def test_every_program_starts():
    assert len(PROGRAMS) > 10
    command = [sys.executable, "-c", ASK_FOR_HELP, *PROGRAMS]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage:") == len(PROGRAMS)


def test_the_readme_names_every_program():
    text = (LAB / "README.md").read_text("utf-8")
    assert not [name for name in PROGRAMS if f"python -m {name}" not in text]
    assert len(text.split()) <= 1000


def test_no_scene_is_both_tuned_on_and_judged():
    assert not {*scenes.TUNING} & {*scenes.JUDGED}
    assert [scenes.group_of(name) for name in ("fox", "lounge", "mine")] == ["tuning", "judged", ""]


def test_every_part_that_faults_are_put_into_has_modules_and_tests():
    for name, part in mutants.PARTS.items():
        assert part.sources(mutants.ROOT), name
        assert all(list(mutants.ROOT.glob(pattern)) for pattern in (*part.near, *part.others)), name


def test_faults_are_drawn_of_functions_and_the_same_for_a_seed(tmp_path):
    drawn = []
    for seed in (0, 0, 1):
        path = tmp_path / "session.sqlite"
        path.unlink(missing_ok=True)
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("CREATE TABLE work_items (job_id)")
            database.execute("CREATE TABLE work_results (job_id, test_outcome, diff)")
            names = "module_path, start_pos_row, start_pos_col, operator_name, occurrence, definition_name, job_id"
            database.execute(f"CREATE TABLE mutation_specs ({names})")
            for number in range(40):
                row = ("a.py", number, 0, "x", 0, None if number % 2 else "function", f"{number}")
                database.execute("INSERT INTO mutation_specs VALUES (?, ?, ?, ?, ?, ?, ?)", row)
                database.execute("INSERT INTO work_items VALUES (?)", (f"{number}",))
            database.execute("INSERT INTO work_results VALUES ('0', NULL, NULL)")  # filtered out
        mutants.draw(path, 5, seed)
        with closing(sqlite3.connect(path)) as database:
            drawn.append([job for (job,) in database.execute("SELECT job_id FROM work_items ORDER BY job_id")])
            assert database.execute("SELECT count(*) FROM work_results").fetchone() == (0,)
    assert drawn[0] == drawn[1] != drawn[2] and len(drawn[0]) == 5
    assert all(int(job) % 2 == 0 and job != "0" for job in drawn[0])


NAMES = sorted(path.name for path in CORPUS.iterdir())


@pytest.fixture(scope="module")
def reader_of(tmp_path_factory):
    """A function that gives a reader by name, once it has imported what it needs: that memory is not the files'."""

    @functools.cache
    def made(name: str) -> Callable[[bytes], object]:
        read = READERS[name](tmp_path_factory.mktemp(name))
        with suppress(PointSplatError):
            read(min((CORPUS / name).iterdir()).read_bytes())
        return read

    return made


@pytest.fixture(autouse=True)
def quiet():
    logger = logging.getLogger("pointsplat_ns")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(before)


@pytest.mark.parametrize("name", NAMES)
def test_what_fuzzing_kept_is_read_or_refused(name, reader_of):
    outcomes = [fuzzing.judge(reader_of(name), path.read_bytes()) for path in sorted((CORPUS / name).iterdir())]
    assert "read" in outcomes, "or nothing beyond the first check is tried"


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_changed_file_of_any_reader_is_read_or_refused(name, data, reader_of):
    files = sorted((CORPUS / name).iterdir())
    content = bytearray(data.draw(st.sampled_from(files)).read_bytes() or b"0")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=4))
    fuzzing.judge(reader_of(name), bytes(content))


def test_the_judge_stops_what_does_not_end(monkeypatch):
    def endless(_):
        while True:
            pass

    monkeypatch.setattr(fuzzing, "SECONDS", 0.1)  # of the processor
    with pytest.raises(fuzzing.Wrong, match="more than 0.1 s"):
        fuzzing.judge(endless, b"")
