"""Views: what an index gives, how they thin out and shrink, and what is refused."""

import numpy as np
import pytest
import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.views import View, Views


def make(count=5, width=64, height=48, mode="antialiased"):
    """Cameras at x = 0, 1, 2... with focal length 50, 51, 52..."""
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, 0, 3] = -torch.arange(float(count))
    Ks = torch.tensor([[50.0, 0.0, 31.0], [0.0, 40.0, 25.0], [0.0, 0.0, 1.0]]).repeat(count, 1, 1)
    Ks[:, 0, 0] += torch.arange(count)
    return Views(viewmats, Ks, width, height, torch.tensor([0.1, 0.2, 0.3]), mode)


def places(views):
    return [-view.viewmat[0, 3].item() for view in views]


@pytest.mark.parametrize("index", [0, 3, -1, np.int64(3), torch.tensor(3)])
def test_an_integer_gives_one_view(index):
    views = make()
    view = views[index]
    assert isinstance(view, View)
    assert torch.equal(view.viewmat, views.viewmats[int(index)])
    assert torch.equal(view.K, views.Ks[int(index)])


def test_a_view_is_drawn_as_its_views_are():
    view = make()[2]
    assert (view.width, view.height, view.rasterize_mode) == (64, 48, "antialiased")
    assert torch.equal(view.background, torch.tensor([0.1, 0.2, 0.3]))


@pytest.mark.parametrize("index", [5, -6, [0, 5]])
def test_an_index_out_of_range_is_an_index_error(index):
    with pytest.raises(IndexError):
        make()[index]


def test_iteration_gives_every_view_once_in_order():
    views = list(make())
    assert all(isinstance(view, View) for view in views)
    assert places(views) == [0.0, 1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("index", "expected"),
    [
        (slice(1, 3), [1.0, 2.0]),
        (slice(None, None, 2), [0.0, 2.0, 4.0]),
        (slice(2, 2), []),
        ([3, 0, 0], [3.0, 0.0, 0.0]),
        ([2], [2.0]),
        (torch.tensor([4, 1]), [4.0, 1.0]),
        (torch.tensor([True, False, False, True, False]), [0.0, 3.0]),
    ],
)
def test_slices_lists_indices_and_masks_give_views(index, expected):
    some = make()[index]
    assert isinstance(some, Views) and len(some) == len(expected)
    assert places(some) == expected
    assert (some.width, some.height, some.rasterize_mode) == (64, 48, "antialiased")


@pytest.mark.parametrize(("count", "expected"), [(1, [0.0]), (2, [0.0, 4.0]), (3, [0.0, 2.0, 4.0]), (0, [])])
def test_spread_takes_evenly_from_first_to_last(count, expected):
    assert places(make().spread(count)) == expected


def test_resized_views_see_the_same_in_fewer_pixels():
    views = make()
    small = views.resized(32)
    assert (small.width, small.height) == (32, 24)
    assert torch.equal(small.Ks, views.Ks * torch.tensor([[0.5], [0.5], [1.0]]))
    assert torch.equal(small.viewmats, views.viewmats)


def test_resized_stretches_with_the_rounding_of_each_side():
    small = make(width=64, height=47).resized(32)  # 23.5 pixels high
    assert (small.width, small.height) == (32, 24)
    assert small.Ks[0, 1, 1].item() == pytest.approx(40 * 24 / 47)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmats": torch.eye(4)}, r"viewmats .* \(4, 4\); expected \(\d, 4, 4\)"),
        ({"viewmats": torch.zeros(5, 3, 4)}, r"viewmats .* \(5, 3, 4\); expected \(5, 4, 4\)"),
        ({"Ks": torch.zeros(4, 3, 3)}, r"Ks .* \(4, 3, 3\); expected \(5, 3, 3\)"),
        ({"background": torch.zeros(4)}, r"background .* \(4,\); expected \(3,\)"),
    ],
)
def test_a_shape_that_does_not_fit_is_named(change, message):
    given = {name: getattr(make(), name) for name in ("viewmats", "Ks", "background")}
    with pytest.raises(DataError, match=message):
        Views(**{**given, **change}, width=64, height=48)


@pytest.mark.parametrize("size", [(0, 48), (64, 0)])
def test_an_image_without_a_pixel_is_refused(size):
    with pytest.raises(DataError, match=f"{size[0]} x {size[1]} pixels; expected at least 1 x 1"):
        make(width=size[0], height=size[1])
