"""Would the tests notice a fault? cosmic-ray puts faults into the code one by one, and runs the tests of its part.

    pip install cosmic-ray
    OMP_NUM_THREADS=1 python -m lab.robustness.mutants --seed 0 --output outputs/mutants

The same seed draws the same faults. They are tried in a git worktree of HEAD below the output, so your files stay as
they are; ``git worktree remove outputs/mutants/tree`` removes it. The same command resumes after an interruption. A
fault in an annotation, a decorator or a constant of a module is not drawn: nothing depends on the first two, and any
other value of the last is another tuning.
"""

from __future__ import annotations

import json
import os
import random
import shlex
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from lab.common.printing import markdown, start

ROOT = Path(__file__).parents[2]

TIMEOUT = 900.0
"""Seconds that the tests of a fault may take; a fault that makes them longer is caught."""

PYTEST = "-x -q --tb=no --import-mode=importlib --doctest-modules -o addopts= -p no:cacheprovider"

NOT_TRIED = ".*BitOr.*|.*RemoveDecorator.*|.*ExceptionReplacer.*"
"""Operators of cosmic-ray that are left out: ``|`` stands in annotations."""


@dataclass(frozen=True)
class Part:
    """Modules, and the tests that are to hold them; patterns below the root."""

    modules: tuple[str, ...]
    near: tuple[str, ...]
    """Tests that are quick and tell much; they run first."""
    others: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    """Names of modules that the patterns cover, but that are not tried."""

    def sources(self, root: Path) -> list[str]:
        """The modules, in order, below the root."""
        names = ("__init__.py", *self.left_out)
        return [path for path in files(self.modules, root) if Path(path).name not in names]


def files(patterns: tuple[str, ...], root: Path) -> list[str]:
    """Files of patterns, each once, below the root."""
    found = [path for pattern in patterns for path in sorted(root.glob(pattern))]
    return [str(path.relative_to(root)) for path in dict.fromkeys(found)]


_SCORES = ("scores.py", "coverage.py", "view_scores.py")
_SAME_RESULT = "tests/test_same_result.py"

PARTS = {
    "rasterizer": Part(
        ("pointsplat_ns/rasterizer/*.py",),
        ("tests/rasterizer/test_golden.py", "tests/rasterizer/test_input.py", "tests/rasterizer/test_projection.py"),
        ("tests/rasterizer/test_*.py", "tests/pruning/test_view_scores.py", _SAME_RESULT),
        left_out=("constants.py",),
    ),
    "scores": Part(
        tuple(f"pointsplat_ns/pruning/{name}" for name in _SCORES),
        ("tests/pruning/test_scores.py", "tests/pruning/test_view_scores.py"),
        ("tests/pruning/test_[ms]*.py", "tests/merging/test_merge.py", _SAME_RESULT, "tests/compression/test_prune.py"),
    ),
    "merge": Part(
        ("pointsplat_ns/merging/**/*.py", "pointsplat_ns/pruning/*.py"),
        ("tests/merging/test_*.py",),
        ("tests/merging/test_*.py", "tests/pruning/test_*.py", _SAME_RESULT, "tests/compression/test_optimiser.py"),
        left_out=(*_SCORES, "settings.py"),
    ),
    "refiner": Part(
        ("pointsplat_ns/refiner/*.py",),
        ("tests/refiner/test_refiner.py",),
        ("tests/refiner/test_*.py", _SAME_RESULT, "tests/compression/test_trained_refiner.py"),
    ),
    "repair": Part(
        tuple(f"pointsplat_ns/compression/{name}.py" for name in ("repair", "feedback", "optimiser")),
        ("tests/compression/test_[fr]e*.py",),
        ("tests/refiner/test_augmentation.py", _SAME_RESULT, "tests/compression/*.py"),
    ),
}
"""Parts of the code. A pattern takes modules and tests that are moved within their folder along."""


def configuration(part: Part, root: Path, near: bool) -> str:
    """The configuration of cosmic-ray for a part."""
    modules, tests = part.sources(root), files(part.near if near else (*part.near, *part.others), root)
    command = f"{sys.executable} -m pytest {PYTEST} {shlex.join([*modules, *tests])}"
    return f"""[cosmic-ray]
module-path = {json.dumps(modules)}
timeout = {TIMEOUT}
excluded-modules = []
test-command = {json.dumps(command)}
distributor.name = "local"
filters.operators-filter.exclude-operators = {json.dumps([NOT_TRIED])}
"""


def draw(session: Path, count: int, seed: int) -> None:
    """Leave ``count`` faults of a session, drawn at random of those in functions."""
    with closing(sqlite3.connect(session)) as database, database:
        within = "definition_name IS NOT NULL AND job_id NOT IN (SELECT job_id FROM work_results)"
        order = "module_path, start_pos_row, start_pos_col, operator_name, occurrence"
        jobs = [
            job for (job,) in database.execute(f"SELECT job_id FROM mutation_specs WHERE {within} ORDER BY {order}")
        ]
        drawn = random.Random(seed).sample(jobs, min(count, len(jobs)))
        for table in ("work_results", "mutation_specs", "work_items"):
            database.execute(f"DELETE FROM {table} WHERE job_id NOT IN ({','.join('?' * len(drawn))})", drawn)


def outcomes(session: Path) -> tuple[int, list[str]]:
    """The number of faults that were tried, and the changes of those that no test noticed."""
    with closing(sqlite3.connect(session)) as database:
        rows = database.execute("SELECT test_outcome, diff FROM work_results").fetchall()
    return len(rows), [diff for outcome, diff in rows if outcome == "SURVIVED"]


def main(
    parts: tuple[str, ...] = tuple(PARTS),
    count: int = 20,
    seed: int = 0,
    output: Path = Path("outputs/mutants"),
    near: bool = False,
) -> None:
    """Put faults into the code, and say which of them the tests catch.

    Args:
        parts: which parts.
        count: faults of each part.
        seed: which faults are drawn.
        output: folder for the worktree, and for a session of cosmic-ray for each part; drawn faults stay.
        near: run only the quick tests near the fault.
    """
    output = output.resolve()
    tree, lines = output / "tree", []
    if not tree.exists():
        output.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "-C", str(ROOT), "worktree", "add", "--detach", str(tree), "HEAD"], check=True)

    def run(*words: object) -> None:
        """Run cosmic-ray; the package of the worktree is imported."""
        environment = os.environ | {"PYTHONPATH": str(tree)}
        subprocess.run(list(map(str, words)), cwd=tree, env=environment, check=True)

    for name in parts:
        config, session = output / f"{name}.toml", output / f"{name}.sqlite"
        config.write_text(configuration(PARTS[name], tree, near), "utf-8")
        if not session.exists():
            run("cosmic-ray", "init", config, session)
            run("cr-filter-operators", session, config)
            draw(session, count, seed)
        run("cosmic-ray", "exec", config, session)
        tried, survived = outcomes(session)
        lines.append([name, tried, tried - len(survived)])
        print(*survived, sep="\n", flush=True)
    print(markdown(["Part", "Faults", "Caught"], lines))


if __name__ == "__main__":
    start(main)
