"""Views of one and of several image sizes."""

import dataclasses

import pytest
import torch

import pointsplat_ns as ps
from making import ball, several_sizes, views_from_within
from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.views import ImageSize, sizes_text

COUNT = 12


@pytest.fixture(scope="module")
def mixed() -> ps.Views:
    return several_sizes(views_from_within((0.2, 0.1, 0.0), COUNT, 64, 48))


def test_each_view_has_its_own_size_and_the_common_one_stands_for_all(mixed):
    wanted = [(64, 48), (64, 48), (48, 64), (32, 24)] * 3
    wanted[5], wanted[7], wanted[8], wanted[11] = (48, 64), (32, 24), (48, 64), (24, 32)
    wanted[2], wanted[6], wanted[10] = (48, 64), (64, 48), (64, 48)
    assert [(view.width, view.height) for view in mixed] == wanted
    assert [size[:2] for size in mixed.size_of_each()] == wanted
    assert (mixed.width, mixed.height) == (64, 48) == mixed.image_sizes()[0][:2]
    assert {size[:2] for size in mixed.image_sizes()} == {*wanted}
    assert repr(mixed) == f"Views({COUNT} of 64 x 48 and 3 other sizes pixels, classic)"


def test_sizes_as_text():
    sizes = [ImageSize(64, 48), ImageSize(64, 48, 0.1), ImageSize(48, 64), ImageSize(5, 4)]
    assert [sizes_text(sizes[:count]) for count in (1, 2, 3, 4)] == [
        "64 x 48",
        "64 x 48",
        "64 x 48 and 48 x 64",
        "64 x 48 and 2 other sizes",
    ]


@pytest.mark.parametrize(
    "index",
    [
        slice(1, 9, 2),
        [5, 2, -1],
        torch.tensor([3, 3, 0]),
        torch.arange(COUNT) % 3 == 0,
        slice(0, 0),
    ],
    ids=["slice", "list", "tensor", "mask", "nothing"],
)
def test_some_of_the_views_keep_their_sizes(mixed, index):
    wanted = torch.arange(COUNT)[index].tolist()
    some = mixed[index]
    assert len(some) == len(wanted)
    for view, place in zip(some, wanted, strict=True):
        other = mixed[place]
        assert (view.width, view.height) == (other.width, other.height)
        assert torch.equal(view.viewmat, other.viewmat) and torch.equal(view.K, other.K)


def test_views_left_of_one_size_are_views_of_one_size(mixed):
    upright = mixed[[2, 5, 8]]
    assert upright.images is None and (upright.width, upright.height) == (48, 64)


def test_each_view_is_resized_as_if_it_were_alone(mixed):
    small = mixed.resized(40)
    for index, view in enumerate(small):
        (alone,) = mixed[index : index + 1].resized(40)
        assert (view.width, view.height) == (alone.width, alone.height)
        assert max(view.width, view.height) == (40 if index % 4 != 3 else 32)
        assert torch.equal(view.K, alone.K)


def test_eps2d_may_differ_with_the_size(mixed):
    changed = mixed.each_size(
        lambda of_size: dataclasses.replace(of_size, eps2d=1.0 / of_size.width)
    )
    assert [view.eps2d for view in changed] == [1.0 / view.width for view in mixed]
    assert changed.eps2d == 1.0 / 64


def test_sizes_that_do_not_fit_the_views_are_refused(mixed):
    with pytest.raises(DataError, match="2 image sizes for 12 views; expected one each"):
        dataclasses.replace(mixed, images=[ImageSize(64, 48)] * 2)
    images = [*mixed.images[:-1], ImageSize(0, 48)]
    with pytest.raises(DataError, match="views are 0 x 48 pixels; expected at least 1 x 1"):
        dataclasses.replace(mixed, images=images)


def test_images_of_several_sizes_are_rendered_one_by_one(mixed):
    scene = ball(50)
    with pytest.raises(ValueError, match="images of 64 x 48 and 3 other sizes pixels; expected"):
        ps.render(scene, mixed)
    assert ps.render(scene, mixed[2]).shape == (64, 48, 3)
