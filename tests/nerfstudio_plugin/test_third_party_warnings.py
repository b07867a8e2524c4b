"""Commands print no warnings of other packages, and all that are not known."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from making import quick_start
from pointsplat_ns.nerfstudio_plugin.third_party_warnings import (
    JIT_SCRIPT,
    NERFSTUDIO,
    KnownWarning,
    quiet_nerfstudio,
)


def printed(text: str, category: type[Warning], module: str) -> list[str]:
    """What is printed of a warning that is raised for a module after nerfstudio's are quieted."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        quiet_nerfstudio()
        warnings.warn_explicit(text, category, "some.py", 1, module=module)
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("known", NERFSTUDIO, ids=lambda known: known.text[:30])
def test_a_known_warning_is_not_printed_and_one_that_differs_in_anything_is(known):
    assert printed(f"{known.text}, and more", known.category, known.module) == []
    for other in (
        ("another thing is deprecated", known.category, known.module),
        (known.text, RuntimeWarning, known.module),
        (known.text, known.category, "users.script"),
        (known.text, known.category, f"{known.module}.more"),
    ):
        assert printed(*other) == [other[0]]


@pytest.mark.parametrize(
    ("known", "shown"),
    [(JIT_SCRIPT, ""), (KnownWarning("another thing", FutureWarning, JIT_SCRIPT.module), "FutureWarning: another")],
)
def test_the_environment_variable_quiets_one_warning_and_no_other(known, shown):
    code = f"import warnings; warnings.warn_explicit({known.text!r}, FutureWarning, 'x', 1, module={known.module!r})"
    environment = {**os.environ, "PYTHONWARNINGS": JIT_SCRIPT.option}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert shown in result.stderr if shown else result.stderr == ""


def run_quietly(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {name: value for name, value in quick_start().items() if name != "PYTHONWARNINGS"}
    words = [str(Path(sys.executable).parent / command[0]), *map(str, command[1:])]
    return subprocess.run(words, env={**kept, **environment}, capture_output=True, text=True, timeout=600)


def test_a_training_prints_no_warning(wall_scene, tmp_path):
    result = run_quietly(
        *("ns-train", "splatfacto-cpu", "--data", wall_scene, "--output-dir", tmp_path, "--machine.device-type", "cpu"),
        *("--max-num-iterations", "3", "replica-data", "--num-seed-points", "50"),
        PYTHONWARNINGS=JIT_SCRIPT.option,
    )
    assert (result.returncode, result.stderr) == (0, "")


def test_a_command_that_reads_poses_with_nerfstudio_prints_no_warning(trained_walls, tmp_path):
    # In a fresh process dataset_views is what first imports nerfstudio.
    (run,) = (config.parent for config in (trained_walls / "wall-a").rglob("config.yml"))
    result = run_quietly(
        *("pointsplat", "prune", run, "--keep", "50%", "--by", "lightgaussian"), *("-o", tmp_path / "small.ply")
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert "dataset" in result.stdout, result.stdout  # else nerfstudio was not needed, and this proves nothing
