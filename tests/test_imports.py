"""What importing the package costs, and what its parts import. ``make lint`` checks the direction of all imports."""

import json
import subprocess
import sys
from pathlib import Path

import pointsplat_ns as ps
from making import REPOSITORY, ball, imports_of

PACKAGE = REPOSITORY / "pointsplat_ns"


def run(code: str, cwd: Path = REPOSITORY) -> str:
    """What a Python of its own prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def modules_after(code: str) -> set[str]:
    """The modules that code imports into a fresh Python."""
    return set(json.loads(run(f"import sys, json; before = set(sys.modules)\n{code}\n" + _PRINT)))


_PRINT = "print(json.dumps(sorted(set(sys.modules) - before)))"


def test_importing_the_package_imports_nothing_but_small_parts_of_the_standard_library():
    imported = modules_after("import pointsplat_ns")
    packages = {name.split(".")[0] for name in imported}
    assert packages - set(sys.stdlib_module_names) == {"pointsplat_ns"}
    assert {name for name in imported if name.startswith("pointsplat_ns")} == {"pointsplat_ns"}


def test_the_core_never_imports_nerfstudio_nor_what_only_pictures_need(tmp_path):
    ps.save(ball(200, opacity=1.0, bright=1.0), tmp_path / "room.ply")
    code = f"""
import pointsplat_ns as ps
scene = ps.load({str(tmp_path / "room.ply")!r})
small = ps.prune(scene, 0.2)
ps.prune(scene, 0.2, "pup", sh="auto", fine_tune=1, views=ps.sample_views(scene, 2, 32, 24))
refined = ps.refine(small)
views = ps.sample_views(scene, 2, 32, 24)
ps.psnr(ps.render(refined, views[0]), ps.render(scene, views[0]))
ps.ssim(ps.render(refined, views), ps.render(scene, views))
result = ps.compact(scene, "10%", effort="instant")
ps.save(result.scene, {str(tmp_path / "small.ply")!r})
"""
    imported = {name.split(".")[0] for name in modules_after(code)}
    assert "torch" in imported
    assert imported & {"nerfstudio", "gsplat", "torchvision", "matplotlib", "method_configs", "tyro"} == set()


def test_neither_the_lab_nor_tests_nor_mocks_are_imported_by_the_package():
    names = {name.split(".")[0] for path in PACKAGE.rglob("*.py") for name in imports_of(path)}
    assert names & {"lab", "tests", "making", "unittest", "mock", "pytest"} == set()
