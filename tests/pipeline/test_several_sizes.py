"""Views and photos of several sizes: each is drawn, judged and trained on at its own size."""

import itertools
import json

import pytest
import torch

import pointsplat_ns as ps
from making import box_room, several_sizes, views_from_within
from pointsplat_ns.cli import main
from pointsplat_ns.pipeline.photos.posed_photos import read_with_photos
from pointsplat_ns.pipeline.quality import Judge
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, Origin, ViewProvider
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.rendering.comparison.sizes import middle_sized, other_sizes
from pointsplat_ns.rendering.comparison.sizes import several_sizes as sizes
from pointsplat_ns.scene.views import spread_indices
from pointsplat_ns.tools.comparison_plots import plot_views
from pointsplat_ns.tools.levels.level_errors import pixel_sizes
from pointsplat_ns.tools.pages.film import FilmSettings, camera_path
from pointsplat_ns.tools.pages.flight import FlightFrame
from pointsplat_ns.tools.pages.gallery import draw_pair
from pointsplat_ns.tools.wording import quality_details
from posing import (
    inria,
    nerfstudio_of_several_sizes,
    write_photos,
    write_sparse_of_several_sizes,
    written,
)

pytestmark = pytest.mark.usefixtures("quick")

COUNT = 18


@pytest.fixture(scope="module")
def dense() -> ps.Gaussians:
    return box_room(0, 400)


@pytest.fixture(scope="module")
def views() -> ps.Views:
    return several_sizes(views_from_within((0.2, 0.1, 0.0), COUNT, 64, 48))


@pytest.fixture(scope="module")
def large() -> ps.Views:
    """Larger than the smallest size in which renders are compared."""
    return several_sizes(views_from_within((0.2, 0.1, 0.0), 12, 960, 720))


def alone(views: ps.Views, index: int) -> ps.Views:
    return views[index : index + 1]


def test_a_judge_of_several_sizes_sees_in_each_view_what_a_judge_of_that_view_sees(dense, large):
    small = dense[::3]
    views = large[:4]
    judge = Judge(dense, ViewProvider(dense, views))
    found = judge._pixels.closeness(small)
    for index in range(len(views)):
        single = Judge(dense, ViewProvider(dense, alone(views, index)))._pixels.closeness(small)
        assert found.errors[index] == single.errors[0] and found.covered[index] == single.covered[0]
    quality = judge.quality(small)
    assert quality.ssim is not None and -1 < quality.ssim < 1
    assert "4 views of 960 x 720 and 2 other sizes pixels" in quality_details(quality)


