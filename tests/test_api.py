"""The public API: the ten lines, what each name is and says, and that the command line does nothing else."""

import ast
import dataclasses
import doctest
import importlib
import inspect
import logging
import math
import shutil
from pathlib import Path
from typing import get_args

import pytest
import torch

import pointsplat_ns as ps
from making import ball, same
from pointsplat_ns import api
from pointsplat_ns.cli import main
from pointsplat_ns.cli.scene_options import Bands
from pointsplat_ns.compression.requests import SH_CHOICES
from pointsplat_ns.pruning import METHODS, resolve_keep

pytestmark = pytest.mark.xdist_group("api")  # one worker runs the ten lines for all tests of this file

TEN_LINES = """
import pointsplat_ns as ps
scene   = ps.load("room.ply")                     # any format, a checkpoint, a run
small   = ps.prune(scene, keep="10%")             # by="merge" is the default
refiner = ps.load_refiner()                       # the one that ships; or a path, or a run
refined = ps.refine(small, refiner)
views   = ps.sample_views(scene, 12)
image   = ps.render(refined, views[0])            # [H, W, 3]
print(ps.psnr(image, ps.render(scene, views[0])))
result  = ps.compact(scene, keep="10%")           # .scene, .accepted, .psnr, .seconds
ps.save(result.scene, "small.ply")
"""


@pytest.fixture(scope="module")
def ten_lines(tmp_path_factory) -> dict:
    """What the ten lines leave behind, with the scene that ships as room.ply."""
    folder = tmp_path_factory.mktemp("ten_lines")
    shutil.copy(api.EXAMPLE, folder / "room.ply")
    names: dict = {"folder": folder}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(TEN_LINES, names)
    return names


def test_the_ten_lines_make_a_scene_of_a_tenth(ten_lines):
    tenth = resolve_keep(len(ten_lines["scene"]), "10%")
    assert len(ten_lines["small"]) == len(ten_lines["refined"]) == len(ten_lines["result"].scene) == tenth


def test_the_ten_lines_draw_a_picture_of_the_room(ten_lines):
    views, image = ten_lines["views"], ten_lines["image"]
    assert len(views) == 12 and image.shape == (240, 320, 3)
    assert bool(((image >= 0) & (image <= 1)).all())
    # A tenth of a room, merged and refined, is far from noise: 10 dB is that of a grey picture.
    assert float(ps.psnr(image, ps.render(ten_lines["scene"], views[0]))) > 18


def test_the_ten_lines_compact_what_they_prune(ten_lines):
    result = ten_lines["result"]
    assert same(result.pruned, ten_lines["small"])
    assert not result.accepted and result.psnr >= result.before.psnr > 20
    assert 0 < result.seconds < 3600


def test_the_ten_lines_leave_a_file_that_holds_the_result(ten_lines):
    assert same(ps.load(ten_lines["folder"] / "small.ply"), ten_lines["result"].scene)


