"""What importing the package costs, and what its parts import. ``make lint`` checks the direction of all imports."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

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


def test_the_errors_and_containers_do_not_wait_for_the_rest():
    imported = modules_after("import pointsplat_ns as ps; ps.Gaussians, ps.Views, ps.SceneError")
    ours = {name for name in imported if name.startswith("pointsplat_ns.")}
    assert ours <= {"pointsplat_ns.errors", "pointsplat_ns.gaussians", "pointsplat_ns.views"}


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
result = ps.compact(scene, "10%")
ps.save(result.scene, {str(tmp_path / "small.ply")!r})
"""
    imported = {name.split(".")[0] for name in modules_after(code)}
    assert "torch" in imported
    assert imported & {"nerfstudio", "gsplat", "torchvision", "matplotlib", "method_configs", "tyro"} == set()


def test_dir_lists_the_public_names_without_importing_them():
    listed = json.loads(
        run(
            "import json, sys, pointsplat_ns as ps; names = dir(ps); assert 'torch' not in sys.modules\n"
            "print(json.dumps(names))"
        )
    )
    assert set(ps.__all__) <= set(listed)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'pointsplat_ns' has no attribute 'compres'"):
        ps.compres  # noqa: B018


def test_the_package_says_that_it_is_typed():
    assert (PACKAGE / "py.typed").is_file()
    if sys.version_info < (3, 11):
        pytest.skip("tomllib came with Python 3.11")
    import tomllib

    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
    assert "py.typed" in settings["tool"]["setuptools"]["package-data"]["pointsplat_ns"]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_replaces_parts_of_others_by_mocks(path):
    assert not [name for name in imports_of(path) if name.split(".")[0] in ("unittest", "mock", "pytest")]


def test_the_lab_and_tests_are_not_imported_by_the_package():
    names = {name.split(".")[0] for path in PACKAGE.rglob("*.py") for name in imports_of(path)}
    assert names & {"lab", "tests", "making"} == set()
