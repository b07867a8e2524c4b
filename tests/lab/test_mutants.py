"""lab/robustness/mutants.py on a module of its own: what it catches, what it reports, and what it leaves alone."""

import json
import os
from pathlib import Path

import pytest

from lab.robustness import mutants, mutations

SOURCE = '''"""A module of 2 functions."""

LIMIT = 3


def rise(x: int = 0) -> int:
    """Count up to 5."""
    if x > 5:
        raise ValueError(f"{x + 1} is above {5}")
    while x < 5:
        x += 1
    return x


def unseen(x):
    return max(x, -x)
'''

FEW = """def rise(x):
    while x != LIMIT: x = x + STEP
    return x
def unseen(x):
    return -x
LIMIT, STEP = 5, 1
"""

TESTS = """
from steps import rise

def test_it_rises():
    assert rise(0) == rise(4) == 5
"""

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="each fault is tried in a forked process")


@pytest.fixture()
def steps(tmp_path) -> Path:
    """A folder with a module and its tests."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_steps.py").write_text(TESTS)
    (tmp_path / "steps.py").write_text(SOURCE)
    return tmp_path


@pytest.fixture()
def of_steps_alone(monkeypatch):
    """The program is told of that module alone."""
    monkeypatch.setattr(mutants, "PARTS", {"steps": mutants.Part(("steps.py",), ("tests/test_*.py",))})
    monkeypatch.setattr(mutants, "LONGEST", 1)
    monkeypatch.setattr(mutants, "LOADED", ())


def test_faults_are_what_functions_compute_and_no_text():
    found = [str(mutation) for mutation in mutations.mutations(SOURCE)]
    assert found == [
        "6:19: 0 -> 1",
        "8:8: x > 5 -> (x <= 5)",
        "8:8: x > 5 -> (x >= 5)",
        "8:12: 5 -> 0",
        "8:12: 5 -> 6",
        "10:11: x < 5 -> (x <= 5)",
        "10:11: x < 5 -> (x >= 5)",
        "10:15: 5 -> 0",
        "10:15: 5 -> 6",
        "11:9: x += 1 -> pass",
        "11:9: x += 1 -> x -= 1",
        "11:14: 1 -> 0",
        "11:14: 1 -> 2",
        "16:12: max(x, -x) -> (min(x, -x))",
        "16:19: -x -> (x)",
    ]


def test_what_no_test_sees_survives_and_the_rest_is_caught(steps, of_steps_alone, capsys):
    (steps / "steps.py").write_text(FEW)
    output = steps / "rows.json"

    def run(**options) -> tuple[dict[str, str], str]:
        mutants.main(output, parts=("steps",), root=steps, **options)
        return {row["fault"]: row["caught_by"] for row in json.loads(output.read_text())}, capsys.readouterr().out

    rows, said = run()
    assert rows == {
        "2:11: x != LIMIT -> (x == LIMIT)": "tests/test_steps.py::test_it_rises",
        "2:27: x + STEP -> (x - STEP)": "too long",
        "5:12: -x -> (x)": "",
    }
    assert "| steps | 3 | 2 |" in said and "- steps.py 5:12: -x -> (x)" in said
    assert (steps / "steps.py").read_text() == FEW
    # What is done stays; a test that is written later is held against what survived.
    with (steps / "tests" / "test_steps.py").open("a") as file:
        file.write("\nfrom steps import unseen\n\ndef test_it_is_seen():\n    assert unseen(2) == -2\n")
    again, said = run(survivors=True)
    assert again == {**rows, "5:12: -x -> (x)": "tests/test_steps.py::test_it_is_seen"}
    assert said.count("CPU s") == 1


def test_every_part_has_modules_and_tests():
    for name, part in mutants.PARTS.items():
        modules = part.sources(mutants.ROOT)
        assert modules and all(list(mutants.ROOT.glob(pattern)) for pattern in (*part.first, *part.then)), name
