"""Would the tests notice a fault? Faults are put into the code one by one, and the tests of its part are run.

    OMP_NUM_THREADS=1 python -m lab.robustness.mutants --seed 0 --output outputs/mutants.json

So many faults of each part are drawn at random (:mod:`lab.robustness.mutations`); the same seed draws the same. Each is
tried in a process of its own, forked from one in which torch and pytest are loaded and nothing of this package: a fault
costs seconds, and the files stay as they are. The examples of the module and the tests named after it come first, then
the other tests of the part; the first failure ends it, if that test passes without the fault. What is done is in the
output, and not done again; ``--survivors`` tries what survived once more.

mutmut leaves out decorated functions, such as all under ``@torch.no_grad()``; cosmic-ray changes the files and imports
torch anew for each fault. So the faults and their trial are here.
"""

from __future__ import annotations

import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import CodeType, ModuleType

import pytest
import tyro

from lab.common.printing import markdown
from lab.robustness.mutations import Mutation, mutations

ROOT = Path(__file__).parents[2]

LONGEST = 20
"""CPU seconds that a test may take, in no more than an hour: a fault that makes it longer is caught."""

LOADED = (
    *("torch", "scipy.spatial", "hypothesis.strategies", "_hypothesis_pytestplugin", "kornia", "torchmetrics"),
    *("plyfile", "cv2", "yaml"),
)
"""Modules of others, loaded once for all; nerfstudio is one where it is installed."""


OPTIONS = (
    *("-x", "-q", "-rfE", "--tb=no", "--import-mode=importlib", "--doctest-modules", "-o", "addopts="),
    *("-p", "no:cacheprovider", "-p", "no:unraisableexception", "-p", "_hypothesis_pytestplugin"),
)
"""Of pytest. Plugins that happen to be installed are left out: they take longer to load than most tests to run."""


@dataclass(frozen=True)
class Part:
    """Modules, and the tests that are to hold them; patterns below the root."""

    modules: tuple[str, ...]
    first: tuple[str, ...]
    """Tests that are quick and tell much; those named after a module come before."""
    then: tuple[str, ...] = ()
    """All others."""
    left_out: tuple[str, ...] = ()
    """Names of modules that the patterns cover, but that are not tried."""

    def sources(self, root: Path) -> list[Path]:
        """The modules, in order."""
        found = {path for pattern in self.modules for path in root.glob(pattern)}
        return sorted(path for path in found if path.name not in ("__init__.py", *self.left_out))

    def tests_of(self, module: Path, root: Path) -> tuple[list[str], list[str]]:
        """What to run for a module, in two runs: first what is quick and near to it."""
        first = [path for pattern in self.first for path in sorted(root.glob(pattern))]
        then = [path for pattern in self.then for path in sorted(root.glob(pattern))]
        own = [path for path in (*first, *then) if path.stem == f"test_{module.stem}"]
        first = list(dict.fromkeys([module, *own, *first]))
        return [str(path) for path in first], [str(path) for path in dict.fromkeys(then) if path not in first]


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
        ("tests/pruning/test_[ms]*.py", _SAME_RESULT, "tests/compression/test_prune.py"),
    ),
    "merge": Part(
        ("pointsplat_ns/pruning/**/*.py",),
        (),
        ("tests/pruning/**/test_*.py", _SAME_RESULT, "tests/compression/test_optimiser.py"),
        left_out=(*_SCORES, "settings.py"),
    ),
    "refiner": Part(
        ("pointsplat_ns/refiner/*.py",),
        ("tests/refiner/test_refiner.py",),
        ("tests/refiner/test_*.py", _SAME_RESULT, "tests/compression/test_trained_refiner.py"),
    ),
    "repair": Part(
        tuple(f"pointsplat_ns/compression/{name}.py" for name in ("repair", "feedback", "optimiser")),
        (),
        ("tests/compression/test_[fr]e*.py", "tests/refiner/test_normalize.py", _SAME_RESULT, "tests/compression/*.py"),
    ),
}
"""Parts of the code. A pattern takes modules and tests that are moved within their folder along."""


@dataclass(frozen=True)
class Row:
    """A fault, and what became of it."""

    part: str
    module: str
    fault: str
    caught_by: str
    """A test, "too long", a signal or an error; nothing for what survived."""
    seconds: float
    """Of the CPU."""


class Changed(importlib.abc.MetaPathFinder, importlib.machinery.SourceFileLoader):
    """Finds one module, and loads another source than its file's."""

    def __init__(self, name: str, path: Path, source: str):
        super().__init__(name, str(path))
        self.source = source

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source, self.path, "exec", dont_inherit=True)