def test_bands_for_ssim_lie_within_each_picture(dense, large):
    bands = Judge(dense, ViewProvider(dense, large[:4]))._bands.views
    for index, band in enumerate(bands):
        whole = large[index // 2]
        assert band.width == whole.width and band.height <= whole.height
        top = float(whole.K[1, 2] - band.K[1, 2])
        assert 0 <= top <= whole.height - band.height


def test_sizes_to_compare_and_to_draw_are_those_of_each_view(large):
    for of_all, function in (
        (sizes(large), sizes),
        (other_sizes(large), other_sizes),
        ([middle_sized(large)], lambda views: [middle_sized(views)]),
    ):
        for place, every in enumerate(of_all):
            for index, view in enumerate(every):
                (single,) = function(alone(large, index))[place]
                assert (view.width, view.height, view.eps2d) == (
                    single.width,
                    single.height,
                    single.eps2d,
                )
                assert torch.equal(view.K, single.K)


def test_fill_is_the_mean_over_all_pixels(dense, views):
    pixels = [view.width * view.height for view in views]
    each = [fill(dense, alone(views, index)) for index in range(COUNT)]
    mean = sum(one * size for one, size in zip(each, pixels, strict=True)) / sum(pixels)
    assert fill(dense, views) == pytest.approx(mean, rel=1e-9)


FILES = {
    "cameras.json": lambda views, folder: written(inria(views), folder / "cameras.json"),
    "transforms.json": lambda views, folder: written(
        nerfstudio_of_several_sizes(views), folder / "transforms.json"
    ),
    "colmap": lambda views, folder: write_sparse_of_several_sizes(views, folder / "sparse/0"),
}


@pytest.mark.parametrize("kind", FILES)
def test_photos_of_several_sizes_are_read_and_trained_on_at_their_sizes(
    kind, dense, views, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(PHOTO_STEPS, "quick", 4)
    folder = write_photos(dense, views, tmp_path / "images")
    FILES[kind](views, tmp_path)
    _, found = read_with_photos(dense, folder)
    assert len(found.training) + len(found.held_out) == COUNT
    shapes = sorted(example.target.shape for example in (*found.training, *found.held_out))
    assert shapes == sorted((view.height, view.width, 3) for view in views)
    for example in (*found.training, *found.held_out):
        drawn = ps.render(dense, example.view)
        assert float((drawn - example.target.float() / 255).abs().max()) < 0.02
    ps.save(dense, tmp_path / "room.ply")
    words = ["compact", "room.ply", "--photos", "images", "--keep", "30%", "--json", "-o", "a.ply"]
    monkeypatch.chdir(tmp_path)
    main(words)
    result = json.loads(capsys.readouterr().out)
    judged = {(result["width"], result["height"]), *map(tuple, result["other_sizes"])}
    assert judged == {(64, 48), (48, 64), (32, 24), (24, 32)}


@pytest.mark.parametrize(
    "command",
    [
        "prune room.ply --keep 20% -o a.ply",
        "clean room.ply -o a.ply",
        "lod room.ply --levels 50% -o lod",
        "render room.ply --seconds 0.2 -o a.mp4",
        "render room.ply -o a.png",
        "tradeoff room.ply --keep 20% --views 4 --repairs none -o trade",
        "compact room.ply --keep 20% --effort instant -o a.ply --html page.html --picture a.png",
    ],
)
def test_each_command_takes_poses_of_several_sizes(command, dense, views, tmp_path, monkeypatch):
    ps.save(dense, tmp_path / "room.ply")
    FILES["cameras.json"](views, tmp_path)
    monkeypatch.chdir(tmp_path)
    poses = ["--poses", "cameras.json"]
    main([*command.split(), *poses])


def test_a_film_through_views_of_several_sizes_has_one_size(dense, views):
    cameras, _ = camera_path(
        dense, ViewProvider(dense, views), FilmSettings(width=32, height=24, seconds=1.0)
    )
    assert cameras.images is None and (cameras.width, cameras.height) == (32, 24)
    for index, view in enumerate(views):  # the vertical field of view of each view
        nearest = (cameras.viewmats - view.viewmat.double()).abs().amax((1, 2)).argmin()
        angle = view.height / float(view.K[1, 1])
        assert 24 / float(cameras.Ks[nearest, 1, 1]) == pytest.approx(angle, rel=1e-6), index


def test_pages_and_sheets_show_each_view_in_its_shape(dense, views, tmp_path):
    frame = FlightFrame.of(dense, views)
    shown = frame.data([])["views"]
    assert len({view["aspect"] for view in shown}) > 1
    for view, data in zip(frame.views, shown, strict=True):
        assert data["aspect"] == view.width / view.height
    draw_pair(dense, dense[::2], views[[2, 5, 8]], tmp_path / "pair.png")
    text = plot_views(dense, ViewProvider(dense, views), tmp_path / "sheet.png")
    assert "16 of 18 views of 64 x 48 and 3 other sizes pixels; given views" in text


def test_distances_of_levels_come_from_views_of_each_size(dense, views):
    reference = DenseReference(dense, views)
    (found,) = pixel_sizes(dense, reference, [dense[::2]], [20.0])
    assert 0 < found < float("inf")


def test_views_to_optimise_on_keep_the_shapes_of_those_that_are_not_compared(dense, views):
    source = ViewProvider(dense, views)
    left = sorted({*range(COUNT)} - {*spread_indices(COUNT, VIEW_COUNTS.compared)})
    drawn = {}
    for view in itertools.islice(source.others(), 12 * len(left)):
        drawn.setdefault(view.viewmat.double().numpy().tobytes(), set()).add(
            (view.width, view.height)
        )
    assert source.origin.kind is Origin.GIVEN
    for index in left:
        view = views[index]
        assert drawn[view.viewmat.double().numpy().tobytes()] == {(view.width, view.height)}
