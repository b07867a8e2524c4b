"""What runs where nerfstudio is missing, and so are CUDA, Node, compiled kernels, a network and a
home to write to.

The environment has nothing but what the package asks for without an extra and what that in turn
asks for, as links to what is installed here.
"""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata
from unittest import mock

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from refusing import refusal

import pointsplat_ns as ps
from lab import demo
from lab.robustness.fuzz_readers import READERS
from making import REPOSITORY, imports_of
from pointsplat_ns.errors import MissingPackageError, need
from pointsplat_ns.metrics.lpips import LpipsUnavailable, load_lpips

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest brings it along

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
CORE, NERFSTUDIO = (
    [*map(Requirement, texts)] for texts in (PROJECT["dependencies"], EXTRAS["nerfstudio"])
)

RUNS = {
    "--version": "pointsplat-ns",
    "info room.ply": "200 Gaussians",
    "prune room.ply --keep 10%": "merged to 20 of 200",
    "compact room.ply --keep 30% --effort instant --html small.html": "small.html",
    "lod room.ply --levels 30%": "1 level of 200 Gaussians",
    "tradeoff room.ply --keep 10% --views 2 --resolution 64x48 --repairs none": "room_tradeoff",
    "convert room.ply room.sog": "200 Gaussians",
    "render room.ply room_pruned.ply -o film.mp4 --width 64 --height 48 --seconds 0.1 --fps 20": "2 frames",
    "export run -o exported.ply": "6 Gaussians",
    "render run -o run.png --width 64 --height 48": "reading the photos and poses of a run needs nerfstudio",
}
"""Commands that nothing is missing for, and what they print."""

LACKS = "compact run --photos"
"""A command that something is missing for."""


def installed_for(
    requirements: Iterable[Requirement], seen: set[str] | None = None
) -> Iterator[metadata.Distribution]:
    """The installed distributions that requirements ask for, and those that these ask for."""
    seen = set() if seen is None else seen
    for requirement in requirements:
        name = canonicalize_name(requirement.name)
        if f"{name}{sorted(requirement.extras)}" in seen:
            continue
        seen.add(f"{name}{sorted(requirement.extras)}")
        found = metadata.distribution(name)
        yield found
        asked = [Requirement(text) for text in found.requires or ()]
        extras = [{"extra": extra} for extra in (*requirement.extras, "")]
        wanted = [
            one for one in asked if one.marker is None or any(map(one.marker.evaluate, extras))
        ]
        yield from installed_for(wanted, seen)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    folder = tmp_path_factory.mktemp("bare")
    packages = folder / "packages"
    nothing = folder / "nothing"
    work = folder / "work"
    for made in (packages, nothing, work):
        made.mkdir()
    for distribution in installed_for(CORE):
        for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(distribution.locate_file(top))

    ps.save(ps.prune(ps.example_room(), 200, by="coverage"), work / "room.ply")
    (work / "run").mkdir()
    READERS["config"](work / "run")  # lays out a run with photos

    lines = [*RUNS, LACKS]
    environment = {
        "HOME": str(work / "room.ply" / "home"),  # below a file, nobody can make a folder
        "PATH": str(nothing),
        "TMPDIR": str(folder),
        "CUDA_VISIBLE_DEVICES": "",
        "ATEN_CPU_CAPABILITY": "default",  # no AVX2, so torch computes everything
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(map(str, (packages, REPOSITORY))),
    }
    # -S: without the site-packages of this Python.
    done = subprocess.run(
        [sys.executable, "-S", REPOSITORY / "tests" / "support" / "bare_machine.py"],
        cwd=work,
        env=environment,
        input=json.dumps([*map(shlex.split, lines)]),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(lines, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("line", RUNS)
def test_command_runs_on_a_bare_machine(outcomes, line):
    done = outcomes[line]
    assert done["status"] == 0 and done["tried"] == [], done["err"]
    assert RUNS[line] in done["out"]


def test_command_says_what_it_lacks_in_one_line(outcomes):
    done = outcomes[LACKS]
    said = "reading the photos and poses of a run needs nerfstudio, which is not installed; "
    assert (
        done["status"] == 1 and done["err"].startswith("error: ") and done["err"].count("\n") == 1
    )
    assert said + "install it with pip install 'pointsplat-ns[nerfstudio]'" in done["err"]


def test_requirements_are_what_is_imported():
    core, more, cluster = (
        {canonicalize_name(requirement.name) for requirement in listed}
        for listed in (CORE, NERFSTUDIO, map(Requirement, EXTRAS["cluster"]))
    )
    plugin = set()
    rest = set()
    for path in (
        *REPOSITORY.glob("pointsplat_ns/**/*.py"),
        *REPOSITORY.glob("method_configs/*.py"),
    ):
        (plugin if {"nerfstudio_plugin", "method_configs"} & {*path.parts} else rest).update(
            imports_of(path)
        )
    homes = metadata.packages_distributions()
    ours = {
        "pointsplat_ns",
        "method_configs",
        "_typeshed",
        "gsplat",
        *sys.stdlib_module_names,
    }  # gsplat: nerfstudio's

    def distributions(imported: set[str]) -> set[str]:
        tops = {name.split(".")[0] for name in imported} - ours
        found = {canonicalize_name(name) for top in tops for name in homes[top]}
        return found - {
            "opencv-python"
        }  # shares its package with that without a window, which nerfstudio takes

    # open3d is imported nowhere: pyproject.toml says which of its versions nerfstudio can use
    assert distributions(rest) <= core | cluster
    assert distributions(plugin | rest) == (core | more | cluster) - {"open3d"}


def test_the_demo_gives_its_first_result_and_then_says_what_it_lacks(monkeypatch, tmp_path):
    made = []
    monkeypatch.setitem(sys.modules, "nerfstudio", None)
    monkeypatch.setattr(demo, "compact_example", lambda *_: made.append("example") or [])
    missing = "the rest of the demo, which trains, needs nerfstudio, which is not"
    with pytest.raises(MissingPackageError, match=missing):
        demo.demo(tmp_path)
    assert made == ["example"]


def test_what_the_package_itself_lacks_is_one_line_too(monkeypatch, capsys, tmp_path):
    (tmp_path / "a.ply").touch()
    lacks = mock.Mock(side_effect=ModuleNotFoundError("No module named 'av'", name="av"))
    monkeypatch.setattr("pointsplat_ns.info", lacks)
    said = refusal(capsys, tmp_path, "info", tmp_path / "a.ply")
    assert said == "error: av is not installed; pip install pointsplat-ns installs it"


def test_a_package_that_is_there_but_broken_keeps_its_error(monkeypatch, tmp_path):
    (tmp_path / "nerfstudio").mkdir()
    (tmp_path / "nerfstudio" / "__init__.py").write_text("import liblzfse_that_is_missing")
    monkeypatch.delitem(sys.modules, "nerfstudio", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="liblzfse_that_is_missing"):
        need("nerfstudio", "training")


@pytest.mark.parametrize(
    "said", [ImportError("No module"), RuntimeError("operator torchvision::nms does not exist")]
)
def test_lpips_says_that_torchvision_is_missing_or_of_another_torch(said, monkeypatch):
    class Broken:
        def find_spec(self, name, path=None, target=None):
            if name == "torchvision":
                raise said

    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    with pytest.raises(
        LpipsUnavailable, match=f"LPIPS needs torchvision, which cannot be imported .{said}"
    ):
        load_lpips("alex", download=False)
