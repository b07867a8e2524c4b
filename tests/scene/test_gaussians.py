"""Gaussians and views."""

import dataclasses
import math

import pytest
import torch

from making import normal_scene, same
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("means", (5, 2), r"means has shape \(5, 2\); expected \(5, 3\)"),
        ("opacities", (5,), r"opacities has shape \(5,\); expected \(5, 1\)"),
        ("features_rest", (5, 45), r"features_rest has shape \(5, 45\)"),
        ("features_rest", (5, 4, 3), "features_rest has 4 coefficients"),
    ],
)
def test_a_wrong_shape_is_named(name, shape, message):
    with pytest.raises(SceneError, match=message):
        normal_scene().replace(**{name: torch.zeros(shape)})


@pytest.mark.parametrize("name", [name for name, _ in normal_scene().items()])
def test_what_is_no_tensor_is_named(name):
    value = getattr(normal_scene(), name).numpy()
    with pytest.raises(SceneError, match=rf"{name} is a numpy.ndarray; expected a torch.Tensor"):
        normal_scene().replace(**{name: value})
    with pytest.raises(SceneError, match="means is a builtins.list"):
        Gaussians(*([[0.0]] for _ in range(6)))


@pytest.mark.parametrize("name", ["viewmats", "Ks", "background"])
def test_views_of_what_is_no_tensor_are_refused(name):
    parts = {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "background": torch.ones(3)}
    views = Views(**parts, width=8, height=6)
    with pytest.raises(DataError, match=f"{name} of the views is a ndarray; expected a torch"):
        dataclasses.replace(views, **{name: parts[name].numpy()})


def test_mixed_or_integer_types_are_named():
    with pytest.raises(SceneError, match="scales is torch.float64 .* means are torch.float32"):
        normal_scene().replace(scales=torch.zeros(5, 3, dtype=torch.float64))
    with pytest.raises(SceneError, match="torch.int64; expected a floating-point type"):
        normal_scene().map(lambda value: value.long())


@pytest.mark.parametrize(
    "index",
    [slice(1, 4), torch.tensor([4, 0, 0]), torch.tensor([True, False, True, False, False]), 2, -1],
)
def test_selection_takes_the_same_rows_of_every_parameter(index):
    scene = normal_scene()
    rows = [index] if isinstance(index, int) else index
    for name, value in scene[index].items():
        assert torch.equal(value, getattr(scene, name)[rows]), name
    assert same(scene, Gaussians.cat([scene[:2], scene[2:]]))


def test_selecting_nothing_leaves_an_empty_scene_of_the_same_degree():
    empty = normal_scene(5, 2)[torch.zeros(5, dtype=torch.bool)]
    assert (len(empty), empty.sh_degree) == (0, 2) and same(empty, Gaussians.empty(sh_degree=2))
    assert Gaussians.empty(1).usable().shape == (0,)


def test_activated_values_at_the_extremes():
    scene = normal_scene(3).replace(
        opacities=torch.tensor([[math.inf], [-math.inf], [0.0]]),
        scales=torch.tensor([[-math.inf, 0.0, 1.0]] * 3),
    )
    assert scene.alphas.tolist() == [1.0, 0.0, 0.5]
    assert scene.stds[0].tolist() == pytest.approx([0.0, 1.0, math.e])


@pytest.mark.parametrize(
    "name", ["means", "scales", "quats", "opacities", "features_dc", "features_rest"]
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_usable_tells_meaningless_values_from_meaningful_ones(name, value):
    scene = normal_scene()
    spoiled = getattr(scene, name).clone()
    spoiled[2].view(-1)[0] = value
    meaningful = (name == "opacities" and math.isinf(value)) or (
        name == "scales" and value == -math.inf
    )
    expected = [True, True, meaningful, True, True]
    assert scene.replace(**{name: spoiled}).usable().tolist() == expected


def make():
    """Five cameras at x = 0, 1, 2... with focal length 50, 51, 52..."""
    viewmats = torch.eye(4).repeat(5, 1, 1)
    viewmats[:, 0, 3] = -torch.arange(5.0)
    Ks = torch.tensor([[50.0, 0.0, 31.0], [0.0, 40.0, 25.0], [0.0, 0.0, 1.0]]).repeat(5, 1, 1)
    Ks[:, 0, 0] += torch.arange(5)
    return Views(viewmats, Ks, 64, 48, torch.tensor([0.1, 0.2, 0.3]), "antialiased")


def places(views):
    return [-view.viewmat[0, 3].item() for view in views]


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (slice(None, None, 2), [0.0, 2.0, 4.0]),
        (slice(2, 2), []),
        ([3, 0, 0], [3.0, 0.0, 0.0]),
        (torch.tensor([4, 1]), [4.0, 1.0]),
        (torch.tensor([True, False, False, True, False]), [0.0, 3.0]),
    ],
)
def test_slices_lists_indices_and_masks_give_views(index, expected):
    some = make()[index]
    assert isinstance(some, Views) and places(some) == expected
    assert (some.width, some.height, some.rasterize_mode) == (64, 48, "antialiased")


@pytest.mark.parametrize(
    ("count", "expected"), [(1, [0.0]), (2, [0.0, 4.0]), (3, [0.0, 2.0, 4.0]), (0, [])]
)
def test_spread_takes_evenly_from_first_to_last(count, expected):
    assert places(make().spread(count)) == expected


def test_resized_views_see_the_same_in_fewer_pixels():
    views = make()
    small = views.resized(32)
    assert (small.width, small.height) == (32, 24)
    assert torch.equal(small.Ks, views.Ks * torch.tensor([[0.5], [0.5], [1.0]]))
    assert torch.equal(small.viewmats, views.viewmats)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": torch.eye(4)}, r"viewmats .* \(4, 4\); expected \(\d, 4, 4\)"),
        ({"Ks": torch.zeros(4, 3, 3)}, r"Ks .* \(4, 3, 3\); expected \(5, 3, 3\)"),
        ({"background": torch.zeros(4)}, r"background .* \(4,\); expected \(3,\)"),
        ({"width": 0}, "0 x 48 pixels; expected at least 1 x 1"),
        ({"height": 0}, "64 x 0 pixels; expected at least 1 x 1"),
    ],
)
def test_a_shape_or_size_that_does_not_fit_is_named(change, message):
    with pytest.raises(DataError, match=message):
        dataclasses.replace(make(), **change)