class Limits:
    """A plugin of pytest that ends the process where a test takes too long."""

    def pytest_runtest_setup(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        signal.setitimer(signal.ITIMER_REAL, 180 * LONGEST)

    def pytest_runtest_teardown(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


@dataclass
class Trial:
    """Runs tests in processes forked from this one."""

    root: Path
    spent: float = 0.0
    """CPU seconds."""
    passing: set[str] = field(default_factory=set)
    """Tests that are known to pass on the code as it is."""

    def caught_by(self, module: Path, source: str, runs: Sequence[Sequence[str]]) -> str:
        """What catches that a module has another source; nothing if all tests pass.

        Raises:
            RuntimeError: if what fails does so on the code as it is.
        """
        for tests in runs:
            failed = self._failed(tests, module, source) if tests else ""
            if failed:
                name = failed.removeprefix("FAILED ").removeprefix("ERROR ")
                if name != failed and "::" in name and name not in self.passing:
                    without = self._failed([name])
                    if without:
                        raise RuntimeError(f"{name} fails on the code as it is: {without}")
                    self.passing.add(name)
                return name
        return ""

    def _failed(self, tests: Sequence[str], module: Path | None = None, source: str = "") -> str:
        """The first failure in one run of pytest."""
        with tempfile.TemporaryFile("w+") as said:
            before = os.times()
            child = os.fork()
            if child == 0:
                _test(tests, self.root, module, source, said.fileno())
            _, status = os.waitpid(child, 0)
            now = os.times()
            said.seek(0)
            lines = said.read().splitlines()
        self.spent += now.children_user + now.children_system - before.children_user - before.children_system
        if os.WIFSIGNALED(status):
            sent = os.WTERMSIG(status)
            return "too long" if sent in (signal.SIGPROF, signal.SIGALRM) else f"signal {sent}"
        if os.WEXITSTATUS(status) in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return ""
        failed = [line.split(" - ")[0].strip() for line in lines if line.startswith(("FAILED ", "ERROR "))]
        return failed[0] if failed else lines[-1] if lines else f"status {os.WEXITSTATUS(status)}"


def _test(tests: Sequence[str], root: Path, module: Path | None, source: str, said: int) -> None:
    """The child: runs the tests, and ends with pytest's status."""
    status = 1
    try:
        gc.freeze()  # no collection goes over what was loaded before
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        os.dup2(said, 1)
        os.dup2(said, 2)
        sys.stdout = sys.stderr = os.fdopen(said, "w", closefd=False)
        os.chdir(root)
        sys.path.insert(0, str(root))
        if module is not None:
            name = ".".join(module.relative_to(root).with_suffix("").parts)
            sys.meta_path.insert(0, Changed(name, module, source))
            importlib.import_module(name)  # before pytest, which loads modules with examples by ways of its own
        status = int(pytest.main([*OPTIONS, *tests], plugins=[Limits()]))
    except Exception as error:
        print(f"ERROR {error!r}")
    finally:
        sys.stdout.flush()
        os._exit(status)


def drawn(part: Part, count: int, seed: int, root: Path) -> list[tuple[Path, Mutation]]:
    """So many faults of a part, drawn at random, in the order of the code."""
    everything = [
        (path, mutation) for path in part.sources(root) for mutation in mutations(path.read_text(encoding="utf-8"))
    ]
    chosen = random.Random(seed).sample(range(len(everything)), min(count, len(everything)))
    return [everything[i] for i in sorted(chosen)]


def main(
    output: Path = Path("mutants.json"),
    seed: int = 0,
    count: int = 20,
    parts: tuple[str, ...] = tuple(PARTS),
    near: bool = False,
    survivors: bool = False,
    root: Path = ROOT,
) -> None:
    """Put faults into the code, and say which of them the tests catch.

    Args:
        output: file of all rows (JSON); those in it are not done again.
        seed: which faults are drawn.
        count: faults of each part.
        parts: which parts.
        near: run only the quick tests near the fault; what they let pass is for a run with ``--survivors``.
        survivors: try those again that survived.
        root: folder of the package and its tests.
    """
    for name in LOADED:
        importlib.import_module(name)
    if importlib.util.find_spec("nerfstudio"):
        importlib.import_module("nerfstudio.configs.external_methods")
    done = [Row(**row) for row in json.loads(output.read_text("utf-8"))] if output.exists() else []
    rows = {(row.module, row.fault): row for row in done}
    output.parent.mkdir(parents=True, exist_ok=True)
    trial = Trial(root)
    for name in parts:
        for path, fault in drawn(PARTS[name], count, seed, root):
            key = (str(path.relative_to(root)), str(fault))
            if key in rows and (rows[key].caught_by or not survivors):
                continue
            before = trial.spent
            source = fault.applied(path.read_text(encoding="utf-8"))
            runs = PARTS[name].tests_of(path, root)
            caught_by = trial.caught_by(path, source, runs[:1] if near else runs)
            rows[key] = Row(name, *key, caught_by, round(trial.spent - before, 1))
            part = output.with_name(output.name + ".partial")  # not io.files, which would load a part of the package
            part.write_text(json.dumps([asdict(row) for row in rows.values()], indent=1) + "\n", "utf-8")
            part.replace(output)
            print(f"{key[0]} {key[1]}: {caught_by or 'SURVIVED'} ({rows[key].seconds} CPU s)", flush=True)
    table(list(rows.values()))


def table(rows: Sequence[Row]) -> None:
    """Print how many faults of each part were caught, and which were not."""
    parts = {name: [row for row in rows if row.part == name] for name in dict.fromkeys(row.part for row in rows)}
    lines = [[name, len(these), sum(bool(row.caught_by) for row in these)] for name, these in parts.items()]
    print(markdown(["Part", "Faults", "Caught"], lines))
    for row in rows:
        if not row.caught_by:
            print(f"- {row.module} {row.fault}")


if __name__ == "__main__":
    tyro.cli(main)
