"""The public API: what each name is and says, and that the command line does nothing else."""

import doctest
import inspect
import logging
import re
from pathlib import Path

import pytest

import pointsplat_ns as ps
from making import ball, run_of, same
from pointsplat_ns.cli import main

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize("name", ps.__all__)
def test_every_public_name_has_an_example_and_documents_its_arguments(name):
    value = getattr(ps, name)
    text = inspect.getdoc(value) or ""
    [examples] = doctest.DocTestFinder(recurse=False).find(value, name)
    assert "\nExample:\n" in text and examples.examples
    if (
        inspect.isfunction(value) and name != "rasterization"
    ):  # documented in its signature, as gsplat's is
        signature = inspect.signature(value)
        assert signature.return_annotation is not inspect.Signature.empty
        for parameter in signature.parameters.values():
            assert parameter.annotation is not inspect.Parameter.empty, parameter.name
            # several arguments may share a line: "views, resolution: as for prune"
            assert re.search(rf"\b{parameter.name}(, \w+)*: ", text), parameter.name


def test_dir_lists_the_public_names_alone():
    assert sorted(name for name in dir(ps) if not name.startswith("_")) == sorted(ps.__all__)


def test_render_says_what_it_expects_for_views():
    with pytest.raises(
        TypeError, match=r"views is 3; expected a View or Views, such as sample_views\(scene, 3\)"
    ):
        ps.render(ps.example_room()[:3], 3)


@pytest.fixture(scope="module")
def scene() -> ps.Gaussians:
    return ball(400, opacity=1.0, bright=1.0)


def test_views_may_be_those_of_a_run(scene, trained_walls, caplog):
    run = run_of(trained_walls, "wall-a")
    with caplog.at_level(logging.DEBUG, "pointsplat_ns"):
        small = ps.prune(scene, "10%", "lightgaussian", views=run)
    assert "poses of the dataset" in caplog.text
    assert same(small, ps.prune(scene, "10%", "lightgaussian", views=ps.dataset_views(run)))


@pytest.fixture(scope="module")
def refiner_run(make_refined_run, tmp_path_factory) -> Path:
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
    with pytest.raises(ps.SceneError, match="scene 'c': no such scene in .*; expected one of a, b"):
        ps.load(refiner_run, "c")


@pytest.mark.parametrize(
    "options",
    [
        {"keep": "50", "by": "paper", "opacity_weight": 0.7, "sh": "0"},
        {"keep": "0.01MB", "sh": "auto"},
        {"keep": "auto:20", "by": "coverage"},
    ],
)
def test_pointsplat_prune_writes_what_prune_gives(options, scene, tmp_path):
    ply = tmp_path / "room.ply"
    ps.save(scene, ply)
    words = [
        str(word)
        for name, value in options.items()
        for word in (f"--{name.replace('_', '-')}", value)
    ]
    main(["prune", str(ply), *words, "-o", str(tmp_path / "by_command.ply")])
    ps.save(ps.prune(ply, **options), tmp_path / "by_api.ply")
    assert (tmp_path / "by_command.ply").read_bytes() == (tmp_path / "by_api.ply").read_bytes()
