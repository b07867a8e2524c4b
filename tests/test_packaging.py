"""What is packaged and what is imported."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import REPOSITORY, ball, imports_of

pytestmark = pytest.mark.xdist_group(
    "packaging"
)  # one process builds and installs for all tests of this file


def run(*command: str | Path, cwd: Path, **variables: str) -> str:
    """Run a command and give what it printed; the test fails with its words if it does."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_"))
    }
    environment |= {"OMP_NUM_THREADS": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1", **variables}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def tracked_files() -> list[str]:
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no git, or no checkout: which files belong to the project is not known")
    return [name for name in listed.split("\0") if name and (REPOSITORY / name).is_file()]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    out = tmp_path_factory.mktemp("dist")
    for name in tracked_files():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, source / name)
    compiler = tmp_path_factory.mktemp("compiler") / "c++"  # in a third of the time
    compiler.write_text(f'#!/bin/sh\nexec {shutil.which("c++") or "g++"} "$@" -O0\n')
    compiler.chmod(0o755)
    build = (sys.executable, "-m", "build", "--no-isolation", "--outdir", out)
    run(*build, cwd=source, CC=str(compiler), CXX=str(compiler))
    assert len([*out.glob("*.tar.gz")]) == 1
    [made] = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an environment with the wheel."""
    environment = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=environment)
    [packages] = (environment / "lib").glob("python*/site-packages")
    # A folder that a .pth file names is searched for modules, but .pth files in it are not read:
    # what installs this package editably is one of those.
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_paths()['purelib']}\n")
    pip = (sys.executable, "-m", "pip", "--python", environment / "bin" / "python")
    run(
        *pip,
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--ignore-installed",
        wheel,
        cwd=environment,
    )
    return environment


def test_wheel_holds_every_file_of_the_packages_but_their_documentation(wheel):
    packaged = [
        name for name in tracked_files() if name.startswith(("pointsplat_ns/", "method_configs/"))
    ]
    wanted = {name for name in packaged if not name.endswith((".md", ".svg"))}
    wanted.add("pointsplat_ns/refinement/pretrained/CARD.md")  # goes with the weights
    with zipfile.ZipFile(wheel) as archive:
        held = {info.filename: info.file_size for info in archive.infolist()}
    assert len(wanted) > 100
    assert {name: held.get(name) for name in wanted} == {
        name: (REPOSITORY / name).stat().st_size for name in wanted
    }


def test_wheel_asks_for_nerfstudio_in_an_extra_alone(wheel):
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        lines = archive.read(name).decode().splitlines()
    asked = [
        line.removeprefix("Requires-Dist: ") for line in lines if line.startswith("Requires-Dist: ")
    ]
    alone = {re.split(r"[^\w-]", line)[0] for line in asked if "extra ==" not in line}
    assert "torch" in alone and not alone & {"nerfstudio", "open3d", "opencv-python-headless"}
    assert [line for line in asked if line.startswith("nerfstudio")] == [
        'nerfstudio<1.2,>=1.1.5; extra == "nerfstudio"'
    ]


def test_installed_package_has_kernels_and_is_found_by_nerfstudio(installed):
    code = """
import importlib.metadata, json, pointsplat_ns.rendering, pointsplat_ns.system.kernels as kernels
groups = [importlib.metadata.entry_points(group=f"nerfstudio.{kind}_configs") for kind in ("method", "dataparser")]
names = sorted({point.name for group in groups for point in group})
print(json.dumps([pointsplat_ns.__file__, kernels.KERNELS.why_missing, names]))
"""
    where, why_missing, names = json.loads(
        run(installed / "bin" / "python", "-c", code, cwd=installed)
    )
    assert Path(where).is_relative_to(installed)
    assert why_missing == "" or not any(map(shutil.which, ("c++", "g++")))
    methods = ["pointsplat", "pointsplat-authors", "pointsplat-paper", "splatfacto-cpu"]
    assert names == sorted([*methods, "replica-data", "scannetpp-seeded"])


def test_installed_compact_finds_the_refiner_that_ships(installed):
    ps.save(ball(300), installed / "room.ply")
    run(
        installed / "bin" / "pointsplat",
        "compact",
        "room.ply",
        "--keep",
        "20%",
        "--effort",
        "instant",
        cwd=installed,
    )
    assert len(ps.load(installed / "room_compact.ply")) == 60


def modules_after(code: str) -> set[str]:
    words = f"import sys, json; before = set(sys.modules)\n{code}\nprint(json.dumps(sorted(set(sys.modules) - before)))"
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def test_the_core_never_imports_nerfstudio_nor_what_only_pictures_need(tmp_path):
    ps.save(ball(200, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    code = f"""
import pointsplat_ns as ps
scene = ps.load({str(tmp_path / "room.ply")!r})
views = ps.sample_views(scene, 2, 32, 24)
small = ps.prune(scene, 0.2, views=views)
ps.prune(scene, 0.2, "pup", sh="auto", views=views)
refined = ps.refine(small)
ps.psnr(ps.render(refined, views[0]), ps.render(scene, views[0]))
ps.ssim(ps.render(refined, views), ps.render(scene, views))
result = ps.compact(scene, "10%", effort="instant", views=views)
ps.save(result.scene, {str(tmp_path / "small.ply")!r})
"""
    imported = {name.split(".")[0] for name in modules_after(code)}
    assert "torch" in imported
    others = {"nerfstudio", "gsplat", "torchvision", "matplotlib", "method_configs"}
    assert imported & others == set()


def test_neither_the_lab_nor_tests_nor_mocks_are_imported_by_the_package():
    names = {
        name.split(".")[0]
        for path in REPOSITORY.glob("pointsplat_ns/**/*.py")
        for name in imports_of(path)
    }
    assert names & {"lab", "tests", "making", "unittest", "mock", "pytest"} == set()


def test_tests_that_ci_names_are_there():
    """pytest runs none if one of its paths is missing."""
    words = (
        (REPOSITORY / ".github" / "workflows" / "ci.yml")
        .read_text("utf-8")
        .replace('"', " ")
        .split()
    )
    named = {word.partition("::")[0] for word in words if word.startswith("tests/")}
    assert len(named) > 10 and [name for name in named if not (REPOSITORY / name).exists()] == []