def imported_for_type_checkers() -> dict[str, tuple[str, ...]]:
    """Names by module that ``__init__.py`` imports where only a type checker looks."""
    tree = ast.parse(Path(ps.__file__).read_text("utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {node.module: tuple(alias.name for alias in node.names) for node in imports}


def test_a_type_checker_sees_the_names_that_are_there():
    assert imported_for_type_checkers() == ps._PUBLIC
    assert sorted(name for names in ps._PUBLIC.values() for name in names) == ps.__all__


@pytest.mark.parametrize("name", ps.__all__)
def test_every_public_name_is_what_its_module_defines(name):
    assert getattr(ps, name) is getattr(importlib.import_module(ps._HOME[name]), name)


@pytest.mark.parametrize("name", ps.__all__)
def test_every_public_name_is_documented_with_an_example_that_runs(name):
    value = getattr(ps, name)
    text = inspect.getdoc(value)
    assert text, f"{name} has no docstring"
    assert "\nExample:\n" in text
    examples = [example for test in doctest.DocTestFinder(recurse=False).find(value, name) for example in test.examples]
    assert examples


# rasterization documents its arguments where gsplat does: beside each in the signature.
FUNCTIONS = [name for name in ps.__all__ if inspect.isfunction(getattr(ps, name)) and name != "rasterization"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_documents_its_arguments_and_has_types(name):
    function = getattr(ps, name)
    text, signature = inspect.getdoc(function) or "", inspect.signature(function)
    for parameter in signature.parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty, f"{name}({parameter.name})"
        assert f" {parameter.name}: " in text or f", {parameter.name}: " in text, f"{name}({parameter.name})"
    assert signature.return_annotation is not inspect.Signature.empty


@pytest.mark.parametrize("name", METHODS)
def test_the_docstring_of_prune_names_every_method(name):
    assert f'"{name}"' in ps.prune.__doc__


def test_the_command_line_has_the_same_choices_of_bands():
    assert get_args(Bands) == SH_CHOICES


@pytest.mark.parametrize("choice", SH_CHOICES)
def test_the_docstring_of_prune_names_every_choice_of_bands(choice):
    described = ps.prune.__doc__.split("sh: ")[1].split("opacity_weight:")[0]
    assert f'"{choice}"' in described or choice in ("1", "2"), "which lie between"


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(400, opacity=1.0, bright=1.0)


@pytest.fixture(scope="module")
def ply(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "room.ply"
    ps.save(scene, path)
    return path


def test_a_scene_may_be_given_as_it_is_or_as_its_file(scene, ply):
    expected = ps.prune(scene, "25%")
    assert same(ps.prune(ply, "25%"), expected)
    assert same(ps.prune(str(ply), "25%"), expected)


def test_compact_takes_a_budget_as_text_and_a_scene_as_a_file(scene, ply):
    by_scene, by_file = ps.compact(scene, "10%"), ps.compact(ply, "10%")
    assert len(by_scene.scene) == 40
    assert same(by_scene.scene, by_file.scene)
    assert by_scene.psnr == by_file.psnr


def test_compact_prunes_as_the_refiner_was_trained_if_not_told_otherwise(ply):
    settings = ps.load_refiner().settings
    assert same(ps.compact(ply).pruned, ps.prune(ply, settings.keep, settings.by))


def test_what_compact_gives_is_all_there(scene):
    result = ps.compact(scene, "10%")
    assert len(dataclasses.fields(ps.Compacted)) <= 8
    properties = {name for name, value in vars(ps.Compacted).items() if isinstance(value, property)}
    assert properties >= {
        *("scene", "pruned", "refined", "strength", "accepted", "verdict", "before", "after", "psnr", "closeness"),
        *("views", "repaired", "repair_accepted", "after_repair"),
    }
    assert [stage.name for stage in result.stages] == ["prune", "repair"][: len(result.stages)]
    assert result.scene is (result.refined if result.accepted else result.pruned)
    assert result.psnr == (result.after if result.accepted else result.before).psnr
    assert result.seconds > 0 and len(result.views) == 12


def test_views_may_be_given(scene, caplog):
    views = ps.sample_views(scene, 3, 48, 36)
    with caplog.at_level(logging.INFO, "pointsplat_ns"):
        small = ps.prune(scene, "auto:22", "coverage", views=views)
    pictures = [(ps.render(small, view), ps.render(scene, view)) for view in views]
    error = torch.stack([(a.double() - b.double()).square().mean() for a, b in pictures]).mean()
    assert -10 * math.log10(error) >= 22
    assert "given views" in caplog.text and "of 3 views" in caplog.text
    assert ps.compact(scene, "10%", views=views).views is views


def test_views_may_be_those_of_a_run(scene, trained_walls, caplog):
    (run,) = (trained_walls / "wall-a" / "splatfacto-cpu").iterdir()
    with caplog.at_level(logging.INFO, "pointsplat_ns"):
        small = ps.prune(scene, "10%", "lightgaussian", views=run)
    assert "poses of the dataset" in caplog.text
    assert same(small, ps.prune(scene, "10%", "lightgaussian", views=ps.dataset_views(run)))


@pytest.mark.parametrize(
    "options",
    [{"by": "best"}, {"by": "merge", "opacity_weight": 0.5}, {"keep": "half"}, {"sh": "4"}, {"fine_tune": -1}],
)
def test_options_that_fit_no_scene_are_refused_before_one_is_read(options, tmp_path):
    with pytest.raises(ps.PointSplatError) as caught:
        ps.prune(tmp_path / "gone.ply", **options)
    assert "gone.ply" not in str(caught.value)
    if not {"opacity_weight", "fine_tune"} & set(options):
        with pytest.raises(ps.PointSplatError) as caught:
            ps.compact(tmp_path / "gone.ply", **options)
        assert "gone.ply" not in str(caught.value)


def test_what_was_found_is_logged_and_nothing_is_printed(scene, caplog, capsys):
    with caplog.at_level(logging.INFO, "pointsplat_ns"):
        result = ps.compact(scene, "10%", sh="0")
    assert result.verdict in caplog.messages
    assert any(message.startswith("SH degree 1 cut to 0") for message in caplog.messages)
    assert capsys.readouterr() == ("", "")


@pytest.fixture(scope="module")
def refiner_run(make_refined_run, tmp_path_factory) -> Path:
    """A pointsplat run of two PLY files."""
    folder = tmp_path_factory.mktemp("refiner_run")
    for name, count in (("a", 60), ("b", 80)):
        ps.save(ball(count), folder / "plys" / f"{name}.ply")
    return make_refined_run(folder / "run", folder / "plys", moved=0.5, keep=0.25, by="opacity")


def test_a_run_of_the_refiner_is_loaded_pruned_and_refined(refiner_run, caplog):
    with caplog.at_level(logging.INFO, "pointsplat_ns"):
        loaded = ps.load(refiner_run, "b")
    pruned = ps.prune(ball(80), 0.25, "opacity")
    assert same(loaded, pruned.replace(opacities=pruned.opacities + 0.5))
    assert "b: pruned by opacity (keep 0.25) and refined" in caplog.text
    with pytest.raises(ps.SceneError, match="scene 'c': no such scene in .*; there are a, b"):
        ps.load(refiner_run, "c")


def test_a_run_of_the_refiner_is_no_dense_scene(refiner_run):
    for function in (ps.prune, ps.compact):
        with pytest.raises(ps.SceneError, match="another method"):
            function(refiner_run, "10%")


def written(folder: Path, *args) -> bytes:
    """The file that a command writes."""
    main([*map(str, args), "-o", str(folder / "by_command.ply")])
    return (folder / "by_command.ply").read_bytes()


def saved(scene: ps.Gaussians, folder: Path) -> bytes:
    """The file that the API writes."""
    ps.save(scene, folder / "by_api.ply")
    return (folder / "by_api.ply").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((), {}),
        (("--keep", "10%"), {"keep": "10%"}),
        (
            ("--keep", "50", "--by", "paper", "--opacity-weight", "0.7", "--sh", "0"),
            {"keep": 50, "by": "paper", "opacity_weight": 0.7, "sh": "0"},
        ),
        (("--keep", "0.01MB", "--sh", "auto"), {"keep": "0.01MB", "sh": "auto"}),
        (("--keep", "auto:20", "--by", "coverage"), {"keep": "auto:20", "by": "coverage"}),
        (("--keep", "50%", "--by", "volume", "--clean"), {"keep": "50%", "by": "volume", "clean": True}),
        (("--keep", "20%", "--by", "area", "--fine-tune", "2"), {"keep": 0.2, "by": "area", "fine_tune": 2}),
    ],
)
def test_pointsplat_prune_writes_what_prune_gives(arguments, options, ply, tmp_path):
    assert written(tmp_path, "prune", ply, *arguments) == saved(ps.prune(ply, **options), tmp_path)
